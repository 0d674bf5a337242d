"""The tables of a session as columns: what :func:`dcon.columns.read.read_columns` gives."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from dcon.core.values import Flag, InstanceState, Mode, SystemState, value_of
from dcon.session.codec import Watchdog
from dcon.session.newer import Newer
from pmutools.flow import StampSource
from pmutools.schema.log_reader import Damage

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Codes = npt.NDArray[np.uint8]
Array = npt.NDArray[Any]

STATES: Final = tuple(map(str, SystemState))
"""``tick.state`` counts in it."""
MODES: Final = tuple(map(str, Mode))
INSTANCE_STATES: Final = tuple(map(str, InstanceState))
STAMP_SOURCES: Final = tuple(map(str, StampSource))
UNKNOWN: Final = 255
"""Code of a state that this version does not know, or that the log does not tell."""


class TickColumns(NamedTuple):
    """One row a tick, T in all, in file order; P PMUs. What a tick does not tell is NaN."""

    tick_ns: Ints
    """(T,) POSIX UTC."""
    state: Codes
    """(T,) places in :data:`STATES`."""
    mode: Codes
    """(T,) places in :data:`MODES`."""
    active: npt.NDArray[np.int16]
    """(T,) places in ``instances``; -1 for none."""
    gain_mw_per_mhz: Floats
    delta_f_mhz: Floats
    """(T,) of the active instance."""
    command_mw: Floats
    output_v: Floats
    probe_mw: Floats
    flags: npt.NDArray[np.uint64]
    """(T,) bit k is ``flags[k]`` of the session."""
    f_hz: Floats
    """(T, P) absolute, by the controller's own filter, newest frame."""
    age_ms: Floats
    """(T, P) tick minus stamp of the newest frame."""
    compute_us: Floats
    late_us: Floats
    pdci_mw: Floats


class InstanceColumns(NamedTuple):
    """The I instances at each of the T ticks of :class:`TickColumns`; which one is active is there."""

    state: Codes
    """(T, I) places in :data:`INSTANCE_STATES`."""
    delta_f_mhz: Floats
    """(T, I)"""
    command_mw: Floats
    """(T, I) what each alone would command."""


class PmuColumns(NamedTuple):
    """The N frames of one PMU that ticks consumed, in file order."""

    time_ns: Ints
    """(N,) stamp, POSIX UTC."""
    arrival_ns: Ints
    """(N,) 0 where unknown."""
    tick_ns: Ints
    """(N,) the tick that consumed it."""
    v1_mag: Floats
    """(N,) |V1|, V RMS."""
    v1_rad: Floats
    """(N,) arg V1, within ±π."""
    frequency_hz: Floats
    """(N,) FREQ as sent, absolute."""
    rocof_hz_s: Floats
    stat: npt.NDArray[np.uint16]
    time_quality: Codes
    stamp_source: Codes
    """(N,) places in :data:`STAMP_SOURCES`."""


class EventRow(NamedTuple):
    tick_ns: int
    name: str
    subject: str
    detail: str


class OrderRow(NamedTuple):
    """What the operator ordered: an input of the tick."""

    tick_ns: int
    name: str
    value: float
    text: str
    who: str
    why: str = ""

    @property
    def given(self) -> float | None:
        """``value``, where the order has one."""
        return value_of(self.name, self.value)


class FlagRow(NamedTuple):
    """An entry of the flag register that changed in a tick, as it was then."""

    tick_ns: int
    flag: Flag


@dataclass(frozen=True)
class SessionColumns:
    """A session. Tables that were not asked for are empty."""

    metadata: dict[str, str]
    """Of the first part: seed, plant, scenario, version ..."""
    ini_text: str
    pmus: tuple[str, ...]
    instances: tuple[str, ...]
    flags: tuple[str, ...]
    """Names, in the order of columns and bits."""
    tick: TickColumns
    instance: InstanceColumns
    pmu: dict[str, PmuColumns]
    """By name: each that the log has frames of."""
    events: list[EventRow]
    orders: list[OrderRow]
    flag_changes: list[FlagRow]
    watchdog: list[Watchdog]
    gaps: list[int]
    """Rows of ``tick`` before which the log has lost something; 0 for its beginning, T for its end."""
    incomplete_ticks: int
    """Ticks whose ``/dcon/instance`` is missing; their instances are UNKNOWN and NaN."""
    damage: Damage
    """Of all parts; ``cut`` alone means no loss but that of the end."""
    newer: Newer = field(default_factory=Newer)
    """What the log holds that this program does not know."""
    missing: list[str] = field(default_factory=list)
    """What is not there before and between the parts, in words."""

    def flag(self, name: str) -> npt.NDArray[np.bool_]:
        """(T,) whether a flag is up at each tick. Raises KeyError for a name that the session lacks."""
        if name not in self.flags:
            raise KeyError(name)
        return (self.tick.flags >> np.uint64(self.flags.index(name)) & np.uint64(1)).astype(np.bool_)
