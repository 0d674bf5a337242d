"""Time on the wire and in files: SOC + FRACSEC/TIME_BASE <-> int64 nanoseconds of POSIX UTC, slots, ISO-8601.

Times stay POSIX UTC: an inserted leap second repeats a value, and only the leap flags of the frame tell the two
apart (C37.118.2-2011 clause 6.2.2). Everything here is exact integer arithmetic; float64 resolves 0.24 µs today.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # columns bring their own operations: nothing here needs numpy to be imported
    import numpy as np
    import numpy.typing as npt

NS = 1_000_000_000
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_ISO = re.compile(r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d:\d\d)(?:[.,](\d{1,9}))?\s*(Z|[+-]\d\d:?\d\d)?", re.ASCII)


def to_ns(soc: int, fracsec: int, time_base: int) -> int:
    """Nanoseconds since 1970-01-01 UTC of a stamp, rounded half up; ``time_base`` is ticks per second (> 0)."""
    return soc * NS + (fracsec * NS + time_base // 2) // time_base


def from_ns(time_ns: int, time_base: int) -> tuple[int, int]:
    """(SOC, FRACSEC) nearest to ``time_ns``; a fraction that rounds up to a whole second becomes SOC + 1, 0."""
    soc, frac_ns = divmod(time_ns, NS)
    fracsec = (frac_ns * time_base + NS // 2) // NS
    return (soc + 1, 0) if fracsec >= time_base else (soc, fracsec)


def to_ns_array(
    soc: npt.NDArray[np.unsignedinteger], fracsec: npt.NDArray[np.unsignedinteger], time_base: int
) -> npt.NDArray[np.int64]:
    """:func:`to_ns` over columns of shape (N,)."""
    fraction_ns = (fracsec.astype("i8") * NS + time_base // 2) // time_base
    time_ns: npt.NDArray[np.int64] = soc.astype("i8") * NS + fraction_ns
    return time_ns


def from_ns_array(
    time_ns: npt.NDArray[np.int64], time_base: int | npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """:func:`from_ns` over a column of shape (N,); one time base, or (N,)."""
    soc, frac_ns = divmod(time_ns, NS)
    fracsec = (frac_ns * time_base + NS // 2) // NS
    carry = fracsec >= time_base
    return soc + carry, fracsec * ~carry


def slot(time_ns: int, rate: Fraction) -> int:
    """Index of the reporting instant nearest to ``time_ns``; instant k is k/rate seconds after 1970 (frames/s).

    Devices round or truncate FRACSEC, so stamps are snapped to the grid and never compared for equality.
    """
    scaled = time_ns * rate.numerator
    period = rate.denominator * NS
    return (scaled + period // 2) // period


def slot_time_ns(index: int, rate: Fraction) -> int:
    """Time of reporting instant ``index`` at ``rate`` frames/s, rounded half up to a nanosecond."""
    return (index * rate.denominator * NS + rate.numerator // 2) // rate.numerator


def format_utc(time_ns: int) -> str:
    """ISO-8601 UTC with nanoseconds, e.g. ``2016-09-08T17:05:11.016667000Z``."""
    seconds, fraction = divmod(time_ns, NS)
    return f"{_EPOCH + timedelta(seconds=seconds):%Y-%m-%dT%H:%M:%S}.{fraction:09d}Z"


def parse_utc(text: str) -> int:
    """Nanoseconds of an ISO-8601 time; no zone means UTC. Raises ValueError for anything else."""
    match = _ISO.fullmatch(text.strip())
    if match is None:
        raise ValueError(f"not an ISO-8601 time: {text!r} (as in 2016-09-08T17:05:11.25Z)")
    day, clock, fraction, zone = match.groups()
    moment = datetime.fromisoformat(f"{day}T{clock}{zone if zone and zone != 'Z' else '+00:00'}")
    return (moment - _EPOCH) // timedelta(seconds=1) * NS + int((fraction or "").ljust(9, "0"))


def slots_array(time_ns: npt.NDArray[np.int64], rate: Fraction) -> npt.NDArray[np.int64]:
    """:func:`slot` over a column of shape (N,), for a whole number of frames per second or of seconds per frame."""
    soc, frac_ns = divmod(time_ns, NS)
    slots: npt.NDArray[np.int64]
    if rate.denominator == 1:
        slots = soc * rate.numerator + (frac_ns * rate.numerator + NS // 2) // NS
    else:
        slots = (soc + (frac_ns >= NS // 2) + rate.denominator // 2) // rate.denominator
    return slots


def slot_times_array(slots: npt.NDArray[np.int64], rate: Fraction) -> npt.NDArray[np.int64]:
    """:func:`slot_time_ns` over a column of shape (N,), at a rate as in slots_array."""
    times: npt.NDArray[np.int64]
    if rate.denominator == 1:
        seconds, rest = divmod(slots, rate.numerator)
        times = seconds * NS + (rest * NS + rate.numerator // 2) // rate.numerator
    else:
        times = slots * (rate.denominator * NS)
    return times


def grid_offset_array(time_ns: npt.NDArray[np.int64], rate: Fraction) -> npt.NDArray[np.int64]:
    """Signed distance in ns of each stamp (N,) from its nearest reporting instant, at a rate as in slots_array."""
    frac_ns = time_ns % NS
    offset: npt.NDArray[np.int64]
    if rate.denominator == 1:
        nearest = (frac_ns * rate.numerator + NS // 2) // NS
        offset = frac_ns - (nearest * NS + rate.numerator // 2) // rate.numerator
    else:
        offset = time_ns - slots_array(time_ns, rate) * rate.denominator * NS
    return offset
