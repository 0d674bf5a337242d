"""What the controller remembers from one tick to the next: small immutable tuples, nothing else."""

from __future__ import annotations

import cmath
from typing import NamedTuple

from dcon.core.differentiator import EMPTY, Filter
from dcon.core.feedback import QUIET, Feedback
from dcon.core.law import Transfer
from dcon.core.params import Params
from dcon.core.probe import IDLE, Probe
from dcon.core.register import NO_FLAGS, Register
from dcon.core.values import InstanceState, Mode, SystemState

Evidence = tuple[tuple[int, float], ...]
"""(bit, what was found) of checks that are up."""


class Freq(NamedTuple):
    """The PMU's own FREQ through the low-pass that the differentiator has in it: inputs and outputs of two frames.

    Hz from nominal; NaN before the first frame of a run, and where the PMU sends none.
    """

    x1: float = cmath.nan
    x2: float = cmath.nan
    y1: float = cmath.nan
    y2: float = cmath.nan


UNKNOWN = Freq()


class Pmu(NamedTuple):
    """One PMU: its newest good frame, filter, and ring of frequencies.

    A run is an unbroken sequence of good frames; a fault empties filter and ring, and the next good frame starts
    another. So the ring's slots are consecutive, and the slot of ``ring[k]`` is ``slot - k``.
    """

    slot: int | None = None
    """Reporting instant (round(t·Fs)) of the run's newest frame; None between runs."""
    time_ns: int = 0
    arrival_ns: int | None = None
    """Of the newest frame accepted, in whatever run; None before the first."""
    time_base: int = 1_000_000
    v1: complex = complex(cmath.nan, cmath.nan)
    magnitude_v: float = cmath.nan
    filter: Filter = EMPTY
    ring: tuple[float, ...] = ()
    """f of the run in Hz (deviation), newest first; at most ``RING_SIZE``."""
    idle_ticks: int = 0
    """Ticks since a frame was accepted."""
    raised: int = 0
    """Checks that are up, as bits."""
    freq: Freq = UNKNOWN
    held: tuple[int, ...] = ()
    """Frames for which the condition of each check that takes its time has held; () is all 0."""
    evidence: Evidence = ()


_READY, _HELD = InstanceState.READY, InstanceState.HELD  # looking a member up costs as much as comparing it


class Instance(NamedTuple):
    """One control instance."""

    state: InstanceState = InstanceState.DISABLED
    verified: int = 0
    """Aligned frames since the last fault."""
    slot: int | None = None
    """Common slot of the last tick that had one."""
    delta_f_mhz: float = cmath.nan
    reason: str = ""
    raised: int = 0
    held: tuple[int, ...] = ()
    """Ticks for which the condition of each check that takes its time has held; () is all 0."""
    evidence: Evidence = ()

    @property
    def is_ready(self) -> bool:
        return self.state is _READY or self.state is _HELD


class State(NamedTuple):
    """The whole controller."""

    pmus: tuple[Pmu, ...]
    instances: tuple[Instance, ...]
    system: SystemState
    mode: Mode
    active: int | None
    gain_mw_per_mhz: float
    target_gain_mw_per_mhz: float
    command_mw: float
    """Of the last tick, without probing."""
    transfer: Transfer
    raised: int
    """System checks that are up, as bits."""
    held: tuple[int, ...] = ()
    driven_mw: float = 0.0
    """Output of the last tick."""
    probe: Probe = IDLE
    feedback: Feedback = QUIET
    angle_deg: float | None = None
    """Of the active instance, north minus south; None without one."""
    overruns: int = 0
    """Of the last second: bit k is the tick k ticks ago."""
    flags: Register = NO_FLAGS
    """By (name, subject); bounded by the number of checks times that of PMUs and instances."""


def initial_state(params: Params, *, mode: Mode = Mode.OPEN_LOOP, verified: bool = False) -> State:
    """Memory before the first tick: system in INIT, nothing known of any PMU.

    ``verified`` gives every instance the credit of ``init_s`` of good data, as a simulated session has it: READY as
    soon as its two PMUs yield a frequency, until the first fault.
    """
    credit = params.init_frames if verified else 0
    return State(
        pmus=(Pmu(),) * len(params.pmus),
        instances=(Instance(verified=credit),) * len(params.instances),
        system=SystemState.INIT,
        mode=mode,
        active=None,
        gain_mw_per_mhz=params.gain_mw_per_mhz,
        target_gain_mw_per_mhz=params.gain_mw_per_mhz,
        command_mw=0.0,
        transfer=Transfer(),
        raised=0,
    )
