"""Whether the clock has its lock: the word of each source, its age, and the loop beside a real gpsd and chronyd."""

from __future__ import annotations

import itertools
import socket
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
from support.clock_programs import chronyd, gpsd_of, receiver
from support.live import free_ports
from support.modbus_device import wait_for
from support.run_folder import Listener, in_thread, listening

from dcon.aides.gps import GpsAide
from dcon.aides.gps_lock import FRESH_NS, Lock, Verdict, judge
from dcon.link.beats import LoopState
from dcon.link.paths import CONTROL, WATCHDOG, prepare
from dcon.sections import Platform
from pmutools.clocksources.asking import NoAnswer
from pmutools.clocksources.chrony import Chronyd
from pmutools.clocksources.gpsd import Gpsd
from pmutools.clocksources.watch import Places
from pmutools.measure.clockquality import ClockQuality
from pmutools.measure.clocks import ChronyClock, GpsClock, KernelClock, PtpClock, TimeStatus
from pmutools.timebase import NS

LIMIT_NS = 5_000_000
SYNCED = KernelClock(0, 0.0, 1234, 10, 0)
TIMESYNCD = KernelClock(0, 0.0, 500, 0, 0)
FREE = KernelClock(0, 0.0, 16_000_000, 16_000_000, int(TimeStatus.UNSYNCHRONISED))
CHRONY = ChronyClock("47505300", 1, 1e-6, 1e-6, 0.0, 0.0, 0.0, 1e-5)
FAR = ChronyClock("C0000201", 3, 1e-3, 1e-3, 0.0, 0.0, 0.03, 1e-3)
ALONE = ChronyClock("7F7F0101", 10, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
PTP = PtpClock("gm", 6, 500, 1000, 37, 200)
PULSE = GpsClock(3, pps=True, clock_offset_ns=-700)
FIX = GpsClock(3, serial_offset_ns=200_000_000)


@pytest.mark.parametrize(
    ("source", "quality", "locked", "by", "detail"),
    [
        ("kernel", ClockQuality(kernel=SYNCED), True, "kernel", "within 1.23 ms"),
        ("kernel", ClockQuality(kernel=KernelClock(0, 0.0, 5001, 10, 0)), False, "kernel", "within 5 ms"),
        ("kernel", ClockQuality(kernel=TIMESYNCD), True, "kernel", "a program that does not say how well"),
        ("kernel", ClockQuality(kernel=FREE), False, "kernel", "not synchronised"),
        ("kernel", ClockQuality(chrony=CHRONY), False, "kernel", "why kernel is silent"),
        ("chrony", ClockQuality(chrony=CHRONY), True, "chrony", "within 0.011 ms"),
        ("chrony", ClockQuality(chrony=FAR), False, "chrony", "within 17 ms"),
        ("chrony", ClockQuality(chrony=ALONE), False, "chrony", "follows only itself"),
        ("chrony", ClockQuality(kernel=SYNCED), False, "chrony", "why chrony is silent"),
        ("ptp", ClockQuality(ptp=PTP), True, "ptp", "within 0.0017 ms"),
        ("ptp", ClockQuality(ptp=PtpClock("gm", 248, 0, 0, 37, 0)), False, "ptp", "clock class 248"),
        ("gpsd", ClockQuality(gps=PULSE), True, "gpsd", "within 0.0017 ms"),
        ("gpsd", ClockQuality(gps=GpsClock(3, pps=True, clock_offset_ns=9_000_000)), False, "gpsd", "within 9 ms"),
        ("gpsd", ClockQuality(gps=FIX), True, "gpsd", "+0.2 s apart"),
        ("gpsd", ClockQuality(gps=GpsClock(3, serial_offset_ns=-2 * NS)), False, "gpsd", "-2.0 s apart"),
        ("gpsd", ClockQuality(gps=GpsClock(3)), False, "gpsd", "nothing to compare the clock with"),
        ("gpsd", ClockQuality(gps=GpsClock(1)), False, "gpsd", "no fix"),
        ("auto", ClockQuality(kernel=SYNCED, chrony=CHRONY), True, "chrony", "within 0.011 ms"),
        ("auto", ClockQuality(kernel=SYNCED, chrony=FAR), False, "chrony", "within 17 ms"),
        ("auto", ClockQuality(kernel=SYNCED, chrony=ALONE), True, "kernel", "within 1.23 ms"),
    ],
)
def test_the_word_of_each_source(source: str, quality: ClockQuality, locked: bool, by: str, detail: str) -> None:
    silent = {name: f"why {name} is silent" for name in ("kernel", "chrony", "ptp", "gps")}
    verdict = judge(source, quality, silent, LIMIT_NS)
    assert verdict is not None and (verdict.locked, verdict.source) == (locked, by)
    assert detail in verdict.detail


def test_where_nobody_promises_there_is_no_word() -> None:
    assert judge("auto", ClockQuality(kernel=TIMESYNCD, chrony=ALONE, gps=FIX), {}, LIMIT_NS) is None
    assert judge("none", ClockQuality(chrony=CHRONY), {}, LIMIT_NS) is None


YES, NO = Verdict(True, "chrony", "within 1 ms"), Verdict(False, "chrony", "within 99 ms")


def test_the_age_of_a_lock() -> None:
    lock, start_ns = Lock(), 1000 * NS
    assert lock.age_s(start_ns) is None
    lock.hear(None, start_ns)
    assert lock.age_s(start_ns) is None and lock.said(start_ns) is None, "not fitted"
    lock.hear(NO, start_ns)
    assert lock.age_s(start_ns) == 1000, "never since the boot"
    lock.hear(YES, start_ns + 2 * NS)
    assert lock.age_s(start_ns + 2 * NS) == 0 == lock.age_s(start_ns + 4 * NS)
    lock.hear(NO, start_ns + 5 * NS)
    assert lock.age_s(start_ns + 5 * NS) == 3 and lock.age_s(start_ns + 9 * NS) == 7
    lock.hear(YES, start_ns + 10 * NS)
    lock.hear(None, start_ns + 11 * NS)
    assert lock.age_s(start_ns + 12 * NS) == 2, "who has promised once and is silent has lost it"


def test_a_lock_that_nobody_confirms_is_none_any_more() -> None:
    lock = Lock()
    lock.hear(YES, 0)
    assert lock.age_s(FRESH_NS) == 0
    assert lock.age_s(FRESH_NS + NS) == (FRESH_NS + NS) / NS
    said = lock.said(FRESH_NS + NS)
    assert said == Verdict(False, "chrony", "no answer for 6 s")


# --- the loop ----------------------------------------------------------------------------------------------------


def loop(source: str, folder: Path, places: Places | None = None) -> GpsAide:
    first, second = free_ports(2)
    nobody = Places(Chronyd(port=first), Gpsd(port=second), "/nowhere/ptp4l")
    return GpsAide(Platform(time_source=source, time_bound_ms=1000.0), folder, places or nobody)


def ages(control: Listener) -> list[float]:
    return [news["age_s"] for news in control.said("gps")]


def beats_on(watchdog: Listener, seconds: float = 0.5) -> None:
    """The loop beats at least every 200 ms, with the counter advancing by one."""
    first = len(watchdog.beats("gps"))
    wait_for(lambda: len(watchdog.beats("gps")) >= first + round(seconds / 0.1))
    beats = watchdog.beats("gps")[first - 1 if first else 0 :]
    gaps = [later[0] - earlier[0] for earlier, later in itertools.pairwise(beats)]
    assert sorted(gaps)[len(gaps) // 2] < 200_000_000, "half of them, at least: a machine that is busy is not judged"
    assert all(later[1] - earlier[1] == 1 for earlier, later in itertools.pairwise(beats))


@pytest.mark.realtime
@pytest.mark.peer
def test_a_real_gpsd_that_gets_a_fix_and_ends(tmp_path: Path) -> None:
    """The receiver's time begins 2 s ahead and falls behind by 0.2 s a second: some 10 s of it are the machine's."""
    folder = prepare(tmp_path / "run")
    with ExitStack() as gpsd, listening(folder, WATCHDOG, CONTROL) as (watchdog, control):
        port = gpsd.enter_context(gpsd_of(receiver(time.time() + 2, 60), tmp_path, cycle_s=0.4))
        aide = loop("gpsd", folder, Places(gpsd=Gpsd(port=port)))
        with in_thread(aide.run, aide.stop):
            wait_for(lambda: 0.0 in ages(control), 20)
            assert control.said("gps")[-1]["source"] == "gpsd" and "s apart" in control.said("gps")[-1]["detail"]
            beats_on(watchdog)
            gpsd.close()
            wait_for(lambda: ages(control)[-1] > 2, 30)
            assert "nobody listens" in control.said("gps")[-1]["detail"]
            beats_on(watchdog)
        wait_for(lambda: watchdog.beats("gps")[-1][2] == LoopState.ENDING)


@pytest.mark.realtime
@pytest.mark.peer
def test_a_real_gpsd_whose_receiver_sees_no_sky(tmp_path: Path) -> None:
    folder = prepare(tmp_path / "run")
    with listening(folder, CONTROL) as (control,), gpsd_of(receiver(time.time(), 40, fix=False), tmp_path) as port:
        aide = loop("gpsd", folder, Places(gpsd=Gpsd(port=port)))
        with in_thread(aide.run, aide.stop):
            wait_for(lambda: control.said("gps") and "no fix" in control.said("gps")[-1]["detail"], 20)
            assert 0.0 not in ages(control)


@pytest.mark.realtime
@pytest.mark.peer
@pytest.mark.parametrize("source", ["chrony", "auto"])
def test_a_real_chronyd(source: str, tmp_path: Path) -> None:
    """One that serves, and one that follows it: the second is the clock's."""
    folder = prepare(tmp_path / "run")
    (ntp_port,) = free_ports(1)
    follow = (f"server 127.0.0.1 port {ntp_port} iburst minpoll -4 maxpoll -4", "maxdistance 16")
    with (
        listening(folder, CONTROL) as (control,),
        chronyd(tmp_path, "local stratum 1", "allow 127.0.0.1", ntp_port=ntp_port),
        chronyd(tmp_path, *follow) as port,
    ):
        places = Places(Chronyd(port=port), Gpsd(port=free_ports(1)[0]), "/nowhere/ptp4l")
        aide = loop(source, folder, places)
        with in_thread(aide.run, aide.stop):
            wait_for(lambda: 0.0 in ages(control), 30)
            assert control.said("gps")[-1]["source"] in ("chrony", "kernel")


@pytest.mark.realtime
def test_a_gpsd_that_hangs_grows_old_and_holds_up_nothing(tmp_path: Path) -> None:
    """It takes connections and says nothing; the loop goes on beating, and what was a lock is none."""
    folder = prepare(tmp_path / "run")
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        listening(folder, WATCHDOG, CONTROL) as (watchdog, control),
    ):
        aide = loop("gpsd", folder, Places(gpsd=Gpsd(port=server.getsockname()[1])))
        aide._lock.hear(YES, time.monotonic_ns() - FRESH_NS + NS)
        with in_thread(aide.run, aide.stop):
            wait_for(lambda: ages(control)[-1:] == [0.0])
            beats_on(watchdog)
            wait_for(lambda: ages(control)[-1] > 5)
            detail = control.said("gps")[-1]["detail"]
            assert "gpsd says nothing" in detail or "no answer" in detail
            beats_on(watchdog)


@pytest.mark.realtime
@pytest.mark.parametrize("source", ["none", "auto"])
def test_where_nobody_is_asked_or_promises_nothing_is_said(
    source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_answer() -> KernelClock:  # this machine's own clock may be a good one
        raise NoAnswer("not asked")

    monkeypatch.setattr("pmutools.clocksources.watch.ask_kernel", no_answer)
    folder = prepare(tmp_path / "run")
    with listening(folder, WATCHDOG, CONTROL) as (watchdog, control):
        aide = loop(source, folder)
        with in_thread(aide.run, aide.stop):
            beats_on(watchdog, 1.0)
        assert control.said("gps") == []


@pytest.mark.realtime
def test_a_question_that_fails_in_a_way_nobody_thought_of_ends_the_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken() -> KernelClock:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr("pmutools.clocksources.watch.ask_kernel", broken)
    folder = prepare(tmp_path / "run")
    with listening(folder, WATCHDOG) as (watchdog,):
        aide = loop("kernel", folder)
        with in_thread(aide.run, aide.stop):
            wait_for(lambda: aide.failure)
        assert aide.failure == "ZeroDivisionError: a bug"
        wait_for(lambda: [state for *_, state in watchdog.beats("gps")][-1:] == [LoopState.FAILED])
