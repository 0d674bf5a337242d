"""How good the receiver's clock is: what the kernel, chrony, PTP and gpsd say of it, as one bound.

Reading them is the caller's. A bound is what a source promises, not what it hopes for: chrony's is |system time
correction| + root dispersion + root delay / 2, the kernel's is ``maxerror``.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from enum import IntFlag
from typing import Any

from pmutools.measure.histogram import NS_PER_MS, ms

TAI_LESS_UTC_S = 37
"""Since 2017; 36 or 38 are told apart from it by the table of diagnoses, should a leap second come."""
UNDISCIPLINED_NS = 1_000_000_000
"""A bound beyond this is none."""


class TimeStatus(IntFlag):
    """Bits of the kernel's ``timex.status`` that matter here."""

    PLL = 0x0001
    INSERT_LEAP = 0x0010
    DELETE_LEAP = 0x0020
    UNSYNCHRONISED = 0x0040
    PPS_SIGNAL = 0x0100
    NANOSECONDS = 0x2000


@dataclass(frozen=True, slots=True)
class KernelClock:
    """What ``adjtimex`` says."""

    offset_ns: int
    frequency_ppm: float
    maxerror_us: int
    esterror_us: int
    status: int
    tai_offset_s: int = 0
    """0 where nobody told the kernel."""

    @property
    def synchronised(self) -> bool:
        return not self.status & TimeStatus.UNSYNCHRONISED

    @property
    def bound_ns(self) -> int | None:
        return self.maxerror_us * 1000 if self.synchronised else None


@dataclass(frozen=True, slots=True)
class ChronyClock:
    """What ``chronyc tracking`` says; ``correction_s`` > 0: the clock is slow."""

    reference: str
    stratum: int
    correction_s: float
    rms_offset_s: float
    frequency_ppm: float
    skew_ppm: float
    root_delay_s: float
    root_dispersion_s: float
    leap_status: str = "Normal"

    @property
    def bound_ns(self) -> int | None:
        if self.leap_status == "Not synchronised":
            return None
        return round((abs(self.correction_s) + self.root_dispersion_s + self.root_delay_s / 2) * 1e9)


@dataclass(frozen=True, slots=True)
class PtpClock:
    """What ``pmc`` says of the port, and ``phc2sys`` of the system's clock against it."""

    grandmaster: str
    clock_class: int
    """6 locked, 7 in holdover."""
    master_offset_ns: int
    mean_path_delay_ns: int
    utc_offset_s: int | None = None
    system_offset_ns: int = 0

    @property
    def bound_ns(self) -> int | None:
        if self.clock_class not in (6, 7, 13, 14):
            return None
        return abs(self.master_offset_ns) + abs(self.system_offset_ns) + self.mean_path_delay_ns // 2


@dataclass(frozen=True, slots=True)
class GpsClock:
    """What gpsd says: TPV's mode (2 and 3 have a fix) and time uncertainty."""

    mode: int
    time_error_s: float | None = None
    pps: bool = False

    @property
    def bound_ns(self) -> int | None:
        if self.mode < 2:
            return None
        return None if self.time_error_s is None else round(self.time_error_s * 1e9)


@dataclass(frozen=True, slots=True)
class ClockQuality:
    """The receiver's clock at one moment, by all who could be asked."""

    kernel: KernelClock | None = None
    chrony: ChronyClock | None = None
    ptp: PtpClock | None = None
    gps: GpsClock | None = None

    @property
    def bound_ns(self) -> int | None:
        """How wrong the clock may be; None where nobody can tell.

        Who disciplines the clock knows best: PTP, then chrony, then the kernel's own figure. gpsd alone says how good
        the time is that it has to offer, not whether the clock follows it.
        """
        for source in (self.ptp, self.chrony, self.kernel):
            if source is not None:
                bound = source.bound_ns
                return bound if bound is not None and bound < UNDISCIPLINED_NS else None
        return None

    @property
    def source(self) -> str:
        """Whose word :attr:`bound_ns` is."""
        named = (("ptp", self.ptp), ("chrony", self.chrony), ("kernel", self.kernel))
        return next((name for name, source in named if source is not None), "none")

    @property
    def disciplined(self) -> bool:
        return self.bound_ns is not None

    @property
    def text(self) -> str:
        if (bound_ns := self.bound_ns) is None:
            who = "nobody says" if self.source == "none" else f"{self.source} says it is not"
            return (
                f"receiver clock not disciplined ({who}); delays hold its unknown offset, differences of delays do not"
            )
        return f"receiver clock within {bound_ns / NS_PER_MS:.3g} ms of UTC, by {self.source}"

    def to_json(self) -> dict[str, Any]:
        parts = {name: None if part is None else asdict(part) for name, part in self._parts().items()}
        return {
            "disciplined": self.disciplined,
            "source": self.source,
            "bound_ms": ms(self.bound_ns),
            "text": self.text,
        } | parts

    def _parts(self) -> dict[str, Any]:
        return {"kernel": self.kernel, "chrony": self.chrony, "ptp": self.ptp, "gps": self.gps}


@dataclass
class ClockLog:
    """The receiver's clock over a run: the last word, and the worst."""

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

    def to_json(self) -> dict[str, Any]:
        return self.last.to_json() | {
            "samples": self.samples,
            "undisciplined_samples": self.undisciplined,
            "worst_bound_ms": ms(self.bound_ns),
            "steps": self.steps,
            "largest_step_ms": ms(self.largest_step_ns),
        }
