"""pyc37, an independent implementation, reads over TCP what ``pmu play --listen`` serves: the same values."""

from __future__ import annotations

import cmath
import random
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from support.captures import capture_path
from support.chain import EarlyClock, playing
from support.frames import Described
from support.peers import pyc37_stream, run_pyc37_pdc

from pmutools.c37118.demux import Message
from pmutools.c37118.framer import Frame
from pmutools.formats import open_source
from pmutools.formats.describe import describe
from pmutools.net.endpoint import parse_endpoint
from pmutools.tools.player.cast import as_recorded
from pmutools.tools.player.play import Options, Player
from pmutools.tools.player.reel import at_interval, record

pytestmark = [pytest.mark.peer, pytest.mark.realtime]

INTERVAL_NS = 40_000_000
"""pyc37 takes one read for one frame: frames that come together are lost on it."""


@contextmanager
def served(path: Path) -> Iterator[int]:
    """A recording on a TCP port of loopback; plays from the first start command on."""
    reel = at_interval(record(open_source(path).blocks()), INTERVAL_NS)
    over = threading.Event()
    options = Options(listen=[parse_endpoint("tcp://127.0.0.1:0")])
    clock = EarlyClock(reel.first_due_ns)
    player = Player(as_recorded(reel), options, clock, stop=over.is_set)
    address = player.senders.local(0)
    assert address is not None
    with playing(player, over):
        yield address.port
        over.set()


def agree(told: dict[str, Any], expected: dict[str, Any]) -> None:
    """What pyc37 tells of a data frame, and what it says; the second has moved."""
    assert told["fracsec"] == expected["fracsec"]
    assert told["idcode"] == expected["idcode"]
    for station, wanted in zip(told["stations"], expected["stations"], strict=True):
        assert {key: station[key] for key in ("idcode", "stat", "digitals")} == {
            key: wanted[key] for key in ("idcode", "stat", "digitals")
        }
        assert station["frequency"] == pytest.approx(wanted["frequency"])
        assert station["dfreq"] / 100 == pytest.approx(wanted["rocof"])
        assert station["analogs"] == pytest.approx(wanted["analogs"])
        for polar, phasor in zip(station["phasors"], wanted["phasors"], strict=True):
            assert cmath.rect(*polar) == pytest.approx(complex(phasor["re"], phasor["im"]), abs=1e-6)


@pytest.mark.parametrize("stations", [1, 3])
def test_pyc37_reads_what_is_played(stations: int, tmp_path: Path) -> None:
    stream: Described = pyc37_stream(random.Random(21), stations=stations, frames=10)
    path = tmp_path / "stream.c37118"
    path.write_bytes(stream.config() + b"".join(stream.data))
    with served(path) as port:
        answers = run_pyc37_pdc("127.0.0.1", port, stream.spec.idcode, 10, ask=("header", "cfg1", "cfg2"))
    assert [answer["type"] for answer in answers] == ["header", "cfg1", "cfg2"] + ["data"] * 10
    assert f"stream {stream.spec.idcode}" in answers[0]["text"]
    for answer in answers[1:3]:
        expected = stream.expected_config()
        assert (answer["time_base"], answer["data_rate"]) == (expected["time_base"], expected["data_rate"])
        for told, station in zip(answer["stations"], expected["stations"], strict=True):
            for key in ("name", "idcode", "format", "fnom_hz", "cfgcnt"):
                assert told[key] == station[key]
    for answer, wanted in zip(answers[3:], stream.expected_data(), strict=True):
        agree(answer, wanted)
    assert len({a["soc"] - w["soc"] for a, w in zip(answers[3:], stream.expected_data(), strict=True)}) == 1


def test_pyc37_reads_a_real_capture(tmp_path: Path) -> None:
    path, count = capture_path("C37.118_1PMU_UDP.pcap"), 25
    recorded = [
        describe(item) for item in open_source(path).items() if isinstance(item, Message) and is_data(item.frame)
    ]
    with served(path) as port:
        answers = run_pyc37_pdc("127.0.0.1", port, 60, count)
    for answer, wanted in zip(answers[2:], recorded[:count], strict=True):
        agree(answer, wanted)


def is_data(frame: Frame) -> bool:
    return frame.data[1] >> 4 == 0
