"""From the active instance's wish to what is driven: transfer, limit, probing signal, slew backstop."""

from __future__ import annotations

from typing import NamedTuple

from dcon import limiter
from dcon.core.law import Transfer, saturate
from dcon.core.params import Params
from dcon.core.probe import IDLE, Probe, advance
from dcon.core.state import State
from dcon.core.system import DRIVING
from dcon.core.values import Mode, SystemState


class Command(NamedTuple):
    """What leaves, and what is remembered of how it came about."""

    command_mw: float = 0.0
    """Feedback alone, limited; computed in open loop too."""
    driven_mw: float = 0.0
    """Feedback (in closed loop) and probing signal together, limited."""
    probe_mw: float = 0.0
    """The probing signal's part of ``driven_mw``, or of what it would be in open loop."""
    probe: Probe = IDLE
    transfer: Transfer = Transfer()
    valid: bool = True
    slewed: bool = False

    @property
    def is_over(self) -> bool:
        """Everything has come down to 0."""
        return self.transfer.left_ticks == 0 and self.command_mw == 0.0 == self.driven_mw and not self.probe.is_on


NONE = Command()


def form(
    params: Params, state: State, system: SystemState, mode: Mode, active: int | None, own_mw: float, probe: Probe
) -> Command:
    """The command of a tick in ``system``, where ``own_mw`` is what the instance ``active`` asks for.

    A change of what is followed begins a transfer from the last command, so that the command takes no step.
    """
    if system not in DRIVING:
        return NONE
    source = active if system is SystemState.ACTIVE else None
    last_source = state.active if state.system is SystemState.ACTIVE else None
    target_mw = own_mw if source is not None else 0.0
    if source != last_source:
        transfer = Transfer(state.command_mw - target_mw, params.transfer_ticks, params.transfer_ticks)
    else:
        transfer = state.transfer.tick()
    period_s = 1.0 / params.tick_hz
    wanted_mw = saturate(target_mw + transfer.residual_mw, params.limit_mw)
    limited = limiter.limit(wanted_mw, state.command_mw, period_s, params.limit_mw)
    if limited.reason == "invalid":
        return Command(valid=False)
    if probe.is_on:
        settings, stopping = params.probing, system is not SystemState.ACTIVE
        ramp_s = min(settings.ramp_s, params.transfer_s) if stopping else settings.ramp_s
        probe = probe._replace(stopping=probe.stopping or stopping)
        probe = advance(probe, params.waveform, ramp_s, settings.slew_mw_per_s, params.tick_hz)
    feedback_mw = limited.mw if mode is Mode.CLOSED_LOOP else 0.0
    shown_mw = saturate(limited.mw + probe.mw, params.limit_mw) - limited.mw
    if not (mode is Mode.CLOSED_LOOP or params.probing.open_loop):
        return Command(limited.mw, 0.0, shown_mw, probe, transfer, True, limited.reason == "slew")
    if not probe.is_on and feedback_mw == limited.mw and state.driven_mw == state.command_mw:
        driven = limited
    else:
        driven = limiter.limit(feedback_mw + probe.mw, state.driven_mw, period_s, params.limit_mw)
        if driven.reason == "invalid":
            return Command(valid=False)
    slewed = "slew" in (limited.reason, driven.reason)
    return Command(limited.mw, driven.mw, driven.mw - feedback_mw, probe, transfer, True, slewed)
