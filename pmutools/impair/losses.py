"""The loss stage: which frames never leave. Deterministic models name frames; random ones have a long-run ratio.

Chains begin in their stationary distribution, not in the good state, so the ratio holds from the first frame on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from pmutools.draws import Draws
from pmutools.impair.blocks import Lanes, chance
from pmutools.impair.moment import Moment
from pmutools.impair.selectors import DATA, Selector, selector
from pmutools.parsers import Indices, indices, integer, number, one_of, parsed_by, probability
from pmutools.timebase import NS

Lost = Callable[[Moment], int]
"""1 (or True) for a frame that is lost."""
_P = parsed_by(probability)


class LossModel(Protocol):
    def lost(self, draws: Draws) -> Lost:
        """The model at work on one stream."""


@dataclass(frozen=True, slots=True)
class Bernoulli:
    """Each frame on its own with probability ``p``."""

    p: float = field(metadata=_P)

    def lost(self, draws: Draws) -> Lost:
        return chance(draws, self.p)


@dataclass(frozen=True, slots=True)
class GilbertElliott:
    """Good and bad state: ``p`` good to bad, ``r`` bad to good, loss ``bad`` (netem's 1-h) and ``good`` (1-k) in each.

    A frame is judged in the current state, then the state moves. Long run: (p*bad + r*good)/(p+r). For a loss L in
    bursts of B frames on average: r = 1/B, p = L*r/(1-L).
    """

    p: float = field(metadata=_P)
    r: float | None = field(default=None, metadata=_P)
    bad: float = field(default=1.0, metadata=_P)
    good: float = field(default=0.0, metadata=_P)

    def __post_init__(self) -> None:
        if self.p == 0 and self.r == 0:
            raise ValueError("gemodel: p and r are both 0, so the chain never moves; use a probability alone")

    def lost(self, draws: Draws) -> Lost:
        return Lanes(lambda lane: _GilbertElliottChain(self, draws, lane), draws)


class _GilbertElliottChain:
    memory = True

    def __init__(self, model: GilbertElliott, draws: Draws, lane: int) -> None:
        self._p, self._r = model.p, 1 - model.p if model.r is None else model.r
        self._loss = (model.good, model.bad)
        self._draws, self._lane = draws, lane
        self._bad = False

    def begin(self, index: int) -> None:
        self._bad = self._draws.uniform(index, 2, self._lane) * (self._p + self._r) < self._p

    def run(self, first: int, count: int) -> Sequence[int]:
        moves = self._draws.uniforms(first, count, 0, self._lane).tolist()
        hits = self._draws.uniforms(first, count, 1, self._lane).tolist()
        p, r, loss, bad = self._p, self._r, self._loss, self._bad
        lost = bytearray()
        for move, hit in zip(moves, hits, strict=True):
            lost.append(hit < loss[bad])
            if move < (r if bad else p):
                bad = not bad
        self._bad = bad
        return lost


@dataclass(frozen=True, slots=True)
class FourState:
    """netem's ``state``: 1 good, 2 good within a burst, 3 burst loss, 4 isolated loss, by transition probabilities.

    Judged on the state moved to. Long run: s*(p13/p31 + p14), s = 1/(1 + p14 + (p13/p31)*(1 + p32/p23)).
    """

    p13: float = field(metadata=_P)
    p31: float | None = field(default=None, metadata=_P)
    p32: float = field(default=0.0, metadata=_P)
    p23: float = field(default=1.0, metadata=_P)
    p14: float = field(default=0.0, metadata=_P)

    def __post_init__(self) -> None:
        if self.p13 + self.p14 > 1 or self.p32 + self.leave > 1:
            raise ValueError("state: p13 + p14, and p31 + p32, must not exceed 100%")
        if self.p13 and not (self.leave and (self.p23 or not self.p32)):
            raise ValueError("state: a burst would never end; p31 (and p23, with p32) must be above 0")

    @property
    def leave(self) -> float:
        """p31, which defaults to 1 - p13."""
        return 1 - self.p13 if self.p31 is None else self.p31

    def stationary(self) -> tuple[float, float, float, float]:
        """The share of frames in states 1 to 4."""
        burst = self.p13 / self.leave if self.p13 else 0.0
        pause = burst * self.p32 / self.p23 if self.p32 else 0.0
        one = 1 / (1 + self.p14 + burst + pause)
        return one, one * pause, one * burst, one * self.p14

    def lost(self, draws: Draws) -> Lost:
        return Lanes(lambda lane: _FourStateChain(self, draws, lane), draws)


class _FourStateChain:
    memory = True

    def __init__(self, model: FourState, draws: Draws, lane: int) -> None:
        self._draws, self._lane = draws, lane
        self._shares = model.stationary()
        exits = {
            1: ((4, model.p14), (3, model.p13)),
            2: ((3, model.p23),),
            3: ((2, model.p32), (1, model.leave)),
            4: ((1, 1.0),),
        }
        self._exits = {state: _cumulative(moves) for state, moves in exits.items()}
        self._state = 1

    def begin(self, index: int) -> None:
        u = self._draws.uniform(index, 1, self._lane)
        self._state = 1 + sum(u >= sum(self._shares[: n + 1]) for n in range(3))

    def run(self, first: int, count: int) -> Sequence[int]:
        lost, state = bytearray(), self._state
        for u in self._draws.uniforms(first, count, 0, self._lane).tolist():
            state = next((to for to, edge in self._exits[state] if u < edge), state)
            lost.append(state > 2)
        self._state = state
        return lost


def _cumulative(moves: tuple[tuple[int, float], ...]) -> list[tuple[int, float]]:
    edge, table = 0.0, list[tuple[int, float]]()
    for state, probability_ in moves:
        edge += probability_
        table.append((state, edge))
    return table


@dataclass(frozen=True, slots=True)
class OnOff:
    """A link that works for ``on`` and is down for ``off`` seconds on average, both exponential, in stream time."""

    on: float = field(metadata=parsed_by(number(1e-6)))
    off: float = field(metadata=parsed_by(number(1e-6)))

    def lost(self, draws: Draws) -> Lost:
        return _Dwells(self, draws).lost


class _Dwells:
    """The up and down times of one link, followed forward; looked at earlier, they are drawn again from the start."""

    def __init__(self, model: OnOff, draws: Draws) -> None:
        self._means_ns = (model.on * NS, model.off * NS)
        self._off_share = model.off / (model.on + model.off)
        self._draws = draws
        self._restart()

    def _restart(self) -> None:
        self._down = self._draws.uniform(0, 1) < self._off_share
        self._since_ns, self._until_ns, self._dwell = 0, 0, 0
        self._extend()

    def _extend(self) -> None:
        u = self._draws.uniform(self._dwell)
        self._since_ns = self._until_ns
        self._until_ns += round(-self._means_ns[self._down] * math.log(u))
        self._dwell += 1

    def lost(self, at: Moment) -> bool:
        if at.time_ns < self._since_ns:
            self._restart()
        while at.time_ns >= self._until_ns:
            self._down = not self._down
            self._extend()
        return self._down


@dataclass(frozen=True, slots=True)
class Periodic:
    """A link that works for ``on``, then is down for ``off`` seconds of stream time, from ``offset`` on."""

    on: float = field(metadata=parsed_by(number(0)))
    off: float = field(metadata=parsed_by(number(0)))
    offset: float = field(default=0.0, metadata=parsed_by(number(0)))

    def __post_init__(self) -> None:
        if not self.on + self.off > 0:
            raise ValueError("periodic: on and off are both 0")

    def lost(self, draws: Draws) -> Lost:
        on_ns, period_ns, offset_ns = round(self.on * NS), round((self.on + self.off) * NS), round(self.offset * NS)
        return lambda at: at.time_ns >= offset_ns and (at.time_ns - offset_ns) % period_ns >= on_ns


@dataclass(frozen=True, slots=True)
class Every:
    """Every ``n``-th frame, the first at index ``offset``."""

    n: int = field(metadata=parsed_by(integer(1)))
    offset: int = field(default=0, metadata=parsed_by(integer(0)))

    def lost(self, draws: Draws) -> Lost:
        n, offset = self.n, self.offset
        return lambda at: at.index >= offset and (at.index - offset) % n == 0


@dataclass(frozen=True, slots=True)
class Listed:
    """The frames of a LIST."""

    frames: tuple[Indices, ...] = field(metadata=parsed_by(indices, rest=True))

    def lost(self, draws: Draws) -> Lost:
        frames = self.frames
        return lambda at: any(at.index in part for part in frames)


@dataclass(frozen=True, slots=True)
class LossTrace:
    """1 for lost and 0 for passed, frame by frame, over and over."""

    values: tuple[int, ...] = field(metadata=parsed_by(integer(0, 1), rest=True))

    def lost(self, draws: Draws) -> Lost:
        values, size = self.values, len(self.values)
        return lambda at: values[at.index % size]


LOSSES: dict[str, type[LossModel]] = {
    "bernoulli": Bernoulli,
    "gemodel": GilbertElliott,
    "state": FourState,
    "onoff": OnOff,
    "periodic": Periodic,
    "every": Every,
    "list": Listed,
    "trace": LossTrace,
}
_named = one_of(LOSSES, "loss model")


def loss_model(text: str) -> LossModel:
    """A bare probability, or a call of :data:`LOSSES`; raises ValueError."""
    return Bernoulli(probability(text)) if text[:1] in "0123456789.+-" else _named(text)


@dataclass(frozen=True, slots=True)
class Loss:
    model: LossModel = field(metadata=parsed_by(loss_model))
    when: Selector = field(default=DATA, metadata=parsed_by(selector))

    def lost(self, draws: Draws) -> Lost:
        return self.model.lost(draws)
