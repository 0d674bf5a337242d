"""The seam for supervision: a check is a row of a table, and a supervisor is the tables that one ``step`` uses.

A test looks at values and answers whether its check is up; what follows is the row's ``action``, decided here and
nowhere else. The supervisor that grows rows, timers and acknowledgement passes its own tables to ``step``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Generic, NamedTuple, TypeVar

from dcon.core.params import Params, PmuParams
from dcon.core.state import Instance, Pmu
from dcon.core.values import Sample, SystemState


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


class SystemView(NamedTuple):
    """What a system check sees of a tick, before the command of that tick is formed."""

    state: SystemState
    ready: int
    """Instances that are READY or HELD."""
    active: Instance | None


FrameTest = Callable[[Params, PmuParams, Pmu, Pmu, Sample], bool]
"""(params, pmu, memory before the frame, memory with it, the frame). A frame that disables is not used."""
PmuTest = Callable[[Params, Pmu, int], bool]
"""(params, pmu after the tick's frames, now_ns)."""
InstanceTest = Callable[[Params, Pmu, Pmu, int], bool]
"""(params, north, south, now_ns); both have a frequency."""
SystemTest = Callable[[Params, SystemView], bool]

T = TypeVar("T")


class Check(NamedTuple, Generic[T]):
    """A row. ``test`` is None where the engine itself raises the check."""

    name: str
    scope: Scope
    action: Action
    test: T
    text: str
    """For the operator."""


@dataclass(frozen=True)
class Supervisor:
    """The rows of every kind; bit k of ``Record.flags`` is the k-th row in the order of these fields."""

    engine: tuple[Check[None], ...]
    frame: tuple[Check[FrameTest], ...]
    pmu: tuple[Check[PmuTest], ...]
    instance: tuple[Check[InstanceTest], ...]
    system: tuple[Check[SystemTest], ...]

    def __post_init__(self) -> None:
        if len(self.names) > 64 or len(set(self.names)) < len(self.names):
            raise ValueError("more than 64 checks, or two of one name")

    @cached_property
    def rows(self) -> tuple[tuple[str, Scope, Action, str], ...]:
        """(name, scope, action, text) of every check, in the order of their bits."""
        tables = (self.engine, self.frame, self.pmu, self.instance, self.system)
        return tuple((row.name, row.scope, row.action, row.text) for table in tables for row in table)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Name of each bit of ``Record.flags``, from bit 0."""
        return tuple(name for name, *_ in self.rows)

    @cached_property
    def bits(self) -> dict[str, int]:
        return {name: 1 << index for index, name in enumerate(self.names)}

    def mask(self, *actions: Action) -> int:
        """Bits of all checks with one of these actions."""
        return sum(self.bits[name] for name, _, action, _ in self.rows if action in actions)

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
    def of_frames(self) -> int:
        """Bits that frames raise, and that stay as they are while none comes."""
        of_ticks = {row.name for row in self.pmu}
        return sum(self.bits[name] for name, scope, *_ in self.rows if scope is Scope.PMU and name not in of_ticks)

    @cached_property
    def frame_tests(self) -> tuple[tuple[int, FrameTest], ...]:
        return tuple((self.bits[row.name], row.test) for row in self.frame)

    @cached_property
    def pmu_tests(self) -> tuple[tuple[int, PmuTest], ...]:
        return tuple((self.bits[row.name], row.test) for row in self.pmu)

    @cached_property
    def instance_tests(self) -> tuple[tuple[int, InstanceTest], ...]:
        return tuple((self.bits[row.name], row.test) for row in self.instance)

    @cached_property
    def system_tests(self) -> tuple[tuple[int, SystemTest], ...]:
        return tuple((self.bits[row.name], row.test) for row in self.system)

    def named(self, bits: int) -> list[str]:
        """Names of the set bits, lowest first."""
        found = []
        while bits:
            low = bits & -bits
            found.append(self.names[low.bit_length() - 1])
            bits ^= low
        return found
