"""Clock quality, the uncertainty of a delay, and the delay budget."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.measured import MS, arranged, batch, measured, stamps

from pmutools.flow import StampSource
from pmutools.measure.budget import TABLE_I, Departures, budget
from pmutools.measure.clockquality import ChronyClock, ClockLog, ClockQuality, GpsClock, KernelClock, PtpClock
from pmutools.measure.histogram import Histogram
from pmutools.measure.quality import QualityCounts
from pmutools.measure.uncertainty import uncertainty

CHRONY = ChronyClock("A29FC801", 3, -0.000_1, 0.000_2, 1.5, 0.1, 0.004, 0.000_5)
UNSYNCHRONISED = KernelClock(0, 0.0, 16_000_000, 16_000_000, 0x40)


def quality(**options: object) -> QualityCounts:
    return measured(batch(stamps(range(100)), 20.0, **options)).counts.quality  # type: ignore[arg-type]


def test_bounds_of_clocks() -> None:
    assert CHRONY.bound_ns == 2_600_000
    assert UNSYNCHRONISED.bound_ns is None
    assert KernelClock(0, 0.0, 900, 100, 0x2001).bound_ns == 900_000
    assert PtpClock("x", 6, -150, 1000, 37, 50).bound_ns == 1200
    assert PtpClock("x", 6, -150, 1000, 37, 50, accuracy_ns=100).bound_ns == 1300
    assert PtpClock("x", 248, 0, 0, 37, 0).bound_ns is None
    assert PtpClock("x", 6, 0, 0).bound_ns is None, "how far the system's clock is from the card's is not known"
    assert GpsClock(3, 5e-7).bound_ns is None, "nobody has compared the clock with it"
    assert GpsClock(3, 5e-7, True, -3000).bound_ns == 4000
    assert GpsClock(1, None, True, -3000).bound_ns is None


@pytest.mark.parametrize(
    ("maxerror_us", "esterror_us", "told"),
    [(5_500, 0, False), (0, 0, False), (2_500, 16_000_000, False), (5_501, 0, True), (5_500, 80, True)],
    ids=["timesyncd after 11 s", "just set by it", "linuxptp after 5 s", "chrony", "ntpd"],
)
def test_an_error_that_nobody_told_the_kernel_is_no_bound(maxerror_us: int, esterror_us: int, told: bool) -> None:
    clock = KernelClock(0, 0.0, maxerror_us, esterror_us, 0x2001)
    assert clock.told is told
    assert clock.bound_ns == (maxerror_us * 1000 if told else None)
    assert told or "does not say how well" in ClockQuality(clock).text


def test_who_disciplines_is_asked_first() -> None:
    both = ClockQuality(KernelClock(0, 0.0, 900, 100, 0x2001), CHRONY)
    assert (both.source, both.bound_ns) == ("chrony", 2_600_000)
    assert ClockQuality(both.kernel).source == "kernel"
    assert not ClockQuality(UNSYNCHRONISED).disciplined
    assert "not disciplined (kernel says" in ClockQuality(UNSYNCHRONISED).text
    assert "nobody says" in ClockQuality().text
    assert ClockQuality(gps=GpsClock(3, 1e-6)).bound_ns is None, "gpsd does not say that the clock follows it"
    assert ClockQuality(ptp=PtpClock("x", 6, 0, 2 * 10**9, 37, 0)).bound_ns is None


def test_who_promises_nothing_leaves_the_word_to_the_next() -> None:
    lost = PtpClock("x", 6, 0, 0, 37, 0, state="LISTENING")
    local = replace(CHRONY, reference="7F7F0101")
    pulse = GpsClock(3, 1e-6, True, 2000)
    good = KernelClock(0, 0.0, 900, 100, 0x2001)
    assert ClockQuality(good, CHRONY, lost, pulse).source == "chrony"
    assert ClockQuality(good, local, lost, pulse).source == "gps"
    assert ClockQuality(good, local, lost).source == "kernel"
    assert ClockQuality(UNSYNCHRONISED, local, lost).source == "ptp"
    assert "LISTENING" in ClockQuality(UNSYNCHRONISED, local, lost).text
    assert "its own clock only" in ClockQuality(UNSYNCHRONISED, local).text


@pytest.mark.parametrize(
    ("quality", "note"),
    [
        (ClockQuality(KernelClock(0, 0.0, 1, 1, 0x11)), "leap second will be inserted"),
        (ClockQuality(KernelClock(0, 0.0, 1, 1, 0x21)), "left out"),
        (ClockQuality(chrony=replace(CHRONY, leap_status="Insert second")), "leap second will be inserted"),
        (ClockQuality(chrony=replace(CHRONY, leap_status="Delete second")), "left out"),
        (ClockQuality(ptp=PtpClock("x", 6, 0, 0, leap=1)), "leap second will be inserted"),
        (ClockQuality(ptp=PtpClock("x", 6, 0, 0, leap=-1)), "left out"),
        (ClockQuality(chrony=replace(CHRONY, name="216.239.35.0")), "smears leap seconds"),
        (ClockQuality(KernelClock(0, 0.0, 1, 1, 1, 36), ptp=PtpClock("x", 6, 0, 0, 37)), "one of them is wrong"),
        (ClockQuality(chrony=CHRONY, gps=GpsClock(3, None, True, 5 * MS)), "+5 ms off, more than chrony admits"),
        (ClockQuality(gps=GpsClock(3, serial_offset_ns=-3600 * 10**9)), "-3600.0 s apart"),
    ],
)
def test_what_else_should_be_known(quality: ClockQuality, note: str) -> None:
    (told,) = quality.notes
    assert note in told
    assert quality.to_json()["notes"] == [told]


def test_nothing_else_is_nothing() -> None:
    good = KernelClock(0, 0.0, 900, 100, 0x2001, 37)
    gps = GpsClock(3, 1e-6, True, 2000, serial_offset_ns=300 * MS)
    assert ClockQuality(good, CHRONY, PtpClock("x", 6, 0, 2000, 37, 0), gps).notes == ()
    assert ClockQuality().notes == ()


def test_the_worst_of_a_run_counts() -> None:
    log = ClockLog()
    assert log.bound_ns is None
    log.add(ClockQuality(chrony=CHRONY))
    assert log.bound_ns == 2_600_000
    log.add(ClockQuality(KernelClock(0, 0.0, 9000, 100, 1)))
    assert log.bound_ns == 9_000_000
    log.add(ClockQuality(UNSYNCHRONISED))
    log.stepped(-5 * MS)
    told = log.to_json()
    assert (log.bound_ns, told["undisciplined_samples"], told["largest_step_ms"]) == (None, 1, -5.0)


@pytest.mark.parametrize(
    ("options", "receiver_ns", "bound_ns"),
    [
        ({}, 2_600_000, 2_600_000 + 1_000 + 100_000),
        ({"source": StampSource.HARDWARE}, 1_000, 3_000),
        ({"source": StampSource.USER}, 0, 1_001_000),
        ({"time_quality": 6}, 0, 200_000),
        ({"stat": 5 << 6}, 0, 1_100_000),
        ({"stat": 1 << 6, "time_quality": 4}, 0, 101_000),
        ({"stat": 7 << 6}, 0, None),
        ({"time_quality": 0xF}, 0, None),
        ({"time_quality": 0xC}, 0, None),
        ({}, None, None),
        ({"source": StampSource.KERNEL_BATCHED}, 0, 101_000 + 16_666_667),
    ],
)
def test_the_sum_of_the_parts(options: dict[str, object], receiver_ns: int | None, bound_ns: int | None) -> None:
    found = uncertainty(receiver_ns, "chrony", quality(**options), 1e9 / 60)
    assert found.bound_ns == bound_ns
    assert found.to_json()["parts"][0]["name"] == "receiver clock"


def test_of_locked_frames_alone() -> None:
    mixed = quality(time_quality=np.where(np.arange(100) < 50, 0xF, 0))
    assert uncertainty(0, "", mixed, 1e9 / 60).bound_ns is None
    assert uncertainty(0, "", mixed, 1e9 / 60, locked=True).bound_ns == 101_000


def test_told_beside_the_delay() -> None:
    assert uncertainty(200_000, "", quality(), 1e9 / 60).told(23.4 * MS) == "23.4 ms ± 0.3"
    assert uncertainty(None, "", quality(), 1e9 / 60).told(23.4 * MS) == "23.4 ms ± unknown (receiver clock)"


def test_budget_from_a_receiver_alone() -> None:
    """PMU 44 ms and a heavy-tailed network above 15 ms."""
    delays = 59 + np.random.default_rng(1).exponential(1.0, 6000)
    counts = measured(arranged(batch(stamps(range(6000)), delays))).counts
    rows = budget(counts.delays.delay, counts.delays.pdv, counts.windows.to_tick)
    assert [row.name for row in rows] == list(TABLE_I)
    pmu, network, processing, command, effective = rows
    assert pmu.mean_ms == pytest.approx(59, abs=0.1)
    assert network.mean_ms == pytest.approx(1.0, abs=0.1)
    assert pmu.mean_ms + network.mean_ms == pytest.approx(delays.mean(), abs=1e-3)
    assert network.max_ms == pytest.approx(delays.max() - delays.min(), abs=1e-3)
    assert 2 < processing.mean_ms < 18.7
    assert (command.mean_ms, command.measured) == (11.0, False)
    assert effective.mean_ms == pytest.approx(sum(row.mean_ms for row in rows[:-1]))
    assert not effective.measured
    assert "Command" in effective.how


def test_budget_with_the_sender_seen() -> None:
    sent = Histogram(np.full(100, 44 * MS))
    delay, way = Histogram(np.full(100, 60 * MS)), Histogram(np.full(100, 16 * MS))
    rows = budget(delay, Histogram(np.zeros(100)), Histogram(), departures=Departures(sent, way), command_ms=11.0)
    assert [(row.mean_ms, row.measured) for row in rows] == [
        (44, True),
        (16, True),
        (11, False),
        (11, True),
        (82, False),
    ]
    assert budget(Histogram(), Histogram(), Histogram()) == ()
