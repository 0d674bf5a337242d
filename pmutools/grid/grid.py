"""A plant that lives through a scenario while commands reach it late.

Time is an argument throughout: a simulation advances tick by tick, a live emulation as its clock says. Every change
of power falls at its own instant, whatever the steps that ``advance`` is called with.
"""

from __future__ import annotations

import math
from bisect import insort
from operator import itemgetter
from typing import Final

from pmutools.draws import normal
from pmutools.grid.plant import Plant
from pmutools.grid.scenarios import Scenario
from pmutools.grid.signals import Bus, Drive

NS: Final = 1_000_000_000
SIGNAL_HZ: Final = 60
"""Random load and probing signals change so often."""
MAX_COMMANDS: Final = 4096
"""Commands under way at once; at 60/s that is a minute of delay. Of more, the oldest take effect at once."""

_NEVER = 1 << 63
_effect_ns = itemgetter(0)


class Grid:
    """``plant`` in ``scenario``, which starts at ``start_ns`` (POSIX UTC)."""

    def __init__(
        self, plant: Plant, scenario: Scenario, *, start_ns: int, command_delay_ns: int = 11_000_000, seed: int = 0
    ) -> None:
        self.plant = plant
        self.scenario = scenario
        self.start_ns = start_ns
        self.time_ns = start_ns
        self.command_delay_ns = command_delay_ns
        self.seed = seed
        self.command_mw = 0.0
        """In effect at the plant now."""
        self._under_way: list[tuple[int, float]] = []
        self._signals = bool(scenario.ambient_mw) or scenario.multisine is not None
        starts = [edge for pulse in scenario.pulses for edge in (pulse.start_s, pulse.stop_s)]
        if scenario.loss is not None:
            starts.append(scenario.loss.start_s)
        self._edges_ns = sorted({start_ns + round(edge * NS) for edge in starts}, reverse=True)
        self._scene = self._scene_now()
        self._next_scene_ns = self._next_change_of_scene()

    def command(self, mw: float, sent_ns: int) -> None:
        """A command that left at ``sent_ns`` and takes effect ``command_delay_ns`` later, or now if that is past.

        One that is not finite is 0 MW.
        """
        finite_mw = mw if math.isfinite(mw) else 0.0
        insort(self._under_way, (sent_ns + self.command_delay_ns, finite_mw), key=_effect_ns)
        if len(self._under_way) > MAX_COMMANDS:
            self.command_mw = self._under_way.pop(0)[1]

    @property
    def drive(self) -> Drive:
        """The power on the plant from ``time_ns`` on."""
        probe_mw, brake_mw = self._scene
        return Drive(self.command_mw + probe_mw, brake_mw)

    @property
    def probe_mw(self) -> float:
        """The part of the modulation that is a test signal."""
        return self._scene.modulation_mw

    def advance(self, to_ns: int) -> None:
        """Move on to ``to_ns``; a time that is past changes nothing."""
        self._take_effect()
        while self.time_ns < to_ns:
            until_ns = min(to_ns, self._next_scene_ns, self._under_way[0][0] if self._under_way else _NEVER)
            self.plant.advance((until_ns - self.time_ns) * 1e-9, self.drive)
            self.time_ns = until_ns
            self._take_effect()

    def buses(self) -> dict[str, Bus]:
        """What there is to measure at ``time_ns``."""
        buses = self.plant.buses(self.drive)
        if (loss := self.scenario.loss) is None:
            return buses
        time_s = (self.time_ns - self.start_ns) / NS
        return {name: Bus(*bus[:4], *loss.common(time_s, name)) for name, bus in buses.items()}

    def _take_effect(self) -> None:
        while self._under_way and self._under_way[0][0] <= self.time_ns:
            self.command_mw = self._under_way.pop(0)[1]
        if self._next_scene_ns <= self.time_ns:
            self._scene = self._scene_now()
            self._next_scene_ns = self._next_change_of_scene()

    def _scene_now(self) -> Drive:
        """What the scenario itself puts on the plant from ``time_ns`` on."""
        scenario, since_ns = self.scenario, self.time_ns - self.start_ns
        power = {"brake": 0.0, "probe": 0.0}
        for pulse in scenario.pulses:
            if round(pulse.start_s * NS) <= since_ns < round(pulse.stop_s * NS):
                power[pulse.input] += pulse.mw
        if (loss := scenario.loss) is not None and since_ns >= round(loss.start_s * NS):
            power["brake"] -= loss.swing_share * loss.mw
        if self._signals:
            number = since_ns * SIGNAL_HZ // NS
            if scenario.ambient_mw:
                power["brake"] += scenario.ambient_mw * normal(self.seed, "grid", "ambient", number)
            if scenario.multisine is not None:
                power["probe"] += scenario.multisine.mw(number / SIGNAL_HZ)
        return Drive(power["probe"], power["brake"])

    def _next_change_of_scene(self) -> int:
        """The first instant after ``time_ns`` at which the scenario changes the drive."""
        while self._edges_ns and self._edges_ns[-1] <= self.time_ns:
            self._edges_ns.pop()
        edge_ns = self._edges_ns[-1] if self._edges_ns else _NEVER
        if not self._signals:
            return edge_ns
        number = (self.time_ns - self.start_ns) * SIGNAL_HZ // NS + 1
        return min(edge_ns, self.start_ns - (-number * NS // SIGNAL_HZ))
