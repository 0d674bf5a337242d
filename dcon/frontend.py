"""From a PMU's frames to what the controller sees: which channels make V1, and whether the stream fits at all."""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from dcon.core.sequence import sequences
from dcon.core.values import Sample
from pmutools.c37118 import Frame, StreamConfig
from pmutools.c37118.frames import Data, unpack_data
from pmutools.c37118.layout import Layout, layout_of
from pmutools.errors import SettingsError
from pmutools.schema.frame_encoder import FrameEncoder
from pmutools.schema.pmu_log import PmuFrame, pmu_frame

SHOWN = 8
"""Names of stations or channels in an error."""
_ABSENT = complex(math.nan, math.nan)
_new = tuple.__new__  # what calling a NamedTuple comes to, for half the time


@dataclass(frozen=True, slots=True)
class Binding:
    """Where one PMU of the controller is in its stream's frames. Made by :func:`bind`."""

    name: str
    config: StreamConfig
    layout: Layout
    station: int
    voltage: tuple[int, ...]
    """Columns of V1, or of VA, VB and VC."""
    places: tuple[int, ...]
    """Of their magnitudes among a frame's values, where all are polar floats as they stand; else empty."""
    encoder: FrameEncoder = field(compare=False)

    def read(self, frame: Frame) -> Reading | None:
        """A data frame as the controller sees it; None where it is not of this configuration."""
        layout, station = self.layout, self.station
        wire, arrival_ns, _, _ = frame
        if len(wire) != layout.frame_size:
            return None
        data = unpack_data(wire, self.config, layout)
        time_ns = data.time_ns
        v1, v2 = self._voltages(data)
        sample = _new(
            Sample,
            (
                time_ns,
                time_ns if arrival_ns is None else arrival_ns,
                v1,
                data.frequency(station),
                data.stat(station),
                data.time_quality,
                layout.time_base,
                v2,
            ),
        )
        return _new(Reading, (self, frame, data, sample))

    def _voltages(self, data: Data) -> tuple[complex, complex]:
        """Positive- and negative-sequence voltage, V RMS; the latter NaN where the phases are not given."""
        if len(self.places) == 3 and (phases := _three_polar(data.values, *self.places)) is not None:
            return sequences(*phases)
        phasors = list(map(data.phasor, self.voltage))
        return sequences(*phasors) if len(phasors) == 3 else (phasors[0], _ABSENT)

    def reads_like(self, other: Binding) -> bool:
        """Whether both make the same sample of every frame."""
        return (self.station, self.voltage, *_meaning(self.layout)) == (
            other.station,
            other.voltage,
            *_meaning(other.layout),
        )


class Reading(NamedTuple):
    """A data frame that was read. What the log wants of it is worked out when it is asked for: control comes first."""

    binding: Binding
    frame: Frame
    data: Data
    sample: Sample

    @property
    def name(self) -> str:
        return self.binding.name

    @property
    def time_ns(self) -> int:
        return self.sample.time_ns

    @property
    def arrival_ns(self) -> int | None:
        return self.frame.arrival_ns

    def encode(self, tick_ns: int = 0) -> bytes:
        """The frame's message in a log (:class:`~pmutools.schema.pmu_log.Loggable`)."""
        return self.binding.encoder.encode(self.frame, self.data, self.sample.v1, tick_ns)

    def entry(self) -> PmuFrame:
        """The frame as a log entry."""
        name, station = self.binding.name, self.binding.station
        return pmu_frame(name, self.frame, self.data, station=station, v1=self.sample.v1)


def _three_polar(values: Sequence[float], a: int, b: int, c: int) -> tuple[complex, complex, complex] | None:
    """Phasors that are polar floats, as ``data.phasor`` gives them; None where one is 0 or not finite: that decides."""
    rect = cmath.rect
    try:
        va, vb, vc = rect(values[a], values[a + 1]), rect(values[b], values[b + 1]), rect(values[c], values[c + 1])
    except ValueError:  # an infinite angle
        return None
    return (va, vb, vc) if va and vb and vc and cmath.isfinite(va + vb + vc) else None


def _meaning(layout: Layout) -> tuple[object, ...]:
    return layout.stations, layout.slots, layout.phasors, layout.time_base


def bind(
    name: str,
    config: StreamConfig,
    *,
    rate_hz: int,
    voltage: tuple[str, ...],
    station: str | None = None,
    nominal_hz: float = 60.0,
) -> Binding:
    """Find PMU ``name`` in a stream.

    Parameters
    ----------
    rate_hz
        Reporting rate that the controller runs at.
    voltage
        Name of the positive-sequence channel, or three: of phases A, B and C.
    station
        Name of the station in a stream that has several.

    Raises
    ------
    SettingsError
        The stream's rate or nominal frequency is another, or a station or channel is not in it; says what there is.
    """
    if config.rate != rate_hz:
        raise SettingsError(
            f"PMU {name}: its stream {config.idcode} sends {float(config.rate):g} frames/s, the controller runs at "
            f"{rate_hz}; set rate = {float(config.rate):g} for all PMUs, or the PMU to {rate_hz} frames/s"
        )
    index = _station(name, config, station)
    chosen = config.stations[index]
    if chosen.fnom_hz != nominal_hz:
        raise SettingsError(
            f"PMU {name}: station {chosen.name} measures a {chosen.fnom_hz:g} Hz grid, not {nominal_hz:g} Hz; "
            f"set nominal_hz = {chosen.fnom_hz:g} in [controller], or take another PMU"
        )
    first = layout_of(config).slots[index].phasor_columns.start
    channels = [channel.name for channel in chosen.phasors]
    columns = []
    for wanted in voltage:
        if wanted not in channels:
            there = _some([c.name for c in chosen.phasors if c.kind == "V"]) or "no voltage phasors"
            raise SettingsError(f"PMU {name}: station {chosen.name} has no channel {wanted!r}; it has {there}")
        if chosen.phasors[channels.index(wanted)].kind != "V":
            raise SettingsError(f"PMU {name}: channel {wanted!r} of station {chosen.name} is a current")
        columns.append(first + channels.index(wanted))
    layout = layout_of(config)
    encoder = FrameEncoder(name, layout, index)
    return Binding(name, config, layout, index, tuple(columns), _places(layout, columns), encoder)


def _places(layout: Layout, columns: Iterable[int]) -> tuple[int, ...]:
    """Where the phasors' magnitudes are, if all are polar floats that mean what they say."""
    slots = [layout.phasors[column] for column in columns]
    if all(slot.polar and slot.floating and slot.factor == 1 and not slot.angle_offset_rad for slot in slots):
        return tuple(slot.first for slot in slots)
    return ()


def _station(name: str, config: StreamConfig, station: str | None) -> int:
    names = [each.name for each in config.stations]
    if station is None:
        if len(names) == 1:
            return 0
        raise SettingsError(
            f"PMU {name}: its stream {config.idcode} carries {len(names)} stations; pick one with "
            f"station = {_some(names, ' | ')}"
        )
    if station not in names:
        raise SettingsError(f"PMU {name}: stream {config.idcode} has no station {station!r}; it has {_some(names)}")
    return names.index(station)


def _some(names: Sequence[str], between: str = ", ") -> str:
    """The first of them, and how many there are more: a stream may have thousands."""
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return between.join(names[:SHOWN]) + more
