"""Children of the control process that live and do not beat: after ten seconds one counts as ended, in virtual time."""

from __future__ import annotations

import pytest

from dcon.control.hanging import HUNG_NS, Silences, hung, look
from dcon.control.heard import HELPERS, Heard, hear
from dcon.link.beats import UNHEARD, LoopName
from dcon.watchdog.codec import encode_status

T0 = 10**15
MS, S = 10**6, 10**9
TICK_NS = 16_666_667
FRONT = "the front process hangs: its loop parse has not beaten for 10 s"
AIDES = "the aides process hangs: its loop gps has not beaten for 10 s"


class Machine:
    """Loops that beat each 100 ms, and a watchdog that tells how long ago that was, each 20 ms."""

    def __init__(self) -> None:
        self.now_ns = T0
        self.beat_ns: dict[LoopName, int] = {}
        """When each beat last."""
        self.stopped: set[LoopName] = set()
        self.watchdog_speaks = True
        self.heard = Heard(T0)
        self.silences = Silences(T0)

    def run(self, seconds: float) -> str:
        """Tick after tick, until one finds somebody that hangs or the time is over."""
        end_ns = self.now_ns + round(seconds * S)
        while self.now_ns < end_ns:
            self.now_ns += TICK_NS
            self.beat_ns |= {loop: self.now_ns for loop in LoopName if loop not in self.stopped}
            if self.watchdog_speaks:
                self.speak()
            if found := self.look():
                return found
        return ""

    def speak(self) -> None:
        ages = [
            min((self.now_ns - self.beat_ns[loop]) // MS, UNHEARD - 1) if loop in self.beat_ns else UNHEARD
            for loop in LoopName
        ]
        self.heard = hear(self.heard, encode_status(1, self.now_ns, 0, 7, 0, True, 0, ages), self.now_ns).heard

    def look(self) -> str:
        self.silences = look(self.silences, self.heard, self.now_ns)
        return hung(self.silences, HUNG_NS)

    def stand_still(self, seconds: float) -> None:
        """All of it."""
        self.now_ns += round(seconds * S)


def test_who_beats_does_not_hang_and_who_has_stopped_does_after_ten_seconds() -> None:
    machine = Machine()
    assert machine.run(20) == ""
    machine.stopped = {LoopName.PARSE}
    began_ns = machine.now_ns
    assert machine.run(60) == FRONT
    assert 10 * S < machine.now_ns - began_ns < 10.1 * S


@pytest.mark.parametrize("loop", LoopName)
def test_the_loops_of_the_children_are_looked_at_and_no_others(loop: LoopName) -> None:
    machine = Machine()
    machine.run(1)
    machine.stopped = {loop}
    assert machine.run(12).startswith(f"the {HELPERS[loop]} process hangs" if loop in HELPERS else "")
    assert bool(machine.look()) == (loop in HELPERS)


def test_one_that_beats_again_in_time_does_not_hang() -> None:
    machine = Machine()
    machine.run(1)
    for _ in range(5):
        machine.stopped = {LoopName.GPS}
        assert machine.run(9.5) == ""
        machine.stopped = set()
        assert machine.run(0.5) == ""


def test_one_that_has_never_beaten_is_not_judged_nor_are_beats_of_an_earlier_life() -> None:
    machine = Machine()
    machine.stopped = {LoopName.PARSE, LoopName.GPS}
    machine.beat_ns = {LoopName.GPS: T0 - S}
    assert machine.run(60) == ""


def test_a_watchdog_that_is_silent_says_nothing_of_them() -> None:
    machine = Machine()
    machine.run(1)
    machine.watchdog_speaks = False
    machine.stopped = {LoopName.GPS}
    assert machine.run(60) == ""
    machine.watchdog_speaks, machine.stopped = True, set()
    assert machine.run(5) == ""


def test_the_first_word_of_a_watchdog_that_stood_still_condemns_nobody() -> None:
    """It has not read yet what they sent meanwhile."""
    machine = Machine()
    machine.run(1)
    machine.watchdog_speaks = False
    old = dict(machine.beat_ns)
    machine.run(30)
    fresh, machine.beat_ns = machine.beat_ns, old
    machine.speak()
    assert machine.look() == ""
    machine.beat_ns, machine.watchdog_speaks = fresh, True
    assert machine.run(5) == ""


def test_a_watchdog_that_was_started_again_has_not_heard_one_that_hangs() -> None:
    machine = Machine()
    machine.run(1)
    machine.stopped = {LoopName.GPS}
    machine.run(3)
    del machine.beat_ns[LoopName.GPS]
    assert machine.run(60) == AIDES


@pytest.mark.parametrize("seconds", [5.0, 60.0, 3600.0])
def test_a_machine_that_stood_still_is_no_hang(seconds: float) -> None:
    machine = Machine()
    machine.run(1)
    for _ in range(3):
        machine.stand_still(seconds)
        machine.speak()  # before anybody else runs
        assert machine.look() == ""
        assert machine.run(5) == ""
