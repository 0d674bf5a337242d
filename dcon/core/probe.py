"""Probing signals: square pulse, multisine, chirp, or a file. A pure function of the ticks since the start.

A signal is worked out before it is needed, as one value a tick. It is added to the command after the control law,
never judged as feedback, and logged apart. It moves no faster than ``slew_mw_per_s``, which leaves the feedback
its share of the slew backstop; so whatever its shape it begins and ends without a step.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from dcon.core.clash import Clash, check_order
from dcon.core.law import approach
from dcon.core.thresholds import check_bounds, setting
from dcon.limiter import LIMIT_MW, SLEW_MW_PER_S
from pmutools.errors import SettingsError

LONGEST_S: Final = 3600.0
"""Of a signal, which bounds its memory."""
KINDS: Final = ("none", "square", "multisine", "chirp", "file")
SWEPT: Final = ("multisine", "chirp")
"""Signals with a highest frequency."""
DRAWS: Final = 16
"""Sets of random phases that the multisine of the lowest crest is chosen from ..."""
MOST_SINES: Final = 2_000_000
"""... or fewer, so that working it out takes a second at most."""


@dataclass(frozen=True)
class Probing:
    """``[probing]``: the signal that the order ``probe_start`` starts."""

    kind: str = field(default="none", metadata={"choices": KINDS})
    """``square`` (cycles of ±amplitude), ``multisine``, ``chirp``, ``file``, or ``none``."""
    amplitude_mw: float = setting(20.0, "MW", "choice: ±20 to ±125 are used", 0, LIMIT_MW)
    """Largest value (not of a file, which has its own)."""
    frequency_hz: float = setting(0.4, "Hz", "Fig. 21", 0.01, 10)
    """Of the square pulse."""
    cycles: int = setting(3, "cycles", "Fig. 21", 1, 1000)
    """Of the square pulse."""
    low_hz: float = setting(0.1, "Hz", "choice", 0.01, 10)
    """Lowest frequency of multisine and chirp."""
    high_hz: float = setting(5.0, "Hz", "choice", 0.02, 20)
    """Highest frequency of multisine and chirp."""
    tones: int = setting(24, "tones", "choice", 1, 200)
    """Of the multisine, spaced logarithmically, on multiples of 1/``period_s``."""
    period_s: float = setting(40.0, "s", "choice", 1, 200)
    """Of the multisine, which repeats."""
    duration_s: float = setting(1200.0, "s", "choice: 20 min", 0.1, LONGEST_S)
    """Of multisine and chirp."""
    ramp_s: float = setting(1.0, "s", "choice", 0, 60)
    """From nothing to all of the signal, and back."""
    slew_mw_per_s: float = setting(500.0, "MW/s", "choice: half of the slew backstop", 1, SLEW_MW_PER_S)
    """How fast the signal may move, whatever its shape."""
    seed: int = setting(1, "", "choice", 0, 2**31)
    """Of the multisine's phases."""
    file: str = ""
    """CSV with one row a tick; the signal in MW is its column ``column``."""
    column: str = "probe_mw"
    """See ``file``."""
    open_loop: bool = False
    """Drive the signal in open loop too: the output is then the signal alone. Otherwise open loop is 0 V throughout."""
    samples: tuple[float, ...] = ()
    """What the file holds, MW."""

    def __post_init__(self) -> None:
        check_bounds(self)
        if self.kind not in KINDS:
            raise SettingsError(f"kind = {self.kind!r}: must be one of {', '.join(KINDS)}")
        check_order(self, (("low_hz", "high_hz"),))
        if self.kind == "square" and (length_s := self.cycles / self.frequency_hz) > LONGEST_S:
            problem = f"{self.cycles}: at frequency_hz = {self.frequency_hz:g} that is {length_s:g} s"
            raise Clash(f"{problem}; {LONGEST_S:g} s at most", "cycles", "frequency_hz")
        if self.kind == "multisine" and self.low_hz * self.period_s < 1:
            raise Clash(f"{self.low_hz:g}: no whole cycle in period_s = {self.period_s:g}", "low_hz", "period_s")
        if self.kind == "multisine" and self.period_s > self.duration_s:
            problem = f"{self.period_s:g}: above duration_s = {self.duration_s:g}, so that no tone comes whole"
            raise Clash(problem, "period_s", "duration_s")
        if self.kind in SWEPT and 2 * self.ramp_s > self.duration_s:
            raise Clash(f"{self.ramp_s:g}: more than half of duration_s = {self.duration_s:g}", "ramp_s", "duration_s")
        if self.kind == "file" and not self.samples:
            raise Clash("file: no samples; give file = NAME.csv", "kind")
        if not all(abs(mw) <= LIMIT_MW for mw in self.samples):
            raise SettingsError(f"{self.file}: every value must be within ±{LIMIT_MW:g} MW")


class Waveform(NamedTuple):
    """``samples`` (MW, one a tick) over and over, for ``ticks`` ticks."""

    samples: tuple[float, ...] = ()
    ticks: int = 0
    ramped: bool = False
    """Begins and ends by a ramp; the others begin and end as they are."""

    def at(self, tick: int) -> float:
        """MW, ``tick`` ticks after the start; 0 after the end."""
        return self.samples[tick % len(self.samples)] if 0 <= tick < self.ticks else 0.0


def waveform(probing: Probing, tick_hz: int) -> Waveform:
    """The signal of the settings at ``tick_hz``."""
    ticks = round(probing.duration_s * tick_hz)
    match probing.kind:
        case "square":
            return _whole(_square(probing, tick_hz))
        case "chirp":
            return Waveform(_chirp(probing, tick_hz), ticks, ramped=True)
        case "multisine":
            return Waveform(_multisine(probing, tick_hz), ticks, ramped=True)
        case "file":
            return _whole(probing.samples)
    return Waveform()


def _whole(samples: tuple[float, ...]) -> Waveform:
    return Waveform(samples, len(samples))


def _square(probing: Probing, tick_hz: int) -> tuple[float, ...]:
    ticks = round(probing.cycles / probing.frequency_hz * tick_hz)
    up, turn = probing.amplitude_mw, probing.frequency_hz / tick_hz
    return tuple(up if k * turn % 1 < 0.5 else -up for k in range(ticks))


def _chirp(probing: Probing, tick_hz: int) -> tuple[float, ...]:
    """From ``low_hz`` to ``high_hz`` in ``duration_s``, an equal number of octaves in every second."""
    rate = math.log(probing.high_hz / probing.low_hz) / probing.duration_s
    turns = 2 * math.pi * probing.low_hz / rate
    ticks = round(probing.duration_s * tick_hz)
    return tuple(probing.amplitude_mw * math.sin(turns * math.expm1(rate * k / tick_hz)) for k in range(ticks))


def tones_hz(probing: Probing) -> tuple[float, ...]:
    """Frequencies of the multisine, lowest first: as near to logarithmic spacing as multiples of 1/period allow."""
    ratio, last = probing.high_hz / probing.low_hz, max(probing.tones - 1, 1)
    wanted = [probing.low_hz * ratio ** (k / last) for k in range(probing.tones)]
    return tuple(n / probing.period_s for n in sorted({max(1, round(hz * probing.period_s)) for hz in wanted}))


def _multisine(probing: Probing, tick_hz: int) -> tuple[float, ...]:
    """One period of equal tones at random phases: of some draws the one of the lowest crest."""
    ticks = round(probing.period_s * tick_hz)
    steps = [2 * math.pi * hz / tick_hz for hz in tones_hz(probing)]
    draw = random.Random(probing.seed)
    best: list[float] = []
    for _ in range(max(1, min(DRAWS, MOST_SINES // (ticks * len(steps))))):
        tones = [(step, draw.random() * 2 * math.pi) for step in steps]
        values = [math.fsum(math.sin(step * k + phase) for step, phase in tones) for k in range(ticks)]
        if not best or max(map(abs, values)) < max(map(abs, best)):
            best = values
    scale = probing.amplitude_mw / max(map(abs, best))
    return tuple(scale * value for value in best)


class Probe(NamedTuple):
    """A signal under way: ticks since its start, how much of it is let through (0 to 1), and MW now."""

    tick: int = -1
    level: float = 0.0
    mw: float = 0.0
    stopping: bool = False

    @property
    def is_on(self) -> bool:
        """Whether there is a signal."""
        return self.tick >= 0


IDLE: Final = Probe()


def started(signal: Waveform) -> Probe:
    """``signal`` at its start: :func:`advance` gives its first value."""
    return Probe(0, 0.0 if signal.ramped else 1.0)


def advance(probe: Probe, signal: Waveform, ramp_s: float, slew_mw_per_s: float, tick_hz: int) -> Probe:
    """``probe`` one tick on; IDLE once the signal is over, or stopped, and has come down to 0."""
    if not probe.is_on:
        return probe
    ramp_ticks = ramp_s * tick_hz
    stopping = probe.stopping or (signal.ramped and probe.tick + ramp_ticks >= signal.ticks)
    step = 1.0 / max(1.0, ramp_ticks)
    level = approach(probe.level, 0.0 if stopping else 1.0, step)
    mw = approach(probe.mw, level * signal.at(probe.tick), slew_mw_per_s / tick_hz)
    if mw == 0.0 and (probe.tick >= signal.ticks or (stopping and level == 0.0)):
        return IDLE
    return Probe(probe.tick + 1, level, mw, probe.stopping)
