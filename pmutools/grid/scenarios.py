"""Disturbances as data: what happens to a plant, and when. Times are seconds of the scenario."""

from __future__ import annotations

from typing import Final, NamedTuple

from pmutools.errors import SettingsError


class Pulse(NamedTuple):
    """Constant power over a time. ``input`` is ``brake`` or ``probe`` (added to the modulation at the plant)."""

    input: str
    start_s: float
    stop_s: float
    mw: float


class Scenario(NamedTuple):
    """A named course of events."""

    name: str
    text: str
    pulses: tuple[Pulse, ...] = ()
    condition: str = "normal"
    """Of the plant, from the start."""
    ambient_mw: float = 0.0
    """Standard deviation of random load, drawn anew 60 times a second (seeded)."""
    duration_s: float = 30.0
    ringdown_s: tuple[float, float] | None = None
    """Where the free swing is judged; None where there is none."""


BRAKE_MW: Final = 1400.0
"""Chief Joseph dynamic brake; connected for 0.5 s (section VI)."""


def square_wave(input: str, start_s: float, frequency_hz: float, cycles: int, mw: float) -> tuple[Pulse, ...]:
    """``cycles`` of a square wave, positive half first."""
    half = 0.5 / frequency_hz
    return tuple(
        Pulse(input, start_s + k * half, start_s + (k + 1) * half, -mw if k % 2 else mw) for k in range(2 * cycles)
    )


SCENARIOS: Final = {
    scenario.name: scenario
    for scenario in (
        Scenario(
            "cjb",
            "Chief Joseph brake: 1,400 MW for 0.5 s",
            (Pulse("brake", 5.0, 5.5, BRAKE_MW),),
            ringdown_s=(6.5, 18.5),
        ),
        Scenario(
            "bc-us-separation",
            "British Columbia separates from the US in dual export: the mode loses all damping",
            (Pulse("brake", 5.0, 5.5, 1000.0),),
            condition="bc-us-separated",
            duration_s=60.0,
            ringdown_s=(6.5, 26.5),
        ),
        Scenario(
            "square-pulse",
            "±125 MW, three cycles at 0.4 Hz, into the HVDC line",
            square_wave("probe", 5.0, 0.4, 3, 125.0),
            ringdown_s=(13.5, 25.5),
        ),
        Scenario("ambient", "nothing but random load", ambient_mw=60.0, duration_s=60.0),
    )
}


def scenario(name: str) -> Scenario:
    """The scenario ``name``. Raises SettingsError for one that there is not."""
    try:
        return SCENARIOS[name]
    except KeyError:
        raise SettingsError(f"no scenario {name!r}: one of {', '.join(SCENARIOS)}") from None
