"""What goes into a plant and what comes out of it."""

from __future__ import annotations

from typing import NamedTuple


class Drive(NamedTuple):
    """Power in MW, constant over a step of the plant."""

    modulation_mw: float = 0.0
    """Added to the HVDC line's schedule; positive withdraws at the north end and injects at the south end."""
    brake_mw: float = 0.0
    """Load of the dynamic brake in the north."""


class Common(NamedTuple):
    """Angle, deviation and rate that every place shares: the interconnection's own frequency."""

    angle_rad: float = 0.0
    deviation_hz: float = 0.0
    rocof_hz_s: float = 0.0


class Bus(NamedTuple):
    """Voltage at one bus: angle in the frame of nominal frequency (it turns, and is not wrapped), deviation, rate.

    These swing against other buses. What all share is beside them: a place that swings less with its bus has it whole.
    It is -0.0 where there is none, for to add that changes nothing, not even a sign.
    """

    angle_rad: float
    deviation_hz: float
    rocof_hz_s: float
    voltage_pu: float = 1.0
    common_rad: float = -0.0
    common_hz: float = -0.0
    common_hz_s: float = -0.0
