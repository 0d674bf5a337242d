"""All clock sources beside whatever else runs: the last word at once, nothing hangs, the thread ends."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from support.clock_programs import chronyd, gpsd_of, receiver
from support.live import free_ports

from pmutools.clock import VirtualClock
from pmutools.clocksources import asking, watch
from pmutools.clocksources.asking import NoAnswer
from pmutools.clocksources.chrony import Chronyd
from pmutools.clocksources.gpsd import Gpsd
from pmutools.clocksources.kernel import kernel_clock
from pmutools.clocksources.watch import ClockSources, ClockWatch, Places
from pmutools.linux import ClockStatus

pytestmark = pytest.mark.realtime
ROOT = Path(__file__).parents[2]


def nowhere() -> Places:
    """Where nobody answers."""
    first, second = free_ports(2)
    return Places(Chronyd(port=first), Gpsd(port=second), "/nowhere/ptp4l")


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_the_kernel_is_known_at_once_and_the_reasons_soon() -> None:
    with ClockWatch(nowhere(), period_s=0.05) as clock:
        assert (clock.quality.kernel is None) == ("kernel" in clock.silent)
        assert clock.log().samples >= 1
        wait_for(lambda: clock.log().samples > 3)
        assert "no gpsd at" in clock.silent["gps"]
        assert clock.silent["ptp"] in ("no ptp4l at /nowhere/ptp4l", "pmc is not installed")
        assert clock.silent["chrony"] in ("chronyd does not run, or takes no questions", "chronyc is not installed")


def test_programs_are_looked_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr(watch, "find", lambda program: asked.append(program))
    sources = ClockSources(nowhere())
    for _ in range(3):
        sources.ask()
    assert asked == ["chronyc", "pmc"]
    assert sources.silent["chrony"] == "chronyc is not installed"


def test_closing_does_not_wait_for_a_program_that_hangs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "chronyc"
    program.write_text(f"#!/bin/sh\necho begun > {tmp_path}/begun\nsleep 60\n")
    program.chmod(0o755)
    monkeypatch.setattr(watch, "find", lambda name: str(program) if name == "chronyc" else None)
    before = threading.active_count()
    clock = ClockWatch(nowhere())
    wait_for((tmp_path / "begun").exists)
    began = time.monotonic()
    clock.close()
    assert time.monotonic() - began < watch.LEAVE_S + 0.5
    wait_for(lambda: threading.active_count() == before)
    clock.close()


def test_a_source_that_hangs_holds_up_no_other_for_long(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "chronyc"
    program.write_text("#!/bin/sh\nsleep 60\n")
    program.chmod(0o755)
    monkeypatch.setattr(watch, "find", lambda name: str(program) if name == "chronyc" else None)
    monkeypatch.setattr("pmutools.clocksources.chrony.PATIENCE_S", 0.2)
    sources = ClockSources(nowhere())
    sources.ask()
    assert sources.silent["chrony"] == "chronyc does not answer in time"
    assert "gps" in sources.silent


def test_a_source_that_falls_silent_is_no_longer_quoted(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = iter(["an answer"])

    def question(patience: asking.Patience) -> object:
        if (answer := next(answers, None)) is None:
            raise NoAnswer("gone")
        return answer

    sources = ClockSources(nowhere())
    sources.questions = {"chrony": question}
    first = sources.ask()
    assert (first.chrony, sources.silent) == ("an answer", {})
    second = sources.ask(first)
    assert (second.chrony, sources.silent) == (None, {"chrony": "gone"})


def test_steps_of_the_clock_are_in_the_log() -> None:
    machine = VirtualClock()
    with ClockWatch(nowhere(), period_s=0.02, clock=machine) as clock:
        wait_for(lambda: clock.log().samples > 1)
        machine.step(-250_000_000)
        wait_for(lambda: clock.log().steps == 1)
        assert clock.log().largest_step_ns == -250_000_000


def test_the_kernel_in_its_own_units() -> None:
    clock = kernel_clock(ClockStatus(0, 0x2001, True, -1234, 7.5, 12_345_000, 99_000, 37))
    assert (clock.offset_ns, clock.frequency_ppm, clock.maxerror_us, clock.esterror_us) == (-1234, 7.5, 12_345, 99)
    assert (clock.tai_offset_s, clock.synchronised, clock.bound_ns) == (37, True, 12_345_000)
    assert kernel_clock(ClockStatus(5, 0x2001, False, 0, 0.0, 12_345_000, 99_000, 0)).bound_ns is None


@pytest.mark.peer
def test_all_of_them_for_real(tmp_path: Path) -> None:
    (ntp,) = free_ports(1)
    serving = ("local stratum 1", "allow 127.0.0.1", "bindaddress 127.0.0.1")
    following = f"server 127.0.0.1 port {ntp} iburst minpoll -4 maxpoll -4"
    with (
        gpsd_of(receiver(time.time(), 60), tmp_path) as gpsd,
        chronyd(tmp_path, *serving, ntp_port=ntp),
        chronyd(tmp_path, following) as port,
        ClockWatch(Places(Chronyd(port=port), Gpsd(port=gpsd), "/nowhere/ptp4l"), period_s=0.1) as clock,
    ):
        wait_for(lambda: clock.quality.source == "chrony" and clock.quality.disciplined)
        wait_for(lambda: clock.quality.gps is not None and clock.quality.gps.fix)
        assert set(clock.silent) == {"ptp"}


def test_importing_it_is_cheap() -> None:
    program = (
        "import sys, pmutools.clocksources.watch; print(sorted({'numpy', 'rich', 'pyarrow'} & sys.modules.keys()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    assert done.stdout == "[]\n"
