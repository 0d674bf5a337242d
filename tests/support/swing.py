"""Emulated PMUs without a plant: north against south in a steady 0.4 Hz swing, as frames and as settings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

from dcon.settings import Settings, parse
from dcon.sim.plan import ini_of
from pmutools.c37118 import Frame, StreamConfig, decode_data, decode_prefix, encode_data
from pmutools.c37118.frames import wire_values
from pmutools.flow import StampSource
from pmutools.grid.emulate import EmulatedStream
from pmutools.grid.pmu_model import PmuModel, fleet, measure
from pmutools.grid.signals import Bus
from pmutools.timebase import NS

START_NS = 1_704_067_200 * NS
MS = 1_000_000
SWING_HZ = 0.4
SWING_MHZ = 3.0


def some(names: Iterable[str]) -> tuple[PmuModel, ...]:
    """PMUs of the fleet, by name."""
    known = {pmu.name: pmu for pmu in fleet()}
    return tuple(known[name] for name in names)


def buses(time_ns: int) -> dict[str, Bus]:
    """f_north - f_south is SWING_MHZ · sin(2π SWING_HZ t), t from START_NS."""
    w = 2 * math.pi * SWING_HZ
    t = (time_ns - START_NS) / NS
    half_hz = SWING_MHZ / 2e3
    north = Bus(-2 * math.pi * half_hz / w * math.cos(w * t), half_hz * math.sin(w * t), half_hz * w * math.cos(w * t))
    return {"north": north, "south": Bus(-north.angle_rad, -north.deviation_hz, -north.rocof_hz_s)}


def peak_after(time_ns: int) -> int:
    """The next time at which the difference is largest, of either sign."""
    half_ns = round(NS / SWING_HZ / 2)
    return time_ns + (half_ns // 2 - (time_ns - START_NS)) % half_ns


class Streams:
    """The frames of some PMUs, each a stream of its own."""

    def __init__(self, names: Sequence[str] = ("N1", "S1"), rate: int = 60) -> None:
        self.pmus = some(names)
        self.rate = rate
        self.streams = {pmu.name: EmulatedStream([pmu], rate) for pmu in self.pmus}
        self.configs = {name: stream.config for name, stream in self.streams.items()}
        """In force."""

    def stamp_ns(self, slot: int, start_ns: int = START_NS) -> int:
        return start_ns + (slot * NS + self.rate // 2) // self.rate

    def slim(self, name: str) -> StreamConfig:
        """From now on ``name`` sends its voltages only, under the configuration returned."""
        config = self.configs[name]
        station = config.stations[0]
        voltages = tuple(channel for channel in station.phasors if channel.kind == "V")
        changed = replace(station, phasors=voltages, cfgcnt=station.cfgcnt + 1)
        self.configs[name] = replace(config, stations=(changed,))
        return self.configs[name]

    def data(self, name: str, stamp_ns: int) -> bytes:
        stream, config = self.streams[name], self.configs[name]
        report = measure(stream.pmus[0], buses(stamp_ns), stamp_ns, 0, nominal_hz=stream.nominal_hz)
        frame = stream.data_frame([report])
        if config is stream.config:
            return frame
        prefix, values = decode_prefix(frame), decode_data(frame, stream.config).values
        voltages = values[6 : 6 + 2 * len(config.stations[0].phasors)]
        return encode_data(wire_values(config, prefix, [[values[5], *voltages, *values[-3:-1]]]))

    def frame(self, name: str, slot: int, delay_ms: float = 60.0) -> Frame:
        stamp_ns = self.stamp_ns(slot)
        return Frame(self.data(name, stamp_ns), stamp_ns + round(delay_ms * MS), StampSource.CAPTURE, 0)

    def frames(self, slot: int) -> dict[str, list[Frame]]:
        """What a tick 71 ms after the stamp of ``slot`` is given."""
        return {name: [self.frame(name, slot)] for name in self.streams}

    def ini(self, *, urls: Sequence[str] | None = None, init_s: float = 0.5, extra: str = "", **law: Any) -> str:
        """``law``: other keywords of :func:`~dcon.sim.plan.ini_of`."""
        law = {"gain_mw_per_mhz": 9.0, "deadband_mhz": 0.0, "rate_hz": 60} | law
        return ini_of(self.pmus, urls=urls, init_s=init_s, extra=extra, **law)

    def settings(self, **given: object) -> Settings:
        return parse(self.ini(**given), "test.ini")  # type: ignore[arg-type]
