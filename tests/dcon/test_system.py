"""States of the system: every state with every order, arming, trips, and the seam for checks."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
from support.streams import ARM, play, samples, ticks

from dcon.core.checks import Action, Check, Scope, SystemValue
from dcon.core.params import Params, Required
from dcon.core.rows import CORE
from dcon.core.state import Instance, State, initial_state
from dcon.core.step import step
from dcon.core.system import ORDERS, PERMISSIVES, TRANSITIONS, ArmView, Trigger, refusal
from dcon.core.values import Event, Inputs, InstanceState, Mode, Order, Pdci, Record, Surroundings, SystemState

S = SystemState
PAIR = Params.paired(("N1",), ("S1",), nominal_kv=500.0, deadband_mhz=0.0)
DELTA_MHZ = 5.0
COUNT = 400
STREAMS = (list(samples(lambda _: DELTA_MHZ * 1e-3, COUNT)), list(samples(lambda _: 0.0, COUNT)))
WINDOWS = list(ticks(STREAMS, COUNT))
READY = play(PAIR, WINDOWS[:20])[-1][0]
"""STANDBY, with a READY instance."""


def at(state: SystemState, mode: Mode = Mode.CLOSED_LOOP) -> State:
    command_mw = 45.0 if state in (S.ACTIVE, S.RAMPDOWN) else 0.0
    driven_mw = command_mw if mode is Mode.CLOSED_LOOP else 0.0
    return READY._replace(system=state, mode=mode, command_mw=command_mw, driven_mw=driven_mw)


def told(view: ArmView, **changed: Any) -> ArmView:
    return view._replace(surroundings=view.surroundings._replace(**changed))


def tick(state: State, *orders: Order, window: int = 20) -> tuple[State, Record]:
    inputs, now_ns = WINDOWS[window]
    return step(PAIR, state, inputs._replace(orders=orders), now_ns)


WANT = {
    "start": {S.OFF: S.INIT},
    "off": {S.INIT: S.OFF, S.STANDBY: S.OFF},
    "arm": {S.STANDBY: S.ARMED},
    "activate": {S.ARMED: S.ACTIVE},
    "disarm": {S.ARMED: S.STANDBY, S.ACTIVE: S.RAMPDOWN},
    "reset": {S.FAULT: S.INIT, S.ESTOP: S.INIT},
    "estop": dict.fromkeys(S, S.ESTOP),
}


@pytest.mark.parametrize("state", list(S))
@pytest.mark.parametrize("order", sorted(WANT))
def test_every_state_with_every_order(state: SystemState, order: str) -> None:
    before = at(state)
    if order == "start" or (state, order) in ((S.FAULT, "reset"), (S.ESTOP, "reset"), (S.INIT, "off")):
        # INIT is left in the same tick where an instance is READY: show the order's own effect without one.
        before = before._replace(instances=(Instance(),), pmus=initial_state(PAIR).pmus)
        after, record = step(PAIR, before, Inputs(((), ()), (Order(order),)), WINDOWS[20][1])
    else:
        after, record = tick(before, Order(order))
    want = WANT[order].get(state)
    refused = [event for event in record.events if event.name == "refused"]
    assert bool(refused) == (want is None)
    if want is not None:
        assert after.system is record.state is want
    if record.state not in (S.ACTIVE, S.RAMPDOWN):
        assert record.command_mw == 0.0 and record.output_v == 0.0


CHECKED = {
    "warn": (Surroundings(server_age_s=9.0), {}),
    "disarm": (Surroundings(gps_age_s=9.0), {S.ARMED: S.STANDBY, S.ACTIVE: S.RAMPDOWN}),
    "trip": (Surroundings(watchdog_healthy=False), {state: S.FAULT for state in S if state is not S.ESTOP}),
    "estop": (Surroundings(estop_released=False), dict.fromkeys(S, S.ESTOP)),
    "trip and estop": (Surroundings(watchdog_healthy=False, estop_released=False), dict.fromkeys(S, S.ESTOP)),
}


@pytest.mark.parametrize("state", list(S))
@pytest.mark.parametrize("action", CHECKED)
def test_every_state_with_every_action_of_a_check(state: SystemState, action: str) -> None:
    """Only what moved the system is latched; what is driven is 0 at once after a trip, and ramps otherwise."""
    told, moves = CHECKED[action]
    before = at(state)
    if state is S.INIT:
        before = before._replace(instances=(Instance(),), pmus=initial_state(PAIR).pmus)
        samples_: Any = ((), ())
    else:
        samples_ = WINDOWS[20][0].samples
    after, record = step(PAIR, before, Inputs(samples_, (), told), WINDOWS[20][1])
    assert record.state is moves.get(state, state)
    latched = {flag.name for flag in after.flags.values() if flag.latched}
    own = {"server", "gps", "watchdog", "estop"} & {flag.name for flag in after.flags.values()}
    assert latched == (own if record.state is not state else set()) or action == "trip and estop"
    if record.state is S.RAMPDOWN:
        assert record.command_mw >= 45.0 - 1000 / 60 - 1e-9
    elif record.state is not S.ACTIVE:
        assert record.command_mw == 0.0 == record.output_v or state is S.RAMPDOWN


LINE = Pdci(WINDOWS[20][1], 1500.0)
WELL = ArmView(
    1,
    0.0,
    Surroundings(gps_age_s=0.0, watchdog_healthy=True, estop_released=True, pdci=LINE, server_age_s=0.0),
    WINDOWS[20][1],
)
PERMITTED: dict[str, list[tuple[ArmView, bool]]] = {
    "ready_instances": [(WELL._replace(ready=0), False)],
    "command_small": [(WELL._replace(command_mw=mw), abs(mw) <= 62.5) for mw in (62.5, -62.5, 62.6, -62.6)],
    "gps_locked": [(told(WELL, gps_age_s=age), age == 0) for age in (0.0, 0.1)],
    "watchdog_healthy": [(told(WELL, watchdog_healthy=False), False)],
    "estop_released": [(told(WELL, estop_released=False), False)],
    "server_there": [(told(WELL, server_age_s=age), age <= 2) for age in (2.0, 2.1)],
    "line_takes_it": [
        (told(WELL, pdci=LINE._replace(in_service=False)), False),
        (told(WELL, pdci=LINE._replace(dcon_enabled=False)), False),
    ],
    "line_has_room": [(told(WELL, pdci=LINE._replace(power_mw=mw)), mw == 435.0) for mw in (435.0, 434.0, 3200.0)],
    "acknowledged": [(WELL._replace(latched=("gps",)), False)],
    "fallen": [(WELL._replace(still_up=("gps",)), False)],
}


def test_every_permissive() -> None:
    assert [row.name for row in PERMISSIVES] == list(PERMITTED)
    for row in PERMISSIVES:
        assert row.test(PAIR, WELL)
        for view, want in PERMITTED[row.name]:
            assert row.test(PAIR, view) is want, row.name
            others = [other.name for other in PERMISSIVES if other is not row and not other.test(PAIR, view)]
            assert not others
            for trigger in (Trigger.ARM, Trigger.ACTIVATE):
                state = S.STANDBY if trigger is Trigger.ARM else S.ARMED
                assert refusal(PAIR, state, trigger, view) == ("" if want else row.text)


def test_what_is_not_fitted_permits_unless_it_is_required() -> None:
    bare = ArmView(1, 0.0)
    strict = replace(PAIR, required=Required(True, True, True, True))
    refused = {row.name for row in PERMISSIVES if not row.test(strict, bare)}
    assert refused == {
        "gps_locked",
        "watchdog_healthy",
        "estop_released",
        "server_there",
        "line_takes_it",
        "line_has_room",
    }
    assert all(row.test(PAIR, bare) for row in PERMISSIVES)


@pytest.mark.parametrize("state", list(S))
@pytest.mark.parametrize("mode", list(Mode))
def test_the_mode_changes_only_where_nothing_is_driven(state: SystemState, mode: Mode) -> None:
    other = Mode.OPEN_LOOP if mode is Mode.CLOSED_LOOP else Mode.CLOSED_LOOP
    after, record = tick(at(state, other), Order(mode))
    free = state not in (S.ARMED, S.ACTIVE, S.RAMPDOWN)
    assert after.mode is (mode if free else other)
    assert [e.name for e in record.events if e.name in (mode, "refused")] == [mode if free else "refused"]


def test_every_transition_is_an_order_or_from_within() -> None:
    within = {Trigger.READY, Trigger.RAMPED, Trigger.TRIP}
    assert {trigger for _, trigger in TRANSITIONS} == within | {order for order in ORDERS if isinstance(order, Trigger)}
    reached = set(TRANSITIONS.values())
    assert reached == set(S)


def test_two_step_arming_then_a_ramp_from_zero() -> None:
    history = play(PAIR, WINDOWS[:120], orders=ARM)
    records = [record for _, record in history]
    assert [r.state for r in records[19:23]] == [S.STANDBY, S.ARMED, S.ACTIVE, S.ACTIVE]
    assert records[20].output_v == 0 == records[21].output_v
    full = 9 * DELTA_MHZ
    assert [r.command_mw for r in records[21:82]] == pytest.approx([full * k / 60 for k in range(61)], abs=1e-3)
    assert records[100].output_v == records[100].command_mw / 12.5


def test_in_open_loop_the_command_is_computed_and_nothing_is_driven() -> None:
    start = initial_state(PAIR, mode=Mode.OPEN_LOOP, verified=True)
    records = [record for _, record in play(PAIR, WINDOWS[:120], orders=ARM, state=start)]
    assert records[-1].command_mw == pytest.approx(45.0, abs=1e-3)
    assert {record.output_v for record in records} == {0.0}


def test_disarming_ramps_down_in_a_second() -> None:
    history = play(PAIR, WINDOWS[:200], orders={**ARM, 100: (Order("disarm"),)})
    commands = [record.command_mw for _, record in history]
    assert commands[100] == commands[99]
    assert commands[100:161] == pytest.approx([45.0 * (60 - k) / 60 for k in range(61)], abs=1e-3)
    assert [history[k][1].state for k in (99, 100, 159, 160)] == [S.ACTIVE, S.RAMPDOWN, S.RAMPDOWN, S.STANDBY]


def test_an_emergency_stop_is_zero_at_once_and_latched() -> None:
    orders = {**ARM, 100: (Order("estop"), Order("reset")), 110: (Order("arm"),), 120: (Order("reset"),)}
    records = [record for _, record in play(PAIR, WINDOWS[:130], orders=orders)]
    assert records[99].command_mw > 40 and records[100].command_mw == 0.0 == records[100].output_v
    assert {record.state for record in records[100:120]} == {S.ESTOP}
    assert records[120].state is S.STANDBY  # through INIT: an instance is READY
    assert records[-1].command_mw == 0.0


def test_too_few_ready_instances_or_a_large_command_do_not_arm() -> None:
    four = Params.paired(("N1", "N2"), ("S1", "S2"), deadband_mhz=0.0)
    streams = [*STREAMS, STREAMS[1], STREAMS[1]]
    only_one = [streams[0], [], streams[2], []]
    for given, arms in ((streams, True), (only_one, False)):
        record = play(four, ticks(given, 40), orders={20: (Order("arm"),)})[20][1]
        assert (record.state is S.ARMED) is arms
    large = replace(PAIR, arm_limit_mw=44.0)
    record = play(large, WINDOWS[:30], orders=ARM)[20][1]
    assert Event("refused", "arm", "the command is not small: wait for the swing to end") in record.events


def test_gain_ramps_and_is_bounded() -> None:
    orders = {**ARM, 100: (Order("gain", 12.0),), 101: (Order("gain", 16.0),), 102: (Order("gain", math.nan),)}
    records = [record for _, record in play(PAIR, WINDOWS[:200], orders=orders)]
    assert [r.gain_mw_per_mhz for r in (records[100], records[101], records[-1])] == pytest.approx([9, 9.05, 12])
    assert [len([e for e in records[k].events if e.name == "refused"]) for k in (100, 101, 102)] == [0, 1, 1]
    steps = [abs(b.command_mw - a.command_mw) for a, b in pairwise(records[100:])]
    assert max(steps) < 0.3 and records[-1].command_mw == pytest.approx(60.0, abs=1e-3)


@pytest.mark.parametrize("gain", [0.0, 15.0])
def test_the_ends_of_the_gain_range_are_allowed(gain: float) -> None:
    assert tick(READY, Order("gain", gain))[0].target_gain_mw_per_mhz == gain


def test_the_record_tells_what_the_tick_saw() -> None:
    _, record = tick(at(S.ACTIVE))
    assert record.f_hz == pytest.approx((60.005, 60.0), abs=1e-6)
    assert record.age_ms == pytest.approx((70.667, 70.667), abs=1e-3)  # 60 ms to arrive, then the next tick
    assert record.delta_f_mhz == record.instances[0].delta_f_mhz == pytest.approx(5.0, abs=1e-3)
    assert record.active == 0 and record.instances[0].active
    assert (record.gain_mw_per_mhz, record.probe_mw, record.flags) == (9.0, 0.0, 0)
    _, record = step(PAIR, initial_state(PAIR), Inputs(((), ())), WINDOWS[0][1])
    assert all(map(math.isnan, (*record.f_hz, *record.age_ms, record.delta_f_mhz)))
    assert record.active is None and not record.instances[0].active
    assert CORE.named(record.flags) == ["no_data", "no_ready_instance"]


def test_an_unknown_order_is_refused() -> None:
    _, record = tick(READY, Order("launch"))
    assert record.events == (Event("refused", "launch", "no such order"),)


def test_what_the_link_refuses_is_an_event_and_nothing_else() -> None:
    refused = Order("link_refused", text="the signature does not hold", who="Eve", why="0f")
    for state in (READY, at(S.ACTIVE)):
        quiet, _ = tick(state)
        after, record = tick(state, refused)
        assert after == quiet
        event = Event("refused", "link", "the signature does not hold; said to be by Eve")
        assert [e for e in record.events if e.name == "refused"] == [event]
    nobody = tick(READY, refused._replace(who=""))[1].events
    assert Event("refused", "link", "the signature does not hold; said to be by nobody known") in nobody


def test_a_release_of_the_watchdog_s_stop_is_told_and_moves_nothing() -> None:
    for state in S:
        before = at(state)
        after, record = tick(before, Order("release", who="Ada"))
        assert after.system is tick(before)[0].system
        assert Event("release", "system", "order by Ada") in record.events


def test_a_refusal_says_whose_order_it_was() -> None:
    _, record = tick(at(S.FAULT), Order("arm", who="Ada", why="for fun"))
    assert Event("refused", "arm", "not possible in FAULT; order by Ada") in record.events


@pytest.mark.parametrize(
    ("samples_", "orders"),
    [((), ()), (((None,), ()), ()), ((("x",), ()), ()), (((), ()), ("arm",)), (((), (), ()), ()), (None, None)],
)
def test_input_that_cannot_be_digested_is_a_fault_and_zero(samples_: Any, orders: Any) -> None:
    state, record = step(PAIR, at(S.ACTIVE), Inputs(samples_, orders), WINDOWS[20][1])
    assert record.state is state.system is S.FAULT
    assert record.command_mw == 0.0 == record.output_v
    assert [event.name for event in record.events] == ["internal_error", "fault"]
    assert CORE.named(record.flags & CORE.tripping) == ["internal_error"]
    state, record = step(PAIR, state, *WINDOWS[21])
    assert record.state is S.FAULT and record.command_mw == 0.0


def test_a_command_that_is_no_number_trips() -> None:
    broken = at(S.ACTIVE)._replace(gain_mw_per_mhz=math.nan, target_gain_mw_per_mhz=math.nan)
    _, record = tick(broken)
    assert record.state is S.FAULT and record.command_mw == 0.0
    assert "command_invalid" in [event.name for event in record.events]


def test_a_frequency_difference_of_an_island_disarms() -> None:
    streams = (list(samples(lambda t: 0.205 * min(1.0, max(0.0, t - 1)), COUNT)), STREAMS[1])
    records = [r for _, r in play(PAIR, ticks(streams, 220), orders=ARM)]
    fell = next(k for k, r in enumerate(records) if r.state is S.RAMPDOWN)
    assert Event("rampdown", "system", "frequency_difference") in records[fell].events
    assert abs(records[fell].command_mw - records[fell - 1].command_mw) < 1e-9
    assert records[-1].state is S.STANDBY


def test_a_supervisors_own_rows_act() -> None:
    rows = {
        action: Check[SystemValue](
            f"own_{action}", Scope.SYSTEM, action, lambda _, view: view.state is S.ACTIVE, "ours"
        )
        for action in (Action.WARN, Action.DISARM, Action.TRIP)
    }
    want = {Action.WARN: S.ACTIVE, Action.DISARM: S.RAMPDOWN, Action.TRIP: S.FAULT}
    for action, row in rows.items():
        supervisor = replace(CORE, system=(*CORE.system, row))
        inputs, now_ns = WINDOWS[20]
        _, record = step(PAIR, at(S.ACTIVE), inputs, now_ns, supervisor)
        assert record.state is want[action]
        assert supervisor.named(record.flags) == [row.name]


def test_flag_bits_come_from_one_table() -> None:
    assert len(CORE.names) == len(set(CORE.names)) <= 64
    assert [CORE.bits[name] for name in CORE.names] == [1 << k for k in range(len(CORE.names))]
    assert all(row.text for row in CORE.rows)
    with pytest.raises(ValueError, match="two of one name"):
        replace(CORE, system=(*CORE.system, CORE.system[0]))


def test_instances_compute_in_every_state() -> None:
    for state in S:
        _, record = tick(at(state))
        assert record.instances[0].state is InstanceState.READY
        assert record.instances[0].command_mw == pytest.approx(45.0, abs=1e-3)
