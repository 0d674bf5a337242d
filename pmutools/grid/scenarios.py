"""Disturbances as data: what happens to a plant, and when. Times are seconds of the scenario."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from pmutools.errors import SettingsError
from pmutools.grid.multisine import Multisine
from pmutools.grid.signals import Common


class Pulse(NamedTuple):
    """Constant power over a time. ``input`` is ``brake`` or ``probe`` (added to the modulation at the plant)."""

    input: str
    start_s: float
    stop_s: float
    mw: float


class GenerationLoss(NamedTuple):
    """A generator that trips in the south, at ``start_s`` and for good.

    The frequency of the whole interconnection falls from ``rocof_hz_s`` on towards ``settles_hz``, exponentially, in
    the north ``lag_s`` later than in the south; and the swing between them is pushed by a share of the lost power.
    """

    start_s: float
    mw: float
    rocof_hz_s: float
    settles_hz: float
    lag_s: float
    swing_share: float
    """Of ``mw``: a load of this size in the north would push the swing as much, the other way."""

    def common(self, time_s: float, bus: str) -> Common:
        """What all places of ``bus`` have in common at ``time_s``."""
        since_s = time_s - self.start_s - (self.lag_s if bus == "north" else 0.0)
        if since_s <= 0:
            return Common()
        tau_s = self.settles_hz / self.rocof_hz_s
        left = math.exp(-since_s / tau_s)
        deviation_hz = self.settles_hz * (1 - left)
        turned = self.settles_hz * since_s - tau_s * deviation_hz
        return Common(2 * math.pi * turned, deviation_hz, self.rocof_hz_s * left)


class Scenario(NamedTuple):
    """A named course of events."""

    name: str
    text: str
    pulses: tuple[Pulse, ...] = ()
    condition: str = "normal"
    """Of the plant, from the start."""
    ambient_mw: float = 0.0
    """Standard deviation of random load, drawn anew 60 times a second (seeded)."""
    multisine: Multisine | None = None
    """A probing signal, held for 1/60 s each."""
    loss: GenerationLoss | None = None
    duration_s: float = 30.0
    ringdown_s: tuple[float, float] | None = None
    """Where the free swing is judged; None where there is none."""


BRAKE_MW: Final = 1400.0
"""Chief Joseph dynamic brake; connected for 0.5 s (section VI)."""
SOUTH_LOSS: Final = GenerationLoss(5.0, 1400.0, rocof_hz_s=-0.069, settles_hz=-0.155, lag_s=0.03, swing_share=0.3)
"""Assumed throughout: 1,400 MW out of 605 GW·s of inertia, 900 MW per 0.1 Hz, and what makes Figs. 13 and 14."""


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
            "bc-alberta-separation",
            "Alberta separates from British Columbia: one slower North-South mode is left",
            (Pulse("brake", 5.0, 5.5, 1000.0),),
            condition="bc-alberta-separated",
            ringdown_s=(6.5, 20.5),
        ),
        Scenario(
            "square-pulse",
            "±125 MW, three cycles at 0.4 Hz, into the HVDC line",
            square_wave("probe", 5.0, 0.4, 3, 125.0),
            ringdown_s=(13.5, 25.5),
        ),
        Scenario(
            "probing",
            "a multisine of ±20 MW, 0.1 to 5 Hz, into the HVDC line for 20 minutes",
            multisine=Multisine(5.0, 1205.0, 20.0),
            duration_s=1210.0,
        ),
        Scenario(
            "south-generation-loss",
            "1,400 MW of generation trip in the south: frequency falls there first",
            loss=SOUTH_LOSS,
            ringdown_s=(6.5, 18.5),
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
