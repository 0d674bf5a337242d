"""What ``pmu play`` sends from a real capture and ``pmu read`` logs is the same: values, flags, count."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
from support.captures import REAL_CAPTURES, capture_path
from support.chain import TRANSPORTS, Chain, assert_same_values, batches_of, column, pass_through
from support.frames import random_stream

from pmutools.c37118.batch import STAMP_SOURCES
from pmutools.flow import StampSource

pytestmark = [pytest.mark.realtime]

SUFFIXES = (".csv", ".parquet", ".mcap")
PASSES = [(capture, "udp", suffix) for capture in REAL_CAPTURES for suffix in SUFFIXES] + [
    (capture, transport, SUFFIXES[(row + place) % 3])
    for row, capture in enumerate(REAL_CAPTURES)
    for place, transport in enumerate(TRANSPORTS[1:])
]
"""Every capture over every transport; every transport to every format."""


@pytest.mark.parametrize(("capture", "transport", "suffix"), PASSES)
def test_what_is_played_is_what_is_logged(capture: str, transport: str, suffix: str, tmp_path: Path) -> None:
    path = capture_path(capture)
    chain = pass_through(path, transport, tmp_path / f"log{suffix}")
    played, logged = batches_of(path), batches_of(only(chain))
    assert_same_values(played, logged)
    assert sum(map(len, logged)) == REAL_CAPTURES[capture].data
    assert {batch.config.idcode for batch in logged} == {REAL_CAPTURES[capture].idcode}
    assert chain.reading.frames == REAL_CAPTURES[capture].data
    assert chain.reading.tally.skipped == {}
    assert chain.reading.own_drops == 0
    assert [dict(result.fates) for result in chain.player.results] == [{"sent": REAL_CAPTURES[capture].data}]
    stamped(logged, transport)


def only(chain: Chain) -> Path:
    assert len(chain.paths) == 1
    return chain.paths[0]


def stamped(logged: list[object], transport: str) -> None:
    """Arrivals are the kernel's (but for what it stamps falsely in the first second), in order, none of the future."""
    sources = {STAMP_SOURCES[code] for code in column(logged, "stamp_source").tolist()}  # type: ignore[arg-type]
    allowed = {StampSource.KERNEL, StampSource.USER}
    if transport.startswith("tcp"):
        allowed.add(StampSource.KERNEL_BATCHED)
    assert sources <= allowed
    arrivals = column(logged, "arrival_ns")  # type: ignore[arg-type]
    assert np.all(np.diff(arrivals) >= 0)  # type: ignore[arg-type]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_stream_described_by_cfg3_keeps_its_scales(suffix: str, tmp_path: Path) -> None:
    """CFG-2 has no place for turned phasors and scaled analogs; who listens to UDP gets the CFG-3 too."""
    described = random_stream(random.Random(8), stations=3, frames=60, data_rate=50, time_base=1_000_000, idcode=9)
    path = tmp_path / "source.c37118"
    path.write_bytes(described.config("cfg3") + b"".join(described.data))
    chain = pass_through(path, "udp", tmp_path / f"log{suffix}")
    configs = [batch.config for batch in batches_of(path)] if suffix == ".csv" else []
    assert_same_values(batches_of(path), batches_of(only(chain), configs))
