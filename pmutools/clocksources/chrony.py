"""chrony, the usual NTP client: ``chronyc -c tracking``, one line of 14 fields, which anyone on the machine may ask."""

from __future__ import annotations

import math
from typing import NamedTuple

from pmutools.clocksources.asking import NoAnswer, Patience, ask, shortened
from pmutools.measure.clocks import ChronyClock

FIELDS = (
    "reference ID",
    "name",
    "stratum",
    "reference time",
    "system time correction",
    "last offset",
    "RMS offset",
    "frequency",
    "residual frequency",
    "skew",
    "root delay",
    "root dispersion",
    "update interval",
    "leap status",
)
LEAPS = ("Normal", "Insert second", "Delete second", "Not synchronised")
PATIENCE_S = 2.0


class Chronyd(NamedTuple):
    """Where chronyd takes questions; without a port, wherever ``chronyc`` looks for it."""

    host: str = "127.0.0.1"
    port: int | None = None

    @property
    def options(self) -> list[str]:
        return [] if self.port is None else ["-h", self.host, "-p", str(self.port)]


CHRONYD = Chronyd()


def ask_chrony(chronyc: str, chronyd: Chronyd, patience: Patience) -> ChronyClock:
    """Ask chronyd by ``chronyc``, a path. Raises NoAnswer."""
    answer = ask([chronyc, "-c", *chronyd.options, "tracking"], patience.at_most(PATIENCE_S))
    if "Cannot talk to daemon" in answer:
        raise NoAnswer("chronyd does not run, or takes no questions")
    try:
        return parse_tracking(answer)
    except ValueError as error:
        raise NoAnswer(str(error)) from None


def parse_tracking(text: str) -> ChronyClock:
    """The report in ``text``, other lines are passed over. Raises ValueError where there is none.

    Later versions may add fields at the end.
    """
    rows = [row for line in text.splitlines() if len(row := line.strip().split(",")) >= len(FIELDS)]
    if not rows:
        raise ValueError(f"chronyc gave no tracking report: {shortened(text) or 'nothing'}")
    said = dict(zip(FIELDS, rows[-1], strict=False))
    leap = said["leap status"]
    if leap not in LEAPS:
        raise ValueError(f"chronyc: leap status {shortened(leap)!r} is none of {', '.join(LEAPS)}")
    return ChronyClock(
        reference=said["reference ID"].upper(),
        stratum=int(_number(said, "stratum")),
        correction_s=_number(said, "system time correction"),
        rms_offset_s=_number(said, "RMS offset"),
        frequency_ppm=_number(said, "frequency"),
        skew_ppm=_number(said, "skew"),
        root_delay_s=_number(said, "root delay"),
        root_dispersion_s=_number(said, "root dispersion"),
        leap_status=leap,
        name=said["name"],
        reference_time_s=_number(said, "reference time"),
    )


def _number(said: dict[str, str], field: str) -> float:
    try:
        value = float(said[field])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"chronyc: {field} {shortened(said[field])!r} is no number")
    return value
