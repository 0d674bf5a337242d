"""What each of those says who can tell how good the receiver's clock is: the kernel, chrony, PTP, gpsd.

Asking them is :mod:`pmutools.clocksources`. A bound is what a source promises, not what it hopes for.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag
from ipaddress import ip_address, ip_network

from pmutools.timebase import NS

BOUNDS = {
    "ptp": "abs(offset from the master) + mean path delay (what a path is wrong by that is all delay one way and none "
    "the other) + the grandmaster's own accuracy + abs(system clock less network card's clock)",
    "chrony": "abs(system time correction) + root dispersion + root delay / 2",
    "gps": "abs(system clock less pulse per second) + what a time stamp of the pulse is good for",
    "kernel": "``maxerror`` of ``adjtimex``, where it is synchronised and an error was told to it",
}
"""The bounds, who knows best first."""
MAXERROR_GROWTH_US = 500
"""A second, is what the kernel adds to ``maxerror`` while nobody tells it better (500 ppm)."""
PULSE_NS = 1_000
"""What the kernel's stamp of a pulse per second is good for, where nobody says."""
LOCAL_REFERENCE = "7F7F01"
"""Reference IDs 127.127.1.x: chrony's ``local``, its own clock and nobody else's."""
SMEARED = tuple(
    map(
        ip_network,
        (
            "216.239.35.0/28",
            "2001:4860:4806::/60",
            "169.254.169.123/32",
            "fd00:ec2::123/128",
            "129.134.25.123/32",
            "129.134.26.123/32",
            "129.134.27.123/32",
            "129.134.28.123/32",
            "129.134.29.123/32",
        ),
    )
)
"""Public time servers whose operators say that they smear leap seconds: Google, Amazon, Meta."""


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
    def told(self) -> bool:
        """Whether an error was told to the kernel, as chrony and ntpd do.

        systemd-timesyncd and linuxptp set ``maxerror`` to 0 however far the clock is off, and the kernel then adds
        500 µs a second: such a figure says when the clock was last set, not how well.
        """
        return self.maxerror_us % MAXERROR_GROWTH_US != 0 or 0 < self.esterror_us <= self.maxerror_us

    @property
    def bound_ns(self) -> int | None:
        return self.maxerror_us * 1000 if self.synchronised and self.told else None


@dataclass(frozen=True, slots=True)
class ChronyClock:
    """What ``chronyc tracking`` says; ``correction_s`` > 0: the clock is slow."""

    reference: str
    """Reference ID, eight hexadecimal digits."""
    stratum: int
    correction_s: float
    rms_offset_s: float
    frequency_ppm: float
    skew_ppm: float
    root_delay_s: float
    root_dispersion_s: float
    leap_status: str = "Normal"
    name: str = ""
    """Address or name of the reference."""
    reference_time_s: float = 0.0
    """POSIX UTC of the last measurement."""

    @property
    def synchronised(self) -> bool:
        return self.leap_status != "Not synchronised" and not self.local

    @property
    def local(self) -> bool:
        """Whether chrony follows its own clock only: it then promises an error of 0, from itself."""
        return self.reference.upper().startswith(LOCAL_REFERENCE)

    @property
    def smeared(self) -> bool:
        """Whether the reference is known to smear leap seconds; that it is not known says nothing."""
        try:
            address = ip_address(self.name)
        except ValueError:
            return False
        return any(address in network for network in SMEARED)

    @property
    def bound_ns(self) -> int | None:
        if not self.synchronised:
            return None
        return round((abs(self.correction_s) + self.root_dispersion_s + self.root_delay_s / 2) * NS)


@dataclass(frozen=True, slots=True)
class PtpClock:
    """What ``pmc`` says of ptp4l, and how far the system's clock is from the one that ptp4l steers."""

    grandmaster: str
    clock_class: int
    """6 locked to a primary reference, 7 in holdover; others do not promise UTC."""
    master_offset_ns: int
    mean_path_delay_ns: int
    utc_offset_s: int | None = None
    """TAI - UTC; None where the grandmaster calls it not valid."""
    system_offset_ns: int | None = None
    """System clock less the clock that ptp4l steers: 0 with software stamps, None where it could not be read."""
    state: str = "SLAVE"
    """Of the port that follows a master. What ptp4l says of offset and grandmaster is old news in other states."""
    accuracy_ns: int | None = None
    """The grandmaster's, where it says."""
    ptp_timescale: bool = True
    """False: the grandmaster's time is its own, not TAI."""
    leap: int = 0
    """1 or -1: a second will be inserted or left out at the end of the day."""

    @property
    def why_not(self) -> str:
        """Why it promises nothing; empty where it does."""
        if self.state != "SLAVE":
            return f"ptp4l's port is {self.state}, it follows no master"
        if self.clock_class not in (6, 7):
            return f"grandmaster {self.grandmaster} has clock class {self.clock_class}, not 6 or 7: it promises no UTC"
        if not self.ptp_timescale:
            return f"grandmaster {self.grandmaster} has a timescale of its own"
        if self.system_offset_ns is None:
            return "how far the system clock is from the network card's cannot be read"
        return ""

    @property
    def bound_ns(self) -> int | None:
        if self.why_not or self.system_offset_ns is None:
            return None
        offsets = abs(self.master_offset_ns) + abs(self.system_offset_ns)
        return offsets + self.mean_path_delay_ns + (self.accuracy_ns or 0)


@dataclass(frozen=True, slots=True)
class GpsClock:
    """What gpsd says: TPV's mode (2 and 3 have a fix) and time uncertainty, and the system clock seen against it."""

    mode: int
    time_error_s: float | None = None
    """Of the receiver's time: how good the time is that it has to offer."""
    pps: bool = False
    clock_offset_ns: int | None = None
    """System clock less the pulse per second (PPS); None where there is no pulse."""
    precision_ns: int = PULSE_NS
    """What one stamp of the pulse is good for."""
    serial_offset_ns: int | None = None
    """System clock less time of the receiver's message (TOFF): holds the message's own lateness, 0.1 to 0.6 s."""
    satellites: int | None = None
    """Those that the fix is made of."""

    @property
    def fix(self) -> bool:
        return self.mode >= 2

    @property
    def bound_ns(self) -> int | None:
        """Of the system clock: None without a pulse, as then nobody has compared the two."""
        if not self.fix or self.clock_offset_ns is None:
            return None
        return abs(self.clock_offset_ns) + self.precision_ns
