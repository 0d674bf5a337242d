"""Properties of ``step`` over any sequence of frames, faults and orders."""

from __future__ import annotations

import cmath
import math
import random

from hypothesis import given, settings
from hypothesis import strategies as st
from support.streams import MS, START_NS, VOLTS

from dcon.core.params import Params
from dcon.core.rows import CORE
from dcon.core.state import initial_state
from dcon.core.step import step
from dcon.core.system import ORDERS
from dcon.core.values import Inputs, Mode, Order, Record, Sample, SystemState
from dcon.limiter import SLEW_MW_PER_S

FOUR = Params.paired(
    ("N1", "N2"), ("S1", "S2"), nominal_kv=500.0, init_s=0.2, return_s=0.3, transfer_s=0.25, gain_mw_per_mhz=15.0
)
FAULTS = ("ok", "ok", "ok", "ok", "ok", "ok", "lost", "stat", "nan", "late", "twice", "old", "jump", "tq")


def session(seed: int, count: int, faulty: float) -> list[tuple[Inputs, int]]:
    """A large swing seen by four PMUs, with faults and orders at random."""
    draw = random.Random(seed)
    phase, size, hz = draw.random() * 6, draw.choice((2e-3, 15e-3, 60e-3)), draw.choice((0.25, 0.4, 1.0))
    waiting: list[list[Sample]] = [[], [], [], []]
    outage = [0, 0, 0, 0]
    out = []
    for k in range(count):
        stamp = START_NS + (k * 1_000_000_000 + 30) // 60
        now_ns = stamp + 64 * MS
        taken = []
        for pmu in range(4):
            turn = size / hz * math.sin(2 * math.pi * hz * k / 60 + phase) * (1 if pmu < 2 else -1)
            frame = Sample(stamp, stamp + 60 * MS, cmath.rect(VOLTS, turn), 60.0, 0, 0)
            fault = draw.choice(FAULTS) if draw.random() < faulty else "ok"
            outage[pmu] = draw.randint(5, 40) if draw.random() < faulty / 20 else max(0, outage[pmu] - 1)
            if fault == "stat":
                frame = frame._replace(stat=draw.getrandbits(16))
            elif fault == "nan":
                frame = frame._replace(v1=complex(draw.choice((math.nan, math.inf, 0.0)), 1.0))
            elif fault == "old":
                frame = frame._replace(time_ns=frame.time_ns - draw.randint(0, 10**9))
            elif fault == "jump":
                frame = frame._replace(v1=frame.v1 * cmath.rect(1, draw.random()))
            elif fault == "tq":
                frame = frame._replace(time_quality=draw.getrandbits(8))
            if outage[pmu] == 0 and fault != "lost":
                waiting[pmu] += [frame] * (2 if fault == "twice" else 1)
            taken.append(() if fault == "late" else tuple(waiting[pmu]))
            if fault != "late":
                waiting[pmu] = []
        orders: tuple[Order, ...] = ()
        if draw.random() < 0.3:
            orders = (Order(draw.choice(("arm", "activate", "arm", "activate", "closed_loop", draw.choice(ORDERS)))),)
        if draw.random() < 0.05:
            orders += (Order("gain", draw.uniform(-1, 20)),)
        out.append((Inputs(tuple(taken), orders), now_ns))
    return out


def run(inputs: list[tuple[Inputs, int]]) -> list[Record]:
    state = initial_state(FOUR, mode=Mode.CLOSED_LOOP, verified=True)
    records = []
    for given_inputs, now_ns in inputs:
        state, record = step(FOUR, state, given_inputs, now_ns)
        records.append(record)
    return records


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from((0.0, 0.02, 0.2)))
def test_no_sequence_of_faults_and_orders_makes_a_step(seed: int, faulty: float) -> None:
    before = 0.0
    slew = SLEW_MW_PER_S / 60 + 1e-9
    for record in run(session(seed, 240, faulty)):
        tripped = any(event.name in ("estop", "fault") for event in record.events)
        assert abs(record.command_mw) <= 125.0 and abs(record.output_v) <= 10.0
        assert tripped or abs(record.command_mw - before) <= slew
        assert record.state in (SystemState.ACTIVE, SystemState.RAMPDOWN) or record.command_mw == 0.0
        assert record.output_v == (record.command_mw / 12.5 if record.mode is Mode.CLOSED_LOOP else 0.0)
        assert 0 <= record.flags < 1 << len(CORE.names)
        assert record.active is None or record.instances[record.active].state in ("READY", "HELD")
        before = record.command_mw


def test_the_sessions_do_drive_switch_and_fail() -> None:
    """The property above would hold of a controller that does nothing."""
    records = [record for seed in range(12) for record in run(session(seed, 240, 0.02))]
    names = {event.name for record in records for event in record.events}
    assert {"active", "selected", "armed", "rampdown", "estop", "instance_disabled", "instance_ready"} <= names
    assert {
        "stamp_step",
        "stat_error",
        "not_finite",
        "arrival_gap",
        "stale_frame",
        "angle_step",
        "time_quality",
    } <= names
    assert max(abs(record.command_mw) for record in records) == 125.0
    assert "internal_error" not in names


@settings(max_examples=20, deadline=None)
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
    Sample, INTEGERS, INTEGERS, st.complex_numbers(), st.floats(), INTEGERS, INTEGERS, st.integers(-5, 2**24)
)
GARBAGE = st.one_of(st.none(), st.text(max_size=3), st.floats(), WILD, st.tuples(WILD), st.lists(st.none(), max_size=2))
WILD_ORDER = st.builds(Order, st.one_of(st.sampled_from([str(o) for o in ORDERS]), st.text()), st.floats())


@settings(max_examples=200, deadline=None)
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
