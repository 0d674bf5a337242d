"""Flags and fields of STAT and time quality, read as the standard's tables lay them out."""

from __future__ import annotations

import pytest

from pmutools.c37118 import Prefix, Stat
from pmutools.c37118.constants import (
    Command,
    DataError,
    FrameType,
    LeapFlag,
    TimeQuality,
    TriggerReason,
    command_name,
    stat_data_error,
    stat_pmu_tq,
    stat_trigger_reason,
    stat_unlocked_time,
    time_quality_error_ns,
)


def test_stat_of_a_real_unlocked_device() -> None:
    stat = 0x21F0  # "Reporting1": not synchronised, PMU_TQ 7, unlocked for 1000 s or more, data good
    assert Stat(stat) & Stat.NOT_SYNCHRONISED
    assert stat_data_error(stat) is DataError.GOOD
    assert (stat_pmu_tq(stat), stat_unlocked_time(stat), stat_trigger_reason(stat)) == (7, 3, TriggerReason.MANUAL)


@pytest.mark.parametrize("bits", range(4))
def test_data_error_is_the_two_upper_bits(bits: int) -> None:
    assert stat_data_error(bits << 14 | 0x3FFF) == bits


@pytest.mark.parametrize(("code", "error_ns"), [(0, 0), (1, 1), (4, 1000), (0xB, 10**10), (0xC, None), (0xF, None)])
def test_time_quality_is_a_power_of_ten(code: int, error_ns: int | None) -> None:
    assert time_quality_error_ns(code) == error_ns


def test_time_quality_byte() -> None:
    prefix = Prefix(0xAA01, 16, 1, 0, 0x5F, 0)
    assert prefix.leap == LeapFlag.PENDING | LeapFlag.DIRECTION_DELETE
    assert prefix.msg_tq is TimeQuality.FAILED
    assert prefix._replace(time_quality=0xC).msg_tq == 0xC, "undefined codes stay numbers"


def test_sync_words_of_2011() -> None:
    assert [kind.sync for kind in FrameType] == [0xAA01, 0xAA11, 0xAA21, 0xAA31, 0xAA41, 0xAA52]


def test_every_command_code_has_a_name() -> None:
    names = {command_name(code) for code in range(0x10000)}
    assert len(names) == 0x10000
    assert command_name(Command.SEND_CFG3) == "send_cfg3"
    assert command_name(0x0123) == "user-0x0123"
    assert command_name(0x0007) == "reserved-0x0007"
