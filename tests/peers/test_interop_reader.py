"""``pmu read`` logs what pyc37, an independent implementation, serves over TCP as a PMU: the same values."""

from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Any

import pytest
from support.chain import has
from support.peers import free_port, pyc37_stream, start_pyc37_pmu
from support.recordings import data_of

from pmutools.c37118.config import decode_config
from pmutools.c37118.demux import Message
from pmutools.clock import SystemClock
from pmutools.formats import open_sink, open_source
from pmutools.formats.describe import describe
from pmutools.timebase import NS
from pmutools.tools.live import LiveSource
from pmutools.tools.reader import read

pytestmark = [pytest.mark.peer, pytest.mark.realtime]

FRAMES = 5
"""pyc37 serves eight a second."""


@pytest.mark.parametrize(("stations", "suffix"), [(1, ".csv"), (3, ".parquet"), (2, ".mcap")])
def test_the_reader_logs_what_pyc37_serves(stations: int, suffix: str, tmp_path: Path) -> None:
    stream = pyc37_stream(random.Random(31 + stations), stations=stations, frames=FRAMES)
    port, clock, out = free_port(), SystemClock(), tmp_path / f"log{suffix}"
    patience_ns = clock.monotonic_ns() + 15 * NS
    with start_pyc37_pmu(port, stream.config(), stream.data):
        url = f"tcp://127.0.0.1:{port}?idcode={stream.spec.idcode}"
        source = LiveSource([url], stop=lambda: has(source, FRAMES) or clock.monotonic_ns() > patience_ns)
        with source, open_sink(out) as sink:
            reading = read(source, sink)
    assert (reading.frames, reading.tally.skipped) == (FRAMES, {})
    config = decode_config(stream.config())[1]  # a CSV does not keep it
    messages = [item for item in open_source(out, configs=[config]).items() if isinstance(item, Message)]
    if suffix == ".mcap":
        assert data_of(messages) == list(stream.data)
    told = [described for message in messages if (described := describe(message))["type"] == "data"]
    for frame, expected in zip(told, stream.expected_data(), strict=True):
        assert same(frame["stations"], expected["stations"])
        assert (frame["time_ns"], frame["time_quality"]) == (expected["time_ns"], expected["time_quality"])


def same(told: Any, expected: Any) -> bool:
    """Equal, floats to within what a table keeps of them; what the expected one does not say is not looked at."""
    if isinstance(expected, dict):
        return all(same(told[key], value) for key, value in expected.items())
    if isinstance(expected, list):
        return len(told) == len(expected) and all(map(same, told, expected))
    if isinstance(expected, float) and told is not None:
        return math.isclose(told, expected, rel_tol=1e-6, abs_tol=1e-6)
    return bool(told == expected)
