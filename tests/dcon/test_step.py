"""Properties of ``step`` over any sequence of frames, faults and orders."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.random_sessions import FOUR, session
from support.streams import MS, START_NS

from dcon.core.checks import Supervisor
from dcon.core.params import Params
from dcon.core.rows import CORE
from dcon.core.state import State, initial_state
from dcon.core.step import step
from dcon.core.system import ORDERS
from dcon.core.thresholds import Thresholds
from dcon.core.values import Flag, Inputs, Mode, Order, Record, Sample, SystemState
from dcon.limiter import SLEW_MW_PER_S


def run(inputs: Sequence[tuple[Inputs, int]], params: Params = FOUR, supervisor: Supervisor = CORE) -> list[Record]:
    return [record for _, record in states(inputs, params, supervisor)]


def states(
    inputs: Sequence[tuple[Inputs, int]], params: Params = FOUR, supervisor: Supervisor = CORE
) -> list[tuple[State, Record]]:
    state = initial_state(params, mode=Mode.CLOSED_LOOP, verified=True)
    out = []
    for given_inputs, now_ns in inputs:
        state, record = step(params, state, given_inputs, now_ns, supervisor)
        out.append((state, record))
    return out


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from((0.0, 0.02, 0.2)), st.booleans())
def test_no_sequence_of_faults_and_orders_makes_a_step(seed: int, faulty: float, probing: bool) -> None:
    """What is driven moves by the slew at most, but for a trip and an emergency stop; so does the command in it."""
    params = replace(FOUR, probing=replace(FOUR.probing, open_loop=probing))
    before_mw = driven_before_mw = 0.0
    slew = SLEW_MW_PER_S / 60 + 1e-9
    for record in run(session(seed, 200, faulty), params):
        tripped = any(event.name in ("estop", "fault") for event in record.events)
        driven_mw = record.output_v * 12.5
        assert abs(record.command_mw) <= 125.0 and abs(record.output_v) <= 10.0
        assert tripped or abs(record.command_mw - before_mw) <= slew
        assert tripped or abs(driven_mw - driven_before_mw) <= slew
        assert not tripped or record.command_mw == driven_mw == 0.0
        if record.state not in (SystemState.ACTIVE, SystemState.RAMPDOWN):
            assert record.command_mw == driven_mw == record.probe_mw == 0.0
        closed = record.mode is Mode.CLOSED_LOOP
        expected_mw = (record.command_mw if closed else 0.0) + (record.probe_mw if closed or probing else 0.0)
        assert driven_mw == pytest.approx(expected_mw, abs=1e-9)
        assert 0 <= record.flags < 1 << len(CORE.names)
        assert record.active is None or record.instances[record.active].state in ("READY", "HELD")
        before_mw, driven_before_mw = record.command_mw, driven_mw


def test_the_sessions_do_drive_switch_probe_and_fail() -> None:
    """The property above would hold of a controller that does nothing."""
    records = [record for seed in range(16) for record in run(session(seed, 240, 0.02))]
    names = {event.name for record in records for event in record.events}
    assert {"active", "selected", "armed", "rampdown", "estop", "instance_disabled", "instance_ready"} <= names
    assert {"stamp_step", "stat_error", "not_finite", "arrival_gap", "stale_frame", "angle_step"} <= names
    assert {"time_quality", "probe_start", "probe_end", "ack", "slew_limited", "unread_frame", "overrun"} <= names
    assert max(abs(record.command_mw) for record in records) == 125.0
    assert max(abs(record.probe_mw) for record in records) > 100.0
    assert "internal_error" not in names


SLOW = replace(CORE, known=((), (), ()))
"""The tables alone, without the short way through uneventful ticks."""


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from((0.0, 0.005, 0.05)))
def test_the_short_way_and_the_tables_are_one(seed: int, faulty: float) -> None:
    inputs = session(seed, 150, faulty)
    assert CORE.tables(FOUR).quick is not None and SLOW.tables(FOUR).quick is None
    assert repr(states(inputs)) == repr(states(inputs, FOUR, SLOW))


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from((0.0, 0.05)), st.integers(0, 3))
def test_a_lost_pmu_leaves_the_instances_of_the_others_alone(seed: int, faulty: float, lost: int) -> None:
    """With the comparison between instances out of it, which is there to let one instance judge another."""
    params = replace(FOUR, thresholds=Thresholds(median_max_mhz=1000.0))
    whole = [(Inputs(inputs.samples), now_ns) for inputs, now_ns in session(seed, 120, faulty)]
    less = [
        (Inputs((*inputs.samples[:lost], (), *inputs.samples[lost + 1 :]) if k > 40 else inputs.samples), now_ns)
        for k, (inputs, now_ns) in enumerate(whole)
    ]
    for one, other in zip(run(whole, params), run(less, params), strict=True):
        for pair, a, b in zip(params.instances, one.instances, other.instances, strict=True):
            if lost not in pair:
                assert repr(a._replace(active=False)) == repr(b._replace(active=False))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from((0.01, 0.1)))
def test_the_register_says_what_the_flags_and_changes_say(seed: int, faulty: float) -> None:
    """Rebuilt from the changes alone; what is up in it is what is up in the records."""
    seen: dict[tuple[str, str], Flag] = {}
    for state, record in states(session(seed, 150, faulty)):
        for flag in record.flag_changes:
            before = seen.get((flag.name, flag.subject))
            assert flag.last_ns == record.tick_ns or (before is not None and flag.last_ns == before.last_ns)
            assert flag.times - (0 if before is None else before.times) in (0, 1)
            seen[flag.name, flag.subject] = flag
        assert seen == dict(state.flags)
        up = sum(CORE.bits[name] for name in {flag.name for flag in seen.values() if flag.up})
        assert up == record.flags
        assert len(seen) <= len(CORE.names) * (4 + 4 + 1)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32))
def test_same_in_same_out(seed: int) -> None:
    inputs = session(seed, 120, 0.05)
    assert repr(run(inputs)) == repr(run(inputs))


def test_step_leaves_its_arguments_alone() -> None:
    state = initial_state(FOUR, verified=True)
    for inputs, now_ns in session(3, 60, 0.05):
        shown = repr((state, inputs))
        after, _ = step(FOUR, state, inputs, now_ns)
        assert repr((state, inputs)) == shown
        state = after


INTEGERS = st.integers(-(2**70), 2**70)
WILD = st.builds(
    Sample,
    *(INTEGERS, INTEGERS, st.complex_numbers(), st.floats(), INTEGERS, INTEGERS, st.integers(-5, 2**24)),
    st.complex_numbers(),
)
GARBAGE = st.one_of(st.none(), st.text(max_size=3), st.floats(), WILD, st.tuples(WILD), st.lists(st.none(), max_size=2))
WILD_ORDER = st.builds(
    Order, st.one_of(st.sampled_from([str(o) for o in ORDERS]), st.text()), st.floats(), st.text(), st.text()
)


@settings(max_examples=120, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.one_of(
                GARBAGE,
                st.builds(Inputs, st.lists(st.lists(WILD, max_size=3), min_size=4, max_size=4), st.lists(WILD_ORDER)),
                st.builds(Inputs, st.lists(GARBAGE, max_size=5), st.lists(GARBAGE, max_size=2)),
            ),
            INTEGERS,
        ),
        max_size=6,
    )
)
def test_no_input_raises(windows: list[tuple[Inputs, int]]) -> None:
    state = initial_state(FOUR, mode=Mode.CLOSED_LOOP, verified=True)
    for inputs, now_ns in [*session(1, 30, 0.0), *windows, *session(2, 10, 0.0)]:
        state, record = step(FOUR, state, inputs, now_ns)
        assert math.isfinite(record.command_mw) and abs(record.command_mw) <= 125
        assert math.isfinite(record.output_v)
        if any(event.name == "internal_error" for event in record.events):
            assert record.command_mw == 0.0 and record.state in (SystemState.FAULT, SystemState.ESTOP)


WIRE = st.builds(
    Sample,
    st.integers(0, 2**32 * 10**9),
    st.integers(0, 2**32 * 10**9),
    st.complex_numbers(),
    st.floats(),
    st.integers(0, 0xFFFF),
    st.integers(0, 0xFF),
    st.integers(1, 2**24 - 1),
    st.complex_numbers(),
)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.lists(WIRE, max_size=3), min_size=4, max_size=4), st.lists(WIRE, max_size=3))
def test_nothing_that_a_wire_can_carry_is_an_internal_error(frames: list[list[Sample]], more: list[Sample]) -> None:
    state = initial_state(FOUR, verified=True)
    for inputs, now_ns in session(1, 20, 0.0):
        state, _ = step(FOUR, state, inputs, now_ns)
    for samples in (frames, [more] * 4):
        state, record = step(FOUR, state, Inputs(tuple(map(tuple, samples))), START_NS + 400 * MS)
        assert "internal_error" not in [event.name for event in record.events]
