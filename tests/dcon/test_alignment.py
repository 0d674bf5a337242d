"""Time alignment (section V.C and D): identical stamps, whatever the arrival."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.streams import ARM, MS, Frequency, play, samples, ticks

from dcon.core.instance import difference
from dcon.core.params import Params
from dcon.core.state import Pmu, State
from dcon.core.values import Record, Sample

PAIR = Params.paired(("N1",), ("S1",), nominal_kv=500.0, deadband_mhz=0.0)
COUNT = 240


def swing(mhz: float, hz: float = 0.4) -> Frequency:
    return lambda t: mhz * 1e-3 * math.sin(2 * math.pi * hz * t)


def shifted(stream: Sequence[Sample], by_ns: Sequence[int]) -> list[Sample]:
    return [frame._replace(arrival_ns=frame.arrival_ns + by) for frame, by in zip(stream, by_ns, strict=True)]


def by_stamp(history: list[tuple[State, Record]], pmu: int) -> dict[int, float]:
    """f of every slot, as it stood in the ring after any tick."""
    found: dict[int, float] = {}
    for state, _ in history:
        memory = state.pmus[pmu]
        for back, f in enumerate(memory.ring):
            assert memory.slot is not None
            assert found.setdefault(memory.slot - back, f) == f
    return found


NORTH, SOUTH = list(samples(swing(8), COUNT)), list(samples(swing(-6), COUNT, theta=-0.4))
PERFECT = play(PAIR, ticks((NORTH, SOUTH), COUNT + 8), orders=ARM)
TWO_ZERO = [17 * MS if k % 2 == 0 else 0 for k in range(COUNT)]


@pytest.mark.parametrize("late", [(True, True), (True, False), (False, True)])
def test_two_then_zero_arrival_leaves_every_frequency_bit_identical(late: tuple[bool, bool]) -> None:
    north = shifted(NORTH, TWO_ZERO) if late[0] else NORTH
    south = shifted(SOUTH, TWO_ZERO) if late[1] else SOUTH
    windows = list(ticks((north, south), COUNT + 8))
    assert {len(inputs.samples[0]) for inputs, _ in windows[10:-20]} == ({0, 2} if late[0] else {1})
    history = play(PAIR, windows, orders=ARM)
    for pmu in (0, 1):
        assert by_stamp(history, pmu) == by_stamp(PERFECT, pmu)
    # The command only holds: each of its values is one that perfect arrival also gives, up to two ticks earlier.
    perfect = [record.command_mw for _, record in PERFECT]
    for k in range(85, COUNT):
        assert history[k][1].command_mw in perfect[k - 2 : k + 1]
    assert {record.instances[0].state for _, record in history[85:COUNT]} == {"READY", "HELD"}


def test_asymmetric_delay_makes_no_difference_but_delay() -> None:
    history = play(PAIR, ticks((NORTH, shifted(SOUTH, [100 * MS] * COUNT)), COUNT), orders=ARM)
    for k in range(90, COUNT):
        assert history[k][1].command_mw == PERFECT[k - 6][1].command_mw


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32), st.integers(0, 30))
def test_frequency_at_a_stamp_does_not_depend_on_arrival(seed: int, jitter_ms: int) -> None:
    draw = random.Random(seed)
    streams = [shifted(s, [draw.randint(0, jitter_ms * MS) for _ in s]) for s in (NORTH[:80], SOUTH[:80])]
    # Overtaking across windows is loss, by the paper's rule; here frames stay in order.
    ordered = [
        [frame._replace(arrival_ns=max(f.arrival_ns for f in s[: k + 1])) for k, frame in enumerate(s)] for s in streams
    ]
    history = play(PAIR, ticks(ordered, 90))
    for pmu in (0, 1):
        want = by_stamp(PERFECT, pmu)
        for slot, f in by_stamp(history, pmu).items():
            assert f == want[slot]


def loss_in_the_south(leads_s: float) -> tuple[Frequency, Frequency]:
    """-30 mHz/s from 2 s on in the south, ``leads_s`` later in the north."""
    return (lambda t: -0.03 * max(0.0, t - 2 - leads_s)), (lambda t: -0.03 * max(0.0, t - 2))


@pytest.mark.parametrize("k", [0, 3, 6])
@pytest.mark.parametrize("align", [True, False])
def test_the_first_command_after_a_generation_loss_in_the_south(k: int, align: bool) -> None:
    params = Params.paired(("N1",), ("S1",), deadband_mhz=0.0, align=align)
    north, south = (list(samples(f, COUNT)) for f in loss_in_the_south(0.03))
    history = play(params, ticks((north, shifted(south, [k * 50 * MS // 3] * COUNT)), COUNT), orders=ARM)
    commands = [record.command_mw for _, record in history]
    first = next(mw for mw in commands if abs(mw) > 1.0)
    if align or k == 0:
        assert first > 0 and min(commands) > -1e-6  # north to south: the right way, as Fig. 14
        assert history[-1][1].delta_f_mhz == pytest.approx(0.9, abs=0.02)
    else:
        assert first < 0  # the wrong way: false difference of ROCOF times delay
        assert history[-1][1].delta_f_mhz == pytest.approx(0.9 - 30 * k / 60, abs=0.02)


def ring(slot: int | None, *values: float) -> Pmu:
    return Pmu(slot=slot, ring=values)


def test_the_newest_common_stamp() -> None:
    north, south = ring(7, 0.5, 0.4, 0.3), ring(5, 0.1)
    assert difference(north, south, align=True) == (5, (0.3 - 0.1) * 1e3)
    assert difference(south, north, align=True) == (5, (0.1 - 0.3) * 1e3)
    assert difference(north, south, align=False) == (5, (0.5 - 0.1) * 1e3)
    assert difference(north, ring(4, 0.1), align=True) is None
    assert difference(ring(4, 0.1), ring(5, 0.2), align=True) is None
    assert difference(north, ring(5), align=True) is None
    assert difference(north, ring(None), align=True) is None
