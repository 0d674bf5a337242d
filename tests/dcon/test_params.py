from __future__ import annotations

import math
from dataclasses import fields

import pytest
from support.loop import params

from dcon.core.params import Pair, Params, PmuParams, Thresholds
from pmutools.errors import SettingsError


def test_sixteen_instances_in_order_of_priority() -> None:
    names = params().instance_names
    assert len(names) == 16
    assert names[:5] == ("N1-S1", "N1-S2", "N1-S3", "N1-S4", "N2-S1")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gain_mw_per_mhz": 15.1}, "gain_mw_per_mhz = 15.1: must be 0 to 15 MW/mHz"),
        ({"gain_mw_per_mhz": -1}, "gain_mw_per_mhz = -1: must be 0"),
        ({"limit_mw": 126}, "limit_mw = 126: must be 0 to 125 MW"),
        ({"deadband_mhz": math.nan}, "deadband_mhz = nan"),
        ({"rate_hz": "60"}, "rate_hz = '60'"),
        ({"transfer_s": 0.1}, "transfer_s = 0.1: must be 0.2 to 60 s"),
        ({"min_ready": True}, "min_ready = True"),
    ],
)
def test_a_setting_out_of_bounds_is_one_line(settings: dict[str, object], message: str) -> None:
    with pytest.raises(SettingsError, match=r"^[^\n]*$") as caught:
        params(**settings)
    assert message in str(caught.value)


def test_instances_that_cannot_be() -> None:
    pmus = (PmuParams("N1"), PmuParams("S1"))
    for instances in ((), (Pair(0, 2),), (Pair(1, 1),), (Pair(0, 1), Pair(0, 1))):
        with pytest.raises(SettingsError):
            Params(pmus, instances)
    with pytest.raises(SettingsError, match="two PMUs of one name"):
        Params((PmuParams("N1"), PmuParams("N1")), (Pair(0, 1),))


def test_thresholds_are_bounded_too() -> None:
    with pytest.raises(SettingsError, match="alignment_skew_frames = 40"):
        Thresholds(alignment_skew_frames=40)


def test_every_number_has_unit_bounds_and_source() -> None:
    for table in (Params, Thresholds):
        for item in fields(table):
            if item.type in ("float", "int"):
                assert {"unit", "low", "high", "source"} <= set(item.metadata), item.name


def test_a_slower_stream_has_a_longer_gap() -> None:
    assert params().gap_ns == 50e6
    assert params(rate_hz=30).gap_ns == 100e6
