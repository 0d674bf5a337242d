"""The clock for a person: what each source says, the bound, and what to do about it."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from pmutools.cli.shell import visible
from pmutools.measure.clockquality import ClockQuality
from pmutools.measure.clocks import ChronyClock, GpsClock, KernelClock, PtpClock

WIDTH = 100
MODES = {0: "no fix", 1: "no fix", 2: "2D fix", 3: "3D fix"}
WIDE_NS = 1_000_000
"""A bound beyond this is worth narrowing."""


def duration(ns: float, sign: str = "") -> str:
    """A time in the unit that suits it."""
    for unit, size in (("s", 1e9), ("ms", 1e6), ("us", 1e3)):
        if abs(ns) >= size:
            return f"{ns / size:{sign}.3g} {unit}"
    return f"{ns:{sign}.0f} ns"


def lines(quality: ClockQuality, silent: Mapping[str, str]) -> Iterator[str]:
    """All of it, the bound first."""
    said = {name: getattr(quality, name) for name in SOURCES}
    rows = [
        f"  {name:<7} {silent.get(name, 'says nothing') if part is None else SOURCES[name](part)}"
        for name, part in said.items()
    ]
    rest = (*(f"note: {note}" for note in quality.notes), *(f"to do: {text}" for text in advice(quality)))
    for text in (quality.text, *rows, *rest):
        yield from textwrap.wrap(visible(text), WIDTH, subsequent_indent=" " * (10 if text.startswith(" ") else 2))


def _kernel(clock: KernelClock) -> str:
    if not clock.synchronised:
        return "not synchronised"
    error = f"error up to {duration(clock.maxerror_us * 1000)}" if clock.told else "error not told by who sets it"
    return f"synchronised, {error}, frequency {clock.frequency_ppm:+.3f} ppm{_tai(clock.tai_offset_s)}"


def _chrony(clock: ChronyClock) -> str:
    if clock.local:
        return f"follows its own clock (local, stratum {clock.stratum})"
    if (bound := clock.bound_ns) is None:
        return "not synchronised"
    reference = clock.name or clock.reference
    return (
        f"{reference} at stratum {clock.stratum - 1}: within {duration(bound)} (clock "
        f"{duration(abs(clock.correction_s) * 1e9)} {'slow' if clock.correction_s > 0 else 'fast'}, root delay "
        f"{duration(clock.root_delay_s * 1e9)}, dispersion {duration(clock.root_dispersion_s * 1e9)}), "
        f"skew {clock.skew_ppm:.3g} ppm"
    )


def _ptp(clock: PtpClock) -> str:
    if clock.why_not:
        return clock.why_not
    card = f", system clock {duration(clock.system_offset_ns or 0, '+')} from the card's"
    return (
        f"grandmaster {clock.grandmaster}, clock class {clock.clock_class}: within {duration(clock.bound_ns or 0)} "
        f"(offset {duration(clock.master_offset_ns, '+')}, path delay {duration(clock.mean_path_delay_ns)}"
        f"{card if clock.system_offset_ns else ''}){_tai(clock.utc_offset_s or 0)}"
    )


def _gps(clock: GpsClock) -> str:
    fix = MODES.get(clock.mode, f"mode {clock.mode}")
    fix += f" of {clock.satellites} satellites" if clock.fix and clock.satellites else ""
    time = f", its time good to {duration(clock.time_error_s * 1e9)}" if clock.time_error_s is not None else ""
    if clock.clock_offset_ns is not None:
        return f"{fix}{time}, pulse: system clock {duration(clock.clock_offset_ns, '+')} off"
    serial = clock.serial_offset_ns
    return f"{fix}{time}, no pulse" + (
        "" if serial is None else f": system clock {duration(serial, '+')} off by its messages, which come late"
    )


def _tai(offset_s: int) -> str:
    return f", TAI - UTC {offset_s} s" if offset_s else ""


SOURCES: dict[str, Callable[[Any], str]] = {"kernel": _kernel, "chrony": _chrony, "ptp": _ptp, "gps": _gps}


class Advice(NamedTuple):
    """What to do, and when."""

    sign: str
    when: Callable[[ClockQuality], bool]
    text: str


ADVICE = (
    Advice(
        "the clock is within 1 ms of UTC",
        lambda quality: quality.bound_ns is not None and quality.bound_ns <= WIDE_NS,
        "",
    ),
    Advice(
        "the bound is wider than that",
        lambda quality: quality.bound_ns is not None,
        "delays of some ten ms can be told; a nearer time server, or PTP with hardware time stamps, narrows the bound",
    ),
    Advice(
        "ptp4l's port is not SLAVE",
        lambda quality: quality.ptp is not None and quality.ptp.state != "SLAVE",
        "ptp4l has no master: look whether the grandmaster is on, in the same domain, and not behind a switch that "
        "drops PTP (pmc -u -b 0 'GET PORT_DATA_SET').",
    ),
    Advice(
        "the clock class is neither 6 nor 7",
        lambda quality: quality.ptp is not None and quality.ptp.clock_class not in (6, 7),
        "the grandmaster has lost its own reference, or never had one: see to its antenna.",
    ),
    Advice(
        "the grandmaster has a timescale of its own",
        lambda quality: quality.ptp is not None and not quality.ptp.ptp_timescale,
        "the grandmaster does not distribute TAI: have it use the PTP timescale.",
    ),
    Advice(
        "the two clocks cannot be compared",
        lambda quality: quality.ptp is not None,
        "run as root, so that the network card's clock (/dev/ptp0) can be compared with the system's, and phc2sys, so "
        "that the two are alike.",
    ),
    Advice(
        "chrony follows its own clock only",
        lambda quality: quality.chrony is not None and quality.chrony.local,
        "chrony has no source but itself (local): give it a server, or a GPS receiver as refclock.",
    ),
    Advice(
        "chrony is not synchronised",
        lambda quality: quality.chrony is not None,
        "chronyd runs and has no usable source: chronyc sources says which it has tried. After a start this takes "
        "some seconds.",
    ),
    Advice(
        "the kernel's clock is set, by whom is not said",
        lambda quality: quality.kernel is not None and quality.kernel.synchronised,
        "the clock is set by a program that does not say how well, as systemd-timesyncd does. chrony in its place "
        "says so (apt install chrony).",
    ),
    Advice(
        "the kernel's clock is not set",
        lambda quality: quality.kernel is not None,
        "nobody sets this clock. Install chrony and give it a time server (apt install chrony); for less than 1 us "
        "use PTP, or a GPS receiver with a pulse per second.",
    ),
    Advice(
        "the kernel says nothing",
        lambda quality: True,
        "this system does not say how good its clock is; run the measurement on Linux, or trust differences of "
        "delays only.",
    ),
)
"""The first that applies holds."""


def advice(quality: ClockQuality) -> Iterator[str]:
    """What to do about it, if anything."""
    text = next(row.text for row in ADVICE if row.when(quality))
    if text:
        yield text
    if quality.gps is not None and quality.gps.fix and quality.source not in ("gps", "chrony", "ptp"):
        yield "gpsd has the time, and the clock does not follow it: chrony can (refclock SHM 0, or SOCK)."
