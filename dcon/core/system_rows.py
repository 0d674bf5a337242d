"""The checks of the whole controller: its active instance, its command, its platform and the line.

As in :mod:`dcon.core.rows`, each function gives the number that its row judges; NaN raises the check, None leaves it
unjudged. A source that is not fitted is None, unless a setting requires it: then it is NaN.
"""

from __future__ import annotations

import math

from dcon.core import feedback
from dcon.core.checks import Action, Check, Scope, SystemValue, SystemView
from dcon.core.line import line_status, margin_mw
from dcon.core.params import Params
from dcon.core.system import ENGAGED
from dcon.core.values import SystemState
from dcon.limiter import MW_PER_V


def ready_instances(_params: Params, view: SystemView) -> float:
    """READY instances."""
    return view.ready


def frequency_difference(_params: Params, view: SystemView) -> float | None:
    """|Δf| of the active instance."""
    return None if view.active is None else abs(view.active.delta_f_mhz)


def angle_difference(_params: Params, view: SystemView) -> float | None:
    """Angle between the two PMUs of the active instance."""
    return None if view.angle_deg is None else abs(view.angle_deg)


def slipping(_params: Params, view: SystemView) -> float:
    """1 where that angle went through 180°."""
    return float(view.slipped)


def saturation(params: Params, view: SystemView) -> float:
    """Share of the last ``saturation_s`` that the command spent at its limit."""
    return feedback.saturated_percent(params, view.feedback)


def ringing(_params: Params, view: SystemView) -> float:
    """RMS of the command, before its limit, from ``ringing_low_hz`` to ``ringing_high_hz``."""
    return feedback.ringing_mw(view.feedback)


def growing(params: Params, view: SystemView) -> float | None:
    """Growth of the swing of the command over three cycles."""
    return feedback.growth(params, view.feedback)


def bias(params: Params, view: SystemView) -> float | None:
    """|mean| of the command over the last ``bias_s``."""
    return feedback.bias_mw(params, view.feedback)


def overrun(_params: Params, view: SystemView) -> float:
    """1 where the last tick was late."""
    return view.overruns & 1


def overruns(_params: Params, view: SystemView) -> float | None:
    """Late ticks of the last second, while armed."""
    return view.overruns.bit_count() if view.state in ENGAGED else None


def readback(_params: Params, view: SystemView) -> float | None:
    """Output read back against output ordered, in percent of 10 V."""
    read_v = view.surroundings.readback_v
    return None if read_v is None else 10 * abs(read_v - view.driven_mw / MW_PER_V)


def gps(params: Params, view: SystemView) -> float | None:
    """Time since the GPS lock."""
    return _told(view.surroundings.gps_age_s, params.required.gps)


def watchdog(params: Params, view: SystemView) -> float | None:
    """1 where the watchdog is healthy."""
    healthy = view.surroundings.watchdog_healthy
    return _told(None if healthy is None else float(healthy), params.required.watchdog)


def emergency_stop(params: Params, view: SystemView) -> float | None:
    """1 where the emergency stop is released."""
    released = view.surroundings.estop_released
    return _told(None if released is None else float(released), params.required.watchdog)


def relays(_params: Params, view: SystemView) -> float | None:
    """1 where the relays are closed, in ARMED and ACTIVE."""
    closed = view.surroundings.relays_closed
    return float(closed) if closed is not None and view.state in _HELD_CLOSED else None


def server(params: Params, view: SystemView) -> float | None:
    """Silence of the server."""
    return _told(view.surroundings.server_age_s, params.required.server)


def disk(_params: Params, view: SystemView) -> float | None:
    """Free share of the disk."""
    return view.surroundings.disk_free_percent


def line_in_service(params: Params, view: SystemView) -> float | None:
    """1 where the line is in service."""
    status = line_status(params, view.surroundings, view.now_ns)
    return _told(None if status is None else float(status.in_service), params.required.line)


def line_enabled(params: Params, view: SystemView) -> float | None:
    """1 where the line accepts the command."""
    status = line_status(params, view.surroundings, view.now_ns)
    return _told(None if status is None else float(status.dcon_enabled), params.required.line)


def line_margin(params: Params, view: SystemView) -> float | None:
    """Room of the schedule, with all of the modulation added, within the line's rating and minimum."""
    status = line_status(params, view.surroundings, view.now_ns)
    return None if status is None else margin_mw(params, status, view.driven_mw)


def response_gain(_params: Params, view: SystemView) -> float | None:
    """Response of the line to the command."""
    return view.surroundings.response_gain


def response_lag(_params: Params, view: SystemView) -> float | None:
    """Lag of the line behind the command."""
    return view.surroundings.response_lag_ms


def _told(value: float | None, required: bool) -> float | None:
    return math.nan if value is None and required else value


_HELD_CLOSED = (SystemState.ARMED, SystemState.ACTIVE)
"""RAMPDOWN is on its way to open relays."""
_WARN = (Scope.SYSTEM, Action.WARN)
_DISARM = (Scope.SYSTEM, Action.DISARM)
_TRIP = (Scope.SYSTEM, Action.TRIP)
_ESTOP = (Scope.SYSTEM, Action.ESTOP)
_ANY = -math.inf
_YES = (math.inf, 1.0)
"""Bounds of what must be at least 1: a yes, or a count."""
_GAIN = ("response_gain_max", "response_gain_min")

SYSTEM_ROWS: tuple[Check[SystemValue], ...] = (
    Check("no_ready_instance", *_DISARM, ready_instances, "no control instance is READY", *_YES),
    Check("frequency_difference", *_DISARM, frequency_difference, "Δf: island suspected", "delta_f_max_mhz"),
    Check("angle_difference", *_DISARM, angle_difference, "angle: island suspected", "angle_max_deg"),
    Check("slipping", *_DISARM, slipping, "north and south slip: island suspected"),
)
FEEDBACK_ROWS: tuple[Check[SystemValue], ...] = (
    Check("saturation", *_DISARM, saturation, "the command is at its limit too often", "saturation_max_percent"),
    Check("ringing", *_DISARM, ringing, "the command rings", "ringing_max_mw", _ANY, "ringing_s"),
    Check("growing", *_DISARM, growing, "the command swings more and more", "growth_max"),
    Check("bias", *_WARN, bias, "the command leans to one side", "bias_max_mw"),
)
"""Of the command without probing."""
SURROUNDINGS_ROWS: tuple[Check[SystemValue], ...] = (
    Check("overrun", *_WARN, overrun, "a tick was not done in time"),
    Check("overruns", *_TRIP, overruns, "too many ticks were not done in time", "overruns_max"),
    Check("readback", *_TRIP, readback, "the output is not as ordered", "readback_max_percent", _ANY, "readback_ticks"),
    Check("gps", *_DISARM, gps, "the controller's clock has lost GPS", "gps_holdover_s"),
    Check("watchdog", *_TRIP, watchdog, "the watchdog is not healthy", *_YES),
    Check("estop", *_ESTOP, emergency_stop, "the emergency stop is pressed", *_YES),
    Check("line_out", *_DISARM, line_in_service, "the line is out of service", *_YES),
    Check("line_refuses", *_DISARM, line_enabled, "the line does not accept the command", *_YES),
    Check("line_window", *_DISARM, line_margin, "the schedule leaves no room", math.inf, 0.0, unit="MW"),
    Check("response_gain", *_WARN, response_gain, "the line answers too much or too little", *_GAIN),
    Check("response_lag", *_WARN, response_lag, "the line answers late", "response_lag_max_ms"),
    Check("response_gain_lost", *_DISARM, response_gain, "the line does not obey", *_GAIN, "response_s"),
    Check(
        "response_lag_lost",
        *_DISARM,
        response_lag,
        "the line obeys too late",
        "response_lag_max_ms",
        _ANY,
        "response_s",
    ),
    Check("server", *_WARN, server, "the server is silent; control goes on", "server_age_s"),
    Check("disk", *_WARN, disk, "the disk is nearly full", math.inf, "disk_min_percent"),
    Check("relays_open", *_DISARM, relays, "the relays are open, and nothing passes", *_YES, "relays_open_s"),
)
