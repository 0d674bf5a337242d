"""How good the receiver's clock is, by all who could be asked: one bound, and what else should be known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

from pmutools.measure.clocks import ChronyClock, GpsClock, KernelClock, PtpClock, TimeStatus
from pmutools.timebase import NS

__all__ = ["ChronyClock", "ClockLog", "ClockQuality", "GpsClock", "KernelClock", "PtpClock", "TimeStatus"]

TAI_LESS_UTC_S = 37
"""Since 2017; 36 or 38 are told apart from it by the table of diagnoses, should a leap second come."""
UNDISCIPLINED_NS = 1_000_000_000
"""A bound beyond this is none."""
_MS = 1e6


@dataclass(frozen=True, slots=True)
class ClockQuality:
    """The receiver's clock at one moment, by all who could be asked."""

    kernel: KernelClock | None = None
    chrony: ChronyClock | None = None
    ptp: PtpClock | None = None
    gps: GpsClock | None = None
    vouched_ns: int | None = None
    """The user's word for it, of a clock that cannot be asked any more."""

    @property
    def bound_ns(self) -> int | None:
        """How wrong the clock may be; None where nobody can tell.

        The user's word goes before all. Else who disciplines the clock knows best: PTP, then chrony; then who has
        compared it with a pulse; then the kernel's own figure. A source that promises nothing leaves the word to the
        next.
        """
        return self._promised()[1]

    @property
    def source(self) -> str:
        """Whose word :attr:`bound_ns` is; where nobody promises anything, who was asked first."""
        return self._promised()[0]

    @property
    def disciplined(self) -> bool:
        return self.bound_ns is not None

    @property
    def text(self) -> str:
        if (bound_ns := self.bound_ns) is None:
            return (
                f"receiver clock not disciplined ({self._why_not()}); "
                "delays hold its unknown offset, differences of delays do not"
            )
        by = "by the word of the user" if self.vouched_ns is not None else f"by {self.source}"
        return f"receiver clock within {bound_ns / _MS:.3g} ms of UTC, {by}"

    @property
    def short(self) -> str:
        """:attr:`text` in a few words."""
        if (bound_ns := self.bound_ns) is None:
            return f"clock not disciplined ({self._why_not()})"
        return f"clock within {bound_ns / _MS:.3g} ms, by {self.source}"

    @property
    def notes(self) -> tuple[str, ...]:
        """What else should be known: leap seconds, sources that contradict each other."""
        return tuple(text for note in NOTES if (text := note(self)) is not None)

    def to_json(self) -> dict[str, Any]:
        from pmutools.measure.histogram import ms  # numpy comes with it, which who only asks for the time can spare

        parts = {name: None if part is None else asdict(part) for name, part in self._parts().items()}
        return {
            "disciplined": self.disciplined,
            "source": self.source,
            "bound_ms": ms(self.bound_ns),
            "text": self.text,
            "notes": list(self.notes),
        } | parts

    def _parts(self) -> dict[str, Any]:
        return {"kernel": self.kernel, "chrony": self.chrony, "ptp": self.ptp, "gps": self.gps}

    def _promised(self) -> tuple[str, int | None]:
        if self.vouched_ns is not None:
            return "user", self.vouched_ns
        asked = (("ptp", self.ptp), ("chrony", self.chrony), ("gps", self.gps), ("kernel", self.kernel))
        for name, part in asked:
            bound = None if part is None else part.bound_ns
            if bound is not None and bound < UNDISCIPLINED_NS:
                return name, bound
        return next((name for name, part in asked if part is not None and name != "gps"), "none"), None

    def _why_not(self) -> str:
        if self.ptp is not None:
            return self.ptp.why_not or "ptp says it is not"
        if self.chrony is not None:
            return "chrony follows its own clock only" if self.chrony.local else "chrony says it is not"
        if self.kernel is None:
            return "nobody says"
        if self.kernel.synchronised and not self.kernel.told:
            return "it is set by a program that does not say how well"
        return "kernel says it is not"


def _leap(quality: ClockQuality) -> str | None:
    kernel, chrony, ptp = quality.kernel, quality.chrony, quality.ptp
    status = kernel.status if kernel is not None else 0
    told = chrony.leap_status if chrony is not None else ""
    if status & TimeStatus.INSERT_LEAP or told == "Insert second" or (ptp is not None and ptp.leap > 0):
        return "a leap second will be inserted at the end of the day: stamps around 23:59:60 are a second ambiguous"
    if status & TimeStatus.DELETE_LEAP or told == "Delete second" or (ptp is not None and ptp.leap < 0):
        return "a second will be left out at the end of the day"
    return None


def _smear(quality: ClockQuality) -> str | None:
    if quality.chrony is None or not quality.chrony.smeared:
        return None
    return (
        f"{quality.chrony.name} smears leap seconds: within 12 h of one, time by it is up to 0.5 s from UTC; "
        "GPS-fed PMUs are not"
    )


def _tai(quality: ClockQuality) -> str | None:
    kernel, ptp = quality.kernel, quality.ptp
    if kernel is None or ptp is None or ptp.utc_offset_s is None or kernel.tai_offset_s in (0, ptp.utc_offset_s):
        return None
    return f"TAI - UTC is {kernel.tai_offset_s} s to the kernel and {ptp.utc_offset_s} s to PTP: one of them is wrong"


def _pulse(quality: ClockQuality) -> str | None:
    gps, bound_ns = quality.gps, quality.bound_ns
    if gps is None or gps.clock_offset_ns is None or bound_ns is None or quality.source == "gps" or not gps.fix:
        return None
    if abs(gps.clock_offset_ns) <= bound_ns + gps.precision_ns:
        return None
    return f"the GPS pulse sees the clock {gps.clock_offset_ns / _MS:+.3g} ms off, more than {quality.source} admits"


def _serial(quality: ClockQuality) -> str | None:
    gps = quality.gps
    if gps is None or gps.serial_offset_ns is None or not gps.fix or abs(gps.serial_offset_ns) < UNDISCIPLINED_NS:
        return None
    return f"the GPS receiver's time and the system clock are {gps.serial_offset_ns / NS:+.1f} s apart"


NOTES: tuple[Callable[[ClockQuality], str | None], ...] = (_leap, _smear, _tai, _pulse, _serial)
"""Each gives a text where it applies."""


RECORDED = "a recording does not say how good its clock was"


@dataclass
class ClockLog:
    """The receiver's clock over a run: the last word, and the worst. Without samples it is that of a recording."""

    last: ClockQuality = field(default_factory=ClockQuality)
    samples: int = 0
    undisciplined: int = 0
    """Samples at which nobody could tell how wrong the clock was."""
    worst_ns: int = 0
    steps: int = 0
    """Times that the clock was set, as the caller saw it against the monotonic one."""
    largest_step_ns: int = 0

    def add(self, quality: ClockQuality) -> None:
        """Take down a sample."""
        self.last, self.samples = quality, self.samples + 1
        if quality.bound_ns is None:
            self.undisciplined += 1
        else:
            self.worst_ns = max(self.worst_ns, quality.bound_ns)

    def stepped(self, step_ns: int) -> None:
        """Take down that the clock was set by ``step_ns``."""
        self.steps += 1
        self.largest_step_ns = max(self.largest_step_ns, step_ns, key=abs)

    @property
    def bound_ns(self) -> int | None:
        """The worst bound of the run; None where there was none, or for some time."""
        return None if self.undisciplined or not self.samples else self.worst_ns

    @property
    def why(self) -> str:
        """Whose word :attr:`bound_ns` is, or why there is none."""
        return self.last.text if self.samples else RECORDED

    def to_json(self) -> dict[str, Any]:
        from pmutools.measure.histogram import ms

        unasked = {"text": f"{RECORDED}: delays hold its offset, differences of delays do not"}
        return (
            self.last.to_json()
            | ({} if self.samples else unasked)
            | {
                "samples": self.samples,
                "undisciplined_samples": self.undisciplined,
                "worst_bound_ms": ms(self.bound_ns),
                "steps": self.steps,
                "largest_step_ms": ms(self.largest_step_ns),
            }
        )
