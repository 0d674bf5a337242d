"""The probing signal of a scenario, given to the controller instead of to the plant.

A plant on its own takes the signal at its input (``pmu synth``). With a controller it goes the way that it has in the
field: the order ``probe_start``, through the limiter, into the line, logged apart as ``probe_mw``.
"""

from __future__ import annotations

from typing import NamedTuple

from pmutools.grid.scenarios import Pulse, Scenario

INPUT = "probe"


class Split(NamedTuple):
    """A scenario, part by part."""

    plant: Scenario
    """What is left for the plant."""
    section: str
    """``[probing]`` of the initialisation file; empty where the scenario has no probing signal."""
    start_s: float
    """When to order it."""


def split_probing(scenario: Scenario, *, open_loop: bool) -> Split:
    """Take the probing signal out of a scenario. ``open_loop``: it is driven alone, without the command."""
    pulses = [pulse for pulse in scenario.pulses if pulse.input == INPUT]
    if pulses:
        start_s, lines = pulses[0].start_s, _square(pulses)
    elif (signal := scenario.multisine) is not None:
        start_s = signal.start_s
        lines = [
            "kind = multisine",
            f"amplitude_mw = {signal.peak_mw!r}",
            f"low_hz = {signal.low_hz!r}",
            f"high_hz = {signal.high_hz!r}",
            f"tones = {signal.number}",
            f"period_s = {signal.period_s!r}",
            f"duration_s = {signal.stop_s - signal.start_s!r}",
            f"seed = {signal.seed}",
        ]
    else:
        return Split(scenario, "", 0.0)
    rest = tuple(pulse for pulse in scenario.pulses if pulse.input != INPUT)
    lines = ["[probing]", *lines, f"open_loop = {str(open_loop).lower()}"]
    return Split(scenario._replace(pulses=rest, multisine=None), "\n".join(lines) + "\n", start_s)


def _square(pulses: list[Pulse]) -> list[str]:
    """Pulses that are the half cycles of one square wave."""
    first = pulses[0]
    return [
        "kind = square",
        f"amplitude_mw = {abs(first.mw)!r}",
        f"frequency_hz = {0.5 / (first.stop_s - first.start_s)!r}",
        f"cycles = {len(pulses) // 2}",
    ]
