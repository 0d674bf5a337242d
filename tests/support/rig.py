"""A controller on emulated PMUs whose every value is given as a function of the frame's number: for single checks."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from support.swing import MS, START_NS, some

from dcon.core.rows import CORE
from dcon.core.state import initial_state
from dcon.core.values import NOTHING, Flag, Mode, Order, Record, Surroundings
from dcon.engine import Engine
from dcon.settings import parse
from dcon.sim.plan import ini_of
from pmutools.c37118 import Frame
from pmutools.c37118.checksum import sealed
from pmutools.flow import StampSource
from pmutools.grid.emulate import EmulatedStream
from pmutools.grid.pmu_model import Measurement

BASE_V = 500e3 / math.sqrt(3)
TICK_AGE_NS = 71 * MS
_A = cmath.rect(1, 2 * math.pi / 3)

Number = Callable[[int], float]
"""By the frame's number."""


def constant(value: float) -> Number:
    return lambda _: value


ZERO, ONE, SIXTY = constant(0.0), constant(1.0), constant(60.0)


@dataclass(frozen=True)
class Signal:
    """What one PMU sends."""

    hz: Number = ZERO
    """Deviation from nominal; the angle turns with it."""
    freq_hz: Number | None = None
    """Deviation that FREQ says; that of the angle unless given."""
    deg: Number = ZERO
    """Added to the angle."""
    pu: Number = ONE
    v2_percent: Number = ZERO
    stat: Number = ZERO
    time_quality: Number = ZERO
    delay_ms: Number = SIXTY
    shift_us: Number = ZERO
    lost: Callable[[int], bool] = lambda _: False


STEADY = Signal()


class Rig:
    """An engine, its PMUs, and what came of every tick."""

    def __init__(
        self,
        signals: Mapping[str, Signal],
        *,
        extra: str = "",
        pdci: str = "required = no",
        gain: float = 9.0,
        init_s: float = 0.1,
    ) -> None:
        self.pmus = some(signals)
        self.signals = signals
        self.streams = {pmu.name: EmulatedStream([pmu], 60) for pmu in self.pmus}
        law = {"gain_mw_per_mhz": gain, "deadband_mhz": 0.0, "init_s": init_s}
        self.settings = parse(ini_of(self.pmus, **law, pdci=pdci, extra=f"\n{extra}"), "rig.ini")
        self.engine = Engine(self.settings.params, self.settings.sites)
        self.engine.state = initial_state(self.settings.params, mode=Mode.CLOSED_LOOP, verified=True)
        for name, stream in self.streams.items():
            self.engine.configure(name, stream.config)
        self.turned = dict.fromkeys(signals, 0.0)
        self.slot = 0
        self.waiting: list[tuple[int, str, Frame]] = []
        self.records: list[Record] = []

    def frame(self, name: str, slot: int) -> Frame:
        signal = self.signals[name]
        hz = signal.hz(slot)
        self.turned[name] += math.pi * (hz + signal.hz(slot - 1)) / 60 if slot else 0.0
        angle = self.turned[name] + math.radians(signal.deg(slot))
        stamp = START_NS + 1000 * round(slot * 1e6 / 60 + signal.shift_us(slot))
        v1 = cmath.rect(BASE_V * signal.pu(slot), angle)
        v2 = v1 * signal.v2_percent(slot) / 100
        phases = (v1 + v2, v1 / _A + v2 * _A, v1 * _A + v2 / _A)
        said_hz = hz if signal.freq_hz is None else signal.freq_hz(slot)
        data = self.streams[name].data_frame([Measurement(stamp, *phases, v1, 0j, 60 + said_hz, 0.0)])
        stat, quality = int(signal.stat(slot)), int(signal.time_quality(slot))
        data = sealed(data[:10] + bytes([quality]) + data[11:14] + stat.to_bytes(2, "big") + data[16:-2])
        return Frame(data, stamp + round(signal.delay_ms(slot) * MS), StampSource.CAPTURE, 0)

    def tick(self, *orders: Order, told: Surroundings = NOTHING, late_ns: int = 0) -> Record:
        """One tick 71 ms (and ``late_ns``) after the stamp of the next frame."""
        for name, signal in self.signals.items():
            frame = self.frame(name, self.slot)
            if not signal.lost(self.slot):
                self.waiting.append((frame.arrival_ns or 0, name, frame))
        now_ns = START_NS + 1000 * round(self.slot * 1e6 / 60) + TICK_AGE_NS + late_ns
        self.slot += 1
        self.waiting.sort(key=lambda item: item[0])
        frames: dict[str, list[Frame]] = {}
        while self.waiting and self.waiting[0][0] <= now_ns:
            _, name, frame = self.waiting.pop(0)
            frames.setdefault(name, []).append(frame)
        self.records.append(self.engine.tick(frames, orders, now_ns, told).record)
        return self.records[-1]

    def run(self, ticks: int, told: Surroundings = NOTHING) -> Rig:
        for _ in range(ticks):
            self.tick(told=told)
        return self

    def arm(self, settle: int = 12) -> Rig:
        """To ACTIVE; fails where that is refused."""
        self.run(settle)
        self.tick(Order("arm"))
        assert self.tick(Order("activate")).state == "ACTIVE", self.records[-1].events
        return self

    @property
    def up(self) -> set[str]:
        """Checks that are up after the last tick."""
        return set(CORE.named(self.records[-1].flags))

    def seen(self, since: int = 10) -> set[str]:
        """Checks that were up after any tick since one."""
        return {name for record in self.records[since:] for name in CORE.named(record.flags)}

    def flag(self, name: str, subject: str = "system") -> Flag:
        return self.engine.state.flags[name, subject]


def steady(names: Iterable[str] = ("N1", "N2", "S1", "S2"), **changed: Signal) -> dict[str, Signal]:
    """Signals at rest, but for those given by name."""
    return {name: changed.get(name, STEADY) for name in names}
