"""What is sent in the name of one PMU, from its own address, can take that PMU away, and nothing else.

The worst that the front hands on: the longest configurations, long frames, and frames without end. The controller goes
on by the instance that needs no such PMU, and runs every tick before the next is due (``judge_overruns``).
"""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
from support.running import Running, flood, frames_now
from support.swing import Streams

from dcon.front.receiving import LONGEST_CONFIG
from dcon.session.reader import LoggedTick, SessionReader
from pmutools.c37118 import StreamConfig
from pmutools.c37118.config import PhasorChannel, encode_config
from pmutools.timebase import NS

pytestmark = [
    pytest.mark.alone,
    pytest.mark.slow,
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform != "linux", reason="dcon run is Linux's"),
]
NAMES = ("N1", "N2", "S1", "S2")
CONFIG = Streams(("N1",)).configs["N1"]


def with_phasors(count: int, mark: int = 0) -> StreamConfig:
    (station,) = CONFIG.stations
    more = tuple(PhasorChannel(f"P{mark}.{k}", 0) for k in range(count))
    return replace(CONFIG, stations=(replace(station, phasors=station.phasors + more),))


def most_phasors(nbytes: int) -> int:
    """Of a configuration of at most so many bytes."""
    return (nbytes - len(encode_config(CONFIG))) // 20


def say(port: int, datagrams: list[bytes], every_s: float) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        for datagram in datagrams:
            sock.sendto(datagram, ("127.0.0.1", port))
            time.sleep(every_s)


def longest(port: int) -> None:
    count = most_phasors(LONGEST_CONFIG)
    say(port, [encode_config(with_phasors(count, mark)) for mark in range(100)], 0.01)


def too_long(port: int) -> None:
    count = most_phasors(65_000)
    say(port, [encode_config(with_phasors(count, mark)) for mark in range(50)], 0.02)


def frames(port: int) -> None:
    with flood(port, frames_now("N1"), 1.5):
        pass


FLOODS: dict[str, Callable[[int], None]] = {"longest": longest, "too long": too_long, "frames": frames}


def test_the_controller_goes_on_without_the_pmu_and_misses_no_deadline(tmp_path: Path) -> None:
    site = Running(tmp_path, names=NAMES, platform="judge_overruns = yes\n")
    spans: dict[str, tuple[int, int]] = {}
    try:
        site.start()
        site.activate()
        for name, do in FLOODS.items():
            begun_ns = time.time_ns()
            do(site.ports[0])
            site.caught_up()
            spans[name] = begun_ns, time.time_ns()
            assert site.status()["state"] == "ACTIVE", (name, site.status(), site.said())
        assert site.end() == 130
    finally:
        site.close()
    assert not [event for event in site.watchdog_events() if event["event"] == "trip"]
    ticks = list(SessionReader(site.log).ticks())
    for name, (from_ns, to_ns) in spans.items():
        meant = [tick for tick in ticks if from_ns <= tick.record.tick_ns <= to_ns]
        assert {round((b.record.tick_ns - a.record.tick_ns) * 60 / NS) for a, b in pairwise(meant)} == {1}
        assert not [event for tick in meant for event in tick.record.events if event.name == "overruns"], name
        assert_heard(meant)


def assert_heard(ticks: list[LoggedTick]) -> None:
    """No stamp of another PMU is missing."""
    for name in NAMES[1:]:
        slots = sorted({round(f.time_ns * 60 / NS) for tick in ticks for f in tick.frames if f.name == name})
        assert slots == list(range(slots[0], slots[-1] + 1)), name
        assert len(slots) >= len(ticks) - 5
