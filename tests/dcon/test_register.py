"""The flag register: what it keeps of each check, latches and acknowledgements, in the log too."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from support.rig import Rig, Signal, steady
from support.sessions import log_tick, open_session

from dcon.core.register import NO_FLAGS, acknowledged, fallen, latched, open_flags, risen, still_up, with_changes
from dcon.core.values import Event, Flag, Order, Surroundings
from dcon.session.reader import SessionReader

T = 1_700_000_000_000_000_000


def test_a_flag_rises_falls_and_rises() -> None:
    first = risen(NO_FLAGS, "voltage", "N1", T, 1.3, 1.2)
    assert first == Flag("voltage", "N1", True, T, T, 1, 1.3, 1.2, False, "")
    register = with_changes(NO_FLAGS, [acknowledged(fallen(first, T + 5), "Ada")])
    assert register["voltage", "N1"] == first._replace(up=False, last_ns=T + 5, acknowledged="Ada")
    again = risen(register, "voltage", "N1", T + 9, 0.7, 0.8)
    assert again == Flag("voltage", "N1", True, T, T + 9, 2, 0.7, 0.8, False, "")  # nobody has seen this one
    assert NO_FLAGS == {} and with_changes(register, []) is register


@pytest.mark.parametrize("order", ["fall, see", "see, fall"])
def test_a_latch_is_off_once_the_flag_is_down_and_seen(order: str) -> None:
    flag = risen(NO_FLAGS, "ringing", "system", T)._replace(latched=True)
    if order == "fall, see":
        down = fallen(flag, T + 1)
        assert down.latched and latched({("ringing", "system"): down}) == ["ringing"]
        assert not acknowledged(down, "Ada").latched
    else:
        seen = acknowledged(flag, "Ada")
        assert seen.latched and not fallen(seen, T + 1).latched
        assert still_up({("ringing", "system"): seen}) == ["ringing"]
        assert latched({("ringing", "system"): seen}) == still_up({("ringing", "system"): flag}) == []


def test_what_an_acknowledgement_means() -> None:
    flags = [
        risen(NO_FLAGS, name, subject, T) for name, subject in (("frozen", "N1"), ("frozen", "S1"), ("bias", "system"))
    ]
    register = with_changes(NO_FLAGS, flags)
    assert [open_flags(register, text) for text in ("", "frozen", "frozen S1", "bias", "frozen N9", "rocof")] == [
        *(flags, flags[:2], flags[1:2], flags[2:], [], [])
    ]
    assert open_flags(with_changes(register, [acknowledged(flags[0], "A")]), "frozen") == flags[1:2]


TOLD = Surroundings(gps_age_s=9.0)


def test_a_check_that_disarmed_must_be_seen_before_the_next_arming() -> None:
    rig = Rig(steady()).arm().run(70)
    rig.tick(told=TOLD)
    assert rig.records[-1].state == "RAMPDOWN"
    flag = rig.flag("gps")
    assert flag == Flag("gps", "system", True, flag.last_ns, rig.records[-1].tick_ns, 1, 9.0, 5.0, True, "")
    rig.run(70)
    assert rig.records[-1].state == "STANDBY" and not rig.flag("gps").up and rig.flag("gps").latched
    assert Event("refused", "arm", "what disarmed or tripped last is not acknowledged") in rig.tick(Order("arm")).events
    record = rig.tick(Order("ack", who="Ada"))
    assert Event("ack", "system", "gps by Ada") in record.events
    assert rig.flag("gps").acknowledged == "Ada" and not rig.flag("gps").latched
    assert rig.tick(Order("arm", who="Ada")).events == (Event("armed", "system", "order by Ada"),)


def test_what_is_acknowledged_and_still_up_is_refused_as_that() -> None:
    sick = Surroundings(disk_free_percent=50.0, gps_age_s=9.0)
    rig = Rig(steady()).arm().run(70)
    rig.tick(told=sick)
    rig.run(70, sick)
    assert rig.records[-1].state == "STANDBY" and rig.flag("gps").up
    assert "gps by Ada" in [event.detail for event in rig.tick(Order("ack", who="Ada"), told=sick).events]
    (refused,) = [event.detail for event in rig.tick(Order("arm"), told=sick).events if event.name == "refused"]
    assert "what disarmed or tripped last is acknowledged, but still up" in refused and "is not ack" not in refused
    rig.run(5)
    assert rig.tick(Order("arm")).state == "ARMED"


def test_a_check_that_was_up_without_acting_needs_no_acknowledgement() -> None:
    rig = Rig(steady()).run(20, TOLD).run(5)
    assert rig.flag("gps").times == 1 and not rig.flag("gps").latched
    assert rig.tick(Order("arm")).state == "ARMED"


def test_a_trip_is_left_only_once_its_cause_is_gone() -> None:
    sick = Surroundings(watchdog_healthy=False)
    rig = Rig(steady()).arm().run(60).run(1, sick)
    assert rig.records[-1].state == "FAULT" and rig.records[-1].output_v == 0.0
    assert Event("refused", "reset", "still up: watchdog") in rig.tick(Order("reset"), told=sick).events
    rig.run(1)
    assert rig.tick(Order("reset")).state == "STANDBY"
    assert rig.tick(Order("arm")).state == "STANDBY"
    rig.tick(Order("ack", text="watchdog"))
    assert rig.flag("watchdog").acknowledged == "operator"
    assert rig.tick(Order("arm")).state == "ARMED"


def test_nothing_to_acknowledge_is_said() -> None:
    rig = Rig(steady()).run(20)
    rig.tick(Order("ack"))
    assert Event("refused", "ack", "nothing to acknowledge") in rig.tick(Order("ack")).events
    assert Event("refused", "ack", "nothing to acknowledge: bias") in rig.tick(Order("ack", text="bias")).events


def test_what_the_register_keeps_of_a_pmu() -> None:
    high = Signal(pu=lambda k: 1.25 if 40 <= k < 50 or k >= 70 else 1.0)
    rig = Rig(steady(N1=high)).run(90)
    flag = rig.flag("voltage", "N1")
    assert (flag.up, flag.times, flag.limit, flag.latched) == (True, 2, 1.2, False)
    assert flag.value == pytest.approx(1.25, abs=1e-6)
    assert rig.flag("voltage_step", "N1").times == 2  # back at 1 pu a run begins: no frame to compare with
    changes = [change for record in rig.records for change in record.flag_changes if change.name == "voltage"]
    assert [(change.up, change.times) for change in changes] == [(True, 1), (False, 1), (True, 2)]
    assert changes[0].first_ns == changes[2].first_ns < changes[2].last_ns


def test_changes_are_logged_and_read_back(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    high = Rig(steady(N1=Signal(pu=lambda k: 1.25 if k >= 20 else 1.0))).run(40)
    with open_session(path) as log:
        for record in high.records:
            log_tick(log, record)
    back = [tick.record.flag_changes for tick in SessionReader(path).ticks()]
    assert repr(back) == repr([record.flag_changes for record in high.records])
    assert any(not math.isnan(flag.value) for changes in back for flag in changes)
