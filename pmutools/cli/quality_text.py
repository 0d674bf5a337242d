"""STAT and the time quality byte in words."""

from __future__ import annotations

from pmutools.c37118.constants import (
    DataError,
    LeapFlag,
    Stat,
    TriggerReason,
    stat_data_error,
    stat_pmu_tq,
    stat_trigger_reason,
    stat_unlocked_time,
    time_quality_error_ns,
)

ERRORS = {
    DataError.PMU_ERROR: "PMU error",
    DataError.TEST_OR_ABSENT: "test mode or absent",
    DataError.DO_NOT_USE: "do not use",
}
FLAGS = {
    Stat.NOT_SYNCHRONISED: "not synchronised",
    Stat.SORTED_BY_ARRIVAL: "sorted by arrival",
    Stat.CONFIG_CHANGE: "configuration will change",
    Stat.DATA_MODIFIED: "data modified",
}
PMU_TQ = ("", "<100 ns", "<1 us", "<10 us", "<100 us", "<1 ms", "<10 ms", ">10 ms or unknown")
UNLOCKED = ("", "unlocked 10 s", "unlocked 100 s", "unlocked 1000 s")
UNITS = ("ns", "us", "ms", "s")


def stat_text(stat: int) -> str:
    """What STAT says beyond that all is well."""
    words = [ERRORS[error]] if (error := stat_data_error(stat)) else []
    words += [text for flag, text in FLAGS.items() if stat & flag]
    if stat & Stat.TRIGGER:
        reason = stat_trigger_reason(stat)
        name = TriggerReason(reason).name.lower().replace("_", " ") if reason < 8 else f"user-defined {reason}"
        words.append(f"trigger: {name}")
    if unlocked := UNLOCKED[stat_unlocked_time(stat)]:
        words.append(unlocked)
    if quality := PMU_TQ[stat_pmu_tq(stat)]:
        words.append(f"time {quality}")
    return ", ".join(words) or "ok"


def time_quality_text(octet: int) -> str:
    """MSG_TQ and the leap second flags."""
    error_ns = time_quality_error_ns(octet & 0xF)
    if error_ns is None:
        text = "clock failed" if octet & 0xF == 0xF else f"undefined {octet & 0xF:X}"
    elif error_ns == 0:
        text = "locked"
    else:
        thousands = (len(str(error_ns)) - 1) // 3
        text = f"<{error_ns // 1000**thousands} {UNITS[thousands]}"
    if octet & LeapFlag.PENDING:
        text += f", leap second {'deletion' if octet & LeapFlag.DIRECTION_DELETE else 'insertion'} pending"
    return text + (", leap second occurred" if octet & LeapFlag.OCCURRED else "")
