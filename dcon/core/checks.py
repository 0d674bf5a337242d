"""What a check is: a row of a table, and a supervisor is the tables that one ``step`` uses.

A row judges one number. It is up while the number is outside the row's bounds, NaN included, and has been so for the
row's time; what follows is the row's ``action``, decided here and nowhere else. None is "not judged": the check is
down and its time starts again.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import Any, Generic, NamedTuple, TypeVar

from dcon.core.feedback import Feedback
from dcon.core.params import Params, PmuParams
from dcon.core.quick import Limits, limits_of
from dcon.core.state import Evidence, Instance, Pmu
from dcon.core.values import Sample, Surroundings, SystemState


class Scope(StrEnum):
    """Whom a check concerns."""

    PMU = "pmu"
    INSTANCE = "instance"
    SYSTEM = "system"


class Action(StrEnum):
    """What a check does while it is up."""

    WARN = "warn"
    DISABLE = "disable"
    """Disables the instance, or all instances of the PMU; the command switches, or ramps to 0 with the last of them."""
    DISARM = "disarm"
    """Ramps the command to 0."""
    TRIP = "trip"
    """0 MW at once, FAULT."""
    ESTOP = "estop"
    """0 MW at once, ESTOP."""


LATCHING = (Action.DISARM, Action.TRIP, Action.ESTOP)
"""Actions that, once taken, ask for an acknowledgement before the controller may be armed again."""


class PairView(NamedTuple):
    """What an instance check sees: both PMUs have a frequency."""

    north: Pmu
    south: Pmu
    delta_f_mhz: float
    median_mhz: float | None
    """Of Δf over the instances that are READY; None where they are fewer than three."""
    now_ns: int


class SystemView(NamedTuple):
    """What a system check sees of a tick, before its orders and its command."""

    state: SystemState
    ready: int
    """Instances that are READY or HELD."""
    active: Instance | None
    angle_deg: float | None
    """Of the active instance, north minus south, within ±180°; None without one."""
    slipped: bool
    """It went through ±180° since the last tick."""
    overruns: int
    """Ticks of the last second that were not done in time."""
    feedback: Feedback
    """The command without probing, up to the last tick."""
    driven_mw: float
    """Output of the last tick."""
    surroundings: Surroundings
    now_ns: int


FrameValue = Callable[[Params, PmuParams, Pmu, Pmu, Sample], float | None]
"""(params, pmu, memory before the frame, memory with it, the frame). A frame that disables is not used."""
PmuValue = Callable[[Params, Pmu, int], float | None]
"""(params, pmu after the tick's frames, now_ns)."""
PairValue = Callable[[Params, PairView], float | None]
SystemValue = Callable[[Params, SystemView], float | None]

V = TypeVar("V")
Bound = float | str | Callable[[Params], float]
"""A number, the name of a threshold, or what gives the number."""


class Check(NamedTuple, Generic[V]):
    """A row. ``value`` is None where the engine itself raises the check; its docstring says what it is."""

    name: str
    scope: Scope
    action: Action
    value: V
    text: str
    """For the operator."""
    high: Bound = 0.0
    low: Bound = -math.inf
    hold: str = ""
    """Threshold that says for how long (``_s``, ``_frames``, ``_ticks``); "" is at once."""
    unit: str = ""
    """Of ``value``, where no threshold gives it."""


class Judged(NamedTuple):
    """A row made ready for one set of parameters."""

    bit: int
    value: Callable[..., float | None]
    low: float
    high: float
    held: int
    """Place among the counts of a table; -1 where the row acts at once."""
    need: int
    """Frames or ticks for which the condition must hold."""


def bound(params: Params, given: Bound) -> float:
    """The number that a bound stands for."""
    if isinstance(given, str):
        return float(getattr(params.thresholds, given))
    return float(given(params)) if callable(given) else float(given)


def needed(params: Params, hold: str, rate_hz: int) -> int:
    """Frames or ticks, ``rate_hz`` of them in a second, that a row's time comes to."""
    if not hold:
        return 1
    given = getattr(params.thresholds, hold)
    return max(1, round(given * rate_hz) if hold.endswith("_s") else int(given))


def judge(
    rows: Sequence[Judged], held: tuple[int, ...], arguments: tuple[object, ...]
) -> tuple[int, tuple[int, ...], Evidence]:
    """(bits of the rows that are up, counts, what was found); ``()`` stands for counts that are all 0."""
    raised = 0
    counts: dict[int, int] = {}
    found: Evidence = ()
    for bit, value_of, low, high, at, need in rows:
        value = value_of(*arguments)
        if value is None or low <= value <= high:
            continue
        if at >= 0:
            counts[at] = count = min(need, (held[at] if held else 0) + 1)
            if count < need:
                continue
        raised |= bit
        found += ((bit, float(value)),)
    if counts:
        return raised, tuple(counts.get(at, 0) for at in range(1 + max(row.held for row in rows))), found
    return raised, (), found


class Tables(NamedTuple):
    """A supervisor's rows, ready for one set of parameters."""

    params: Params
    frame: tuple[Judged, ...]
    pmu: tuple[Judged, ...]
    instance: tuple[Judged, ...]
    system: tuple[tuple[Judged, ...], ...]
    """Those to judge, by :func:`which`."""
    limits: dict[int, tuple[float, float]]
    """(low, high) by bit."""
    quick: Limits | None
    """For the uneventful case; None where the rows are not those that it knows."""


def which(feedback: bool, told: bool) -> int:
    """Place in ``Tables.system``: with the rows of the feedback command, with those of the surroundings."""
    return feedback + 2 * told


@dataclass(frozen=True)
class Supervisor:
    """The rows of every kind; bit k of ``Record.flags`` is the k-th row in the order of these fields."""

    engine: tuple[Check[None], ...]
    frame: tuple[Check[FrameValue], ...]
    pmu: tuple[Check[PmuValue], ...]
    instance: tuple[Check[PairValue], ...]
    system: tuple[Check[SystemValue], ...]
    feedback: tuple[Check[SystemValue], ...] = ()
    """Judged in ACTIVE only."""
    surroundings: tuple[Check[SystemValue], ...] = ()
    """Judged where something is told, or required."""
    known: tuple[Any, Any, Any] = ((), (), ())
    """Tables of frames, PMUs and instances that :mod:`dcon.core.quick` passes where none of their rows is up."""
    _ready: list[Tables] = field(default_factory=list, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if len(self.names) > 64 or len(set(self.names)) < len(self.names):
            raise ValueError("more than 64 checks, or two of one name")

    @cached_property
    def rows(self) -> tuple[Check[Any], ...]:
        """Every check, in the order of their bits."""
        return (
            *self.engine,
            *self.frame,
            *self.pmu,
            *self.instance,
            *self.system,
            *self.feedback,
            *self.surroundings,
        )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Name of each bit of ``Record.flags``, from bit 0."""
        return tuple(row.name for row in self.rows)

    @cached_property
    def bits(self) -> dict[str, int]:
        return {name: 1 << index for index, name in enumerate(self.names)}

    def mask(self, *actions: Action) -> int:
        """Bits of all checks with one of these actions."""
        return sum(self.bits[row.name] for row in self.rows if row.action in actions)

    @cached_property
    def disabling(self) -> int:
        return self.mask(Action.DISABLE)

    @cached_property
    def disarming(self) -> int:
        return self.mask(Action.DISARM)

    @cached_property
    def tripping(self) -> int:
        return self.mask(Action.TRIP)

    @cached_property
    def stopping(self) -> int:
        return self.mask(Action.ESTOP)

    @cached_property
    def of_frames(self) -> int:
        """Bits that frames raise, and that stay as they are while none comes."""
        engine = sum(self.bits[row.name] for row in self.engine if row.scope is Scope.PMU)
        return engine + sum(self.bits[row.name] for row in self.frame)

    @cached_property
    def of_commands(self) -> int:
        """Bits that the forming of the command raises."""
        return self.bits["command_invalid"] | self.bits["slew_limited"]

    def tables(self, params: Params) -> Tables:
        """The rows for ``params``; those asked for last are kept."""
        if not self._ready or self._ready[0].params is not params:
            self._ready[:] = (self._made(params),)
        return self._ready[0]

    def _made(self, params: Params) -> Tables:
        rate_hz, tick_hz = params.rate_hz, params.tick_hz
        system = self._judged(params, (*self.system, *self.feedback, *self.surroundings), tick_hz)
        plain, last = len(self.system), len(self.system) + len(self.feedback)
        always, feedback, told = system[:plain], system[plain:last], system[last:]
        return Tables(
            params,
            self._judged(params, self.frame, rate_hz),
            self._judged(params, self.pmu, tick_hz),
            self._judged(params, self.instance, tick_hz),
            (always, always + feedback, always + told, always + feedback + told),
            {
                self.bits[row.name]: (bound(params, row.low), bound(params, row.high))
                for row in self.rows
                if row.value is not None
            },
            limits_of(params) if self._is_known else None,
        )

    @property
    def _is_known(self) -> bool:
        return all(map(operator.is_, self.known, (self.frame, self.pmu, self.instance)))

    def _judged(self, params: Params, rows: Iterable[Check[Any]], rate_hz: int) -> tuple[Judged, ...]:
        places = iter(range(64))
        return tuple(
            Judged(
                self.bits[row.name],
                row.value,
                bound(params, row.low),
                bound(params, row.high),
                next(places) if row.hold else -1,
                needed(params, row.hold, rate_hz),
            )
            for row in rows
        )

    def named(self, bits: int) -> list[str]:
        """Names of the set bits, lowest first."""
        found = []
        while bits:
            low = bits & -bits
            found.append(self.names[low.bit_length() - 1])
            bits ^= low
        return found
