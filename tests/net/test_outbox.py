"""Whose the kernel's stamps of departures are, with a socket that stamps as it is told."""

from __future__ import annotations

import time
from typing import cast

import numpy as np
import pytest

from pmutools.net import outbox
from pmutools.net.outbox import NO_ROW, Departures
from pmutools.net.udp import UdpSocket


class Stamping:
    """Stands for a socket; ``stamps`` are (number, UTC ns) that wait in its error queue."""

    def __init__(self) -> None:
        self.stamps: list[tuple[int, int]] = []

    def departures(self) -> list[tuple[int, int]]:
        taken, self.stamps = self.stamps, []
        return taken

    def restart_departures(self) -> None:
        pass


def departures() -> tuple[Stamping, Departures]:
    sock = Stamping()
    return sock, Departures(cast("UdpSocket", sock))


def test_what_nobody_asks_for_leaves_nothing_behind() -> None:
    sock, left = departures()
    for number in range(100):
        left.sent(np.array([NO_ROW]), [])
        sock.stamps = [(number, 1)]
        left.collect()
    assert not left._found


def test_of_stamps_that_nobody_reads_the_newest_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outbox, "_REMEMBERED", 64)
    sock, left = departures()
    for number in range(0, 1000, 10):
        left.sent(np.arange(number, number + 10), [])
        sock.stamps = [(k, k) for k in range(number, number + 10)]
        left.collect()
    marks, times = left.read()
    assert marks.tolist() == times.tolist() == [*range(940, 1000)]
    assert left.read()[0].tolist() == []


def test_stamps_of_a_count_before_are_nobodys() -> None:
    """They may be on their way while a failed send has numbers begin anew."""
    sock, left = departures()
    left.sent(np.arange(5), [])
    before_ns = time.time_ns()
    left.sent(np.array([5]), [0])
    left.sent(np.arange(10, 15), [])
    after_ns = time.time_ns()
    sock.stamps = [(0, before_ns - 1), (1, before_ns - 1), (0, after_ns), (1, after_ns)]
    marks, times = left.read()
    assert marks.tolist() == [10, 11]
    assert times.tolist() == [after_ns] * 2
