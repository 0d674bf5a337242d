"""Numbers and flags of IEEE C37.118.2-2011, named as the standard names them.

Clause and table numbers in this package refer to C37.118.2-2011 unless another document is named.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag

SYNC = 0xAA
PREFIX_SIZE = 14
CHK_SIZE = 2
FIRST_IDCODE, LAST_IDCODE = 1, 65534
"""0 means none, 65535 is reserved."""
MIN_FRAME_SIZE = PREFIX_SIZE + CHK_SIZE
MAX_FRAME_SIZE = 0xFFFF
NAME_SIZE = 16
"""Bytes of a station or channel name in CFG-1 and CFG-2."""
LABELS_PER_WORD = 16
TIME_BASE_MASK = 0x00FF_FFFF
TCP_PORT = 4712
UDP_PORT = 4713


class FrameType(IntEnum):
    """Bits 6-4 of the second SYNC byte (Table 2)."""

    DATA = 0
    HEADER = 1
    CFG1 = 2
    CFG2 = 3
    COMMAND = 4
    CFG3 = 5

    @property
    def is_config(self) -> bool:
        return self in _CONFIGS

    @property
    def rules_data(self) -> bool:
        """Whether it is the configuration that data are sent by; CFG-1 says what a device could send."""
        return self in _IN_FORCE

    @property
    def version(self) -> int:
        """The version nibble a 2011 sender writes: 2 for CFG-3 only."""
        return 2 if self is FrameType.CFG3 else 1

    @property
    def sync(self) -> int:
        """The SYNC word a 2011 sender writes, e.g. 0xAA01 for a data frame."""
        return SYNC << 8 | self << 4 | self.version


_IN_FORCE = frozenset((FrameType.CFG2, FrameType.CFG3))
_CONFIGS = _IN_FORCE | {FrameType.CFG1}


class Command(IntEnum):
    """CMD field of a command frame (Table 15)."""

    STOP_DATA = 0x0001
    START_DATA = 0x0002
    SEND_HEADER = 0x0003
    SEND_CFG1 = 0x0004
    SEND_CFG2 = 0x0005
    SEND_CFG3 = 0x0006
    EXTENDED = 0x0008


def command_name(code: int) -> str:
    """Lower-case name of a CMD code: a member of :class:`Command`, ``user-0x0123`` or ``reserved-0x0007``."""
    try:
        return Command(code).name.lower()
    except ValueError:
        return f"{'user' if 0x0100 <= code <= 0x0FFF else 'reserved'}-{code:#06x}"


class Format(IntFlag):
    """FORMAT of a PMU block (Table 9); a cleared bit means 16-bit integer, or rectangular."""

    POLAR = 1
    PHASOR_FLOAT = 2
    ANALOG_FLOAT = 4
    FREQ_FLOAT = 8


class Stat(IntFlag):
    """Single-bit flags of STAT (Table 7); the fields between them are read by the functions below."""

    DATA_ERROR_HIGH = 0x8000
    DATA_ERROR_LOW = 0x4000
    NOT_SYNCHRONISED = 0x2000
    SORTED_BY_ARRIVAL = 0x1000
    TRIGGER = 0x0800
    CONFIG_CHANGE = 0x0400
    DATA_MODIFIED = 0x0200


class DataError(IntEnum):
    """STAT bits 15-14."""

    GOOD = 0
    PMU_ERROR = 1
    TEST_OR_ABSENT = 2
    DO_NOT_USE = 3


class TriggerReason(IntEnum):
    """STAT bits 3-0; 8 to 15 are user-defined."""

    MANUAL = 0
    MAGNITUDE_LOW = 1
    MAGNITUDE_HIGH = 2
    PHASE_ANGLE_DIFFERENCE = 3
    FREQUENCY = 4
    ROCOF = 5
    RESERVED = 6
    DIGITAL = 7


STAT_DATA_ERROR_MASK = 0xC000
STAT_ABSENT = 0x8000
"""Data error 10: test mode, or the filler of a concentrator that has no data for this PMU."""


def stat_data_error(stat: int) -> DataError:
    """Data error, bits 15-14."""
    return DataError(stat >> 14 & 3)


def stat_pmu_tq(stat: int) -> int:
    """PMU_TQ, bits 8-6: 0 not used, 1 < 100 ns ... 6 < 10 ms, 7 worse or unknown."""
    return stat >> 6 & 7


def stat_unlocked_time(stat: int) -> int:
    """Bits 5-4: 0 locked or < 10 s, 1 < 100 s, 2 < 1000 s, 3 longer."""
    return stat >> 4 & 3


def stat_trigger_reason(stat: int) -> int:
    """Trigger reason, bits 3-0; see :class:`TriggerReason`."""
    return stat & 0xF


class LeapFlag(IntFlag):
    """Upper bits of the time quality byte (Table 3)."""

    DIRECTION_DELETE = 0x40
    OCCURRED = 0x20
    PENDING = 0x10


class TimeQuality(IntEnum):
    """MSG_TQ, the low nibble of the time quality byte: worst-case error against UTC (Table 4)."""

    LOCKED = 0x0
    WITHIN_1_NS = 0x1
    WITHIN_10_NS = 0x2
    WITHIN_100_NS = 0x3
    WITHIN_1_US = 0x4
    WITHIN_10_US = 0x5
    WITHIN_100_US = 0x6
    WITHIN_1_MS = 0x7
    WITHIN_10_MS = 0x8
    WITHIN_100_MS = 0x9
    WITHIN_1_S = 0xA
    WITHIN_10_S = 0xB
    FAILED = 0xF


def time_quality_error_ns(code: int) -> int | None:
    """Worst-case clock error in ns of a MSG_TQ code; 0 for locked, None for failed or undefined codes."""
    if code == 0:
        return 0
    return 10 ** (code - 1) if code <= TimeQuality.WITHIN_10_S else None


class AnalogKind(IntEnum):
    """Top byte of ANUNIT (Table 11); 5 to 64 reserved, 65 to 255 user-defined."""

    POINT_ON_WAVE = 0
    RMS = 1
    PEAK = 2


class PhasorComponent(IntEnum):
    """Bits 2-0 of the PHSCALE type byte of CFG-3 (Table 14)."""

    ZERO_SEQUENCE = 0
    POSITIVE_SEQUENCE = 1
    NEGATIVE_SEQUENCE = 2
    PHASE_A = 4
    PHASE_B = 5
    PHASE_C = 6


PHSCALE_CURRENT = 0x08
FNOM_50_HZ = 0x0001
INT16_FILLER = -0x8000
