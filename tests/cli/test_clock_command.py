"""``pmu clock``: what all sources say, the bound, and what to do about it in words."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from support.clock_programs import chronyd, settled, until
from support.commands import Pmu
from support.live import free_ports
from support.requires import requires

from pmutools.cli.clock_text import ADVICE, advice, duration, lines
from pmutools.clocksources.chrony import Chronyd, ask_chrony
from pmutools.measure.clockquality import ClockQuality
from pmutools.measure.clocks import ChronyClock, GpsClock, KernelClock, PtpClock

UNSYNCHRONISED = KernelClock(0, 0.0, 16_000_000, 16_000_000, 0x40)
UNTOLD = KernelClock(0, -1.5, 5_000, 0, 0x2001)
KERNEL = KernelClock(0, -1.5, 5_123, 40, 0x2001, 37)
CHRONY = ChronyClock("C0000201", 2, -2e-6, 1e-6, -1.5, 0.05, 1e-4, 3e-5, "Normal", "192.0.2.1")
PTP = PtpClock("9e5a6b.fffe.6193ab", 6, -247, 1736, 37, 40)


@pytest.mark.parametrize(
    ("quality", "told", "to_do"),
    [
        (ClockQuality(), "nobody says", "differences of delays"),
        (ClockQuality(UNSYNCHRONISED), "kernel says it is not", "nobody sets this clock"),
        (ClockQuality(UNTOLD), "does not say how well", "chrony in its place"),
        (ClockQuality(KERNEL), "within 5.12 ms of UTC, by kernel", "a nearer time server"),
        (ClockQuality(KERNEL, CHRONY), "within 0.082 ms of UTC, by chrony", ""),
        (ClockQuality(UNSYNCHRONISED, ChronyClock("7F7F0101", 1, 0, 0, 0, 0, 0, 0)), "its own clock only", "(local)"),
        (
            ClockQuality(UNSYNCHRONISED, ChronyClock("0", 0, 0, 0, 0, 0, 1, 1, "Not synchronised")),
            "chrony says it is not",
            "chronyc sources",
        ),
        (ClockQuality(KERNEL, CHRONY, PTP), "within 0.00202 ms of UTC, by ptp", ""),
        (ClockQuality(UNTOLD, ptp=PtpClock("x", 6, 0, 0, 37, 0, "LISTENING")), "LISTENING", "has no master"),
        (ClockQuality(UNTOLD, ptp=PtpClock("x", 248, 0, 0, 37, 0)), "clock class 248", "antenna"),
        (ClockQuality(UNTOLD, ptp=PtpClock("x", 6, 0, 0, ptp_timescale=False)), "timescale of its own", "TAI"),
        (ClockQuality(UNTOLD, ptp=PtpClock("x", 6, 0, 0, 37)), "cannot be read", "as root"),
        (ClockQuality(UNTOLD, gps=GpsClock(3, 1e-6)), "does not say how well", "refclock"),
        (ClockQuality(UNTOLD, gps=GpsClock(3, 1e-6, True, -700)), "within 0.0017 ms of UTC, by gps", ""),
    ],
)
def test_what_is_said_and_what_to_do(quality: ClockQuality, told: str, to_do: str) -> None:
    said = list(lines(quality, {}))
    assert told in unwrapped(said)
    assert [line.split()[0] for line in said if re.match(r"  (kernel|chrony|ptp|gps)  ", line)] == [
        "kernel",
        "chrony",
        "ptp",
        "gps",
    ]
    assert all(len(line) <= 100 for line in said), said
    assert to_do in " ".join(advice(quality))
    assert bool(to_do) == any(line.startswith("to do: ") for line in said)


def unwrapped(said: list[str]) -> str:
    return re.sub(r"\n {2,}(?!kernel|chrony|ptp|gps)", " ", "\n".join(said))


def test_each_source_in_words() -> None:
    gps = GpsClock(3, 1e-6, True, -700, satellites=8)
    text = unwrapped(list(lines(ClockQuality(KERNEL, CHRONY, PTP, gps), {})))
    said = dict(line.split(maxsplit=1) for line in text.splitlines()[1:5])
    assert said["kernel"] == "synchronised, error up to 5.12 ms, frequency -1.500 ppm, TAI - UTC 37 s"
    assert said["chrony"] == (
        "192.0.2.1 at stratum 1: within 82 us (clock 2 us fast, root delay 100 us, dispersion 30 us), skew 0.05 ppm"
    )
    assert said["ptp"] == (
        "grandmaster 9e5a6b.fffe.6193ab, clock class 6: within 2.02 us (offset -247 ns, path delay 1.74 us, "
        "system clock +40 ns from the card's), TAI - UTC 37 s"
    )
    assert said["gps"] == "3D fix of 8 satellites, its time good to 1 us, pulse: system clock -700 ns off"
    silent = {"chrony": "chronyc is not installed\x1b[2J"}
    assert "not installed\\x1b[2J" in "\n".join(lines(ClockQuality(), silent))


def test_the_last_advice_always_applies() -> None:
    assert ADVICE[-1].when(ClockQuality())


@pytest.mark.parametrize(
    ("ns", "text"),
    [(0, "0 ns"), (999, "999 ns"), (1500, "1.5 us"), (-2_000_000, "-2 ms"), (16e9, "16 s"), (3.6e12, "3.6e+03 s")],
)
def test_durations(ns: float, text: str) -> None:
    assert duration(ns) == text


def test_the_command(pmu: Pmu) -> None:
    port, other = free_ports(2)
    elsewhere = ("--gpsd", f"127.0.0.1:{port}", "--chronyd", f"127.0.0.1:{other}", "--ptp4l", "/nowhere")
    done = pmu("clock", *elsewhere)
    assert done.code == 0
    assert f"no gpsd at 127.0.0.1:{port}" in done.out
    done = pmu("clock", "--json", *elsewhere)
    assert done.json["silent"]["gps"] == f"no gpsd at 127.0.0.1:{port}: nobody listens"
    assert {"disciplined", "source", "bound_ms", "text", "notes", "kernel", "chrony", "ptp", "gps"} <= set(done.json)
    done = pmu("clock", "--require", "0", "--quiet", *elsewhere)
    assert done.code == 3
    assert "pmu clock: --require 0: receiver clock" in done.complaint
    done = pmu("clock", "--gpsd", "localhost:2947")
    assert done.code == 2
    assert "'localhost:2947' is not of the form ADDRESS:PORT" in done.complaint


@pytest.mark.peer
@pytest.mark.realtime
def test_with_a_real_chronyd(pmu: Pmu, tmp_path: Path) -> None:
    (ntp,) = free_ports(1)
    chronyc = str(requires("chronyc"))
    serving = ("local stratum 1", "allow 127.0.0.1", "bindaddress 127.0.0.1")
    following = f"server 127.0.0.1 port {ntp} iburst minpoll -4 maxpoll -4"
    with chronyd(tmp_path, *serving, ntp_port=ntp), chronyd(tmp_path, following) as port:
        until(lambda patience: ask_chrony(chronyc, Chronyd(port=port), patience), settled)
        done = pmu("clock", "--chronyd", f"127.0.0.1:{port}", "--require", "100", "--ptp4l", "/nowhere")
    assert done.code == 0
    assert done.out.startswith("receiver clock within ")
    assert "by chrony" in done.out
