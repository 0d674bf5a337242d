"""PMU frames with known frequencies, for the controller without a grid."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Iterator, Mapping, Sequence

from dcon.core.params import Params
from dcon.core.state import State, initial_state
from dcon.core.step import step
from dcon.core.values import Inputs, Mode, Order, Record, Sample
from pmutools.timebase import NS

START_NS = 1_473_354_311 * NS
VOLTS = 500e3 / math.sqrt(3)
MS = 1_000_000

Frequency = Callable[[float], float]
"""Deviation (Hz) at a time (s)."""


def samples(
    frequency: Frequency, count: int, *, rate: int = 60, theta: float = 0.3, delay_ns: int = 60 * MS
) -> Iterator[Sample]:
    """``count`` frames of a PMU whose angle turns with ``frequency`` (trapezoidal)."""
    before = frequency(0.0)
    for k in range(count):
        now = frequency(k / rate)
        theta += math.pi * (before + now) / rate * (k > 0)
        before = now
        stamp = START_NS + (k * NS + rate // 2) // rate
        yield Sample(stamp, stamp + delay_ns, cmath.rect(VOLTS, theta), 60 + now, 0, 0)


def ticks(streams: Sequence[Sequence[Sample]], count: int, *, phase_ns: int = 4 * MS) -> Iterator[tuple[Inputs, int]]:
    """Frames of each PMU grouped into 60 Hz windows by their arrival."""
    waiting = [sorted(stream, key=lambda sample: sample.arrival_ns) for stream in streams]
    heads = [0] * len(waiting)
    for tick in range(count):
        now_ns = START_NS + phase_ns + (tick * NS + 30) // 60
        taken = []
        for index, stream in enumerate(waiting):
            first = heads[index]
            while heads[index] < len(stream) and stream[heads[index]].arrival_ns <= now_ns:
                heads[index] += 1
            taken.append(tuple(stream[first : heads[index]]))
        yield Inputs(tuple(taken)), now_ns


def play(
    params: Params,
    windows: Iterator[tuple[Inputs, int]] | Sequence[tuple[Inputs, int]],
    *,
    orders: Mapping[int, Sequence[Order]] | None = None,
    state: State | None = None,
) -> list[tuple[State, Record]]:
    """Every tick's result; ``orders`` by tick index. Starts in closed loop with verified instances."""
    state = initial_state(params, mode=Mode.CLOSED_LOOP, verified=True) if state is None else state
    out = []
    for index, (inputs, now_ns) in enumerate(windows):
        given = tuple((orders or {}).get(index, ()))
        state, record = step(params, state, inputs._replace(orders=inputs.orders + given), now_ns)
        out.append((state, record))
    return out


ARM = {20: (Order("arm"),), 21: (Order("activate"),)}
"""Once the first frames are in."""
