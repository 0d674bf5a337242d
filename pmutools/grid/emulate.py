"""Emulated PMUs on the wire: measurements of a grid as C37.118 configuration and data frames."""

from __future__ import annotations

import struct
from cmath import polar
from collections.abc import Sequence
from functools import cached_property

from pmutools import timebase
from pmutools.c37118.checksum import sealed
from pmutools.c37118.config import PhasorChannel, Station, StreamConfig, encode_config
from pmutools.c37118.constants import CHK_SIZE, Format, FrameType
from pmutools.c37118.layout import layout_of
from pmutools.grid.pmu_model import PHASORS, Measurement, PmuModel

FORMAT = Format.FREQ_FLOAT | Format.PHASOR_FLOAT | Format.POLAR
_CURRENT = 1 << 24


def station_of(pmu: PmuModel, *, nominal_hz: float = 60.0) -> Station:
    """The PMU block of an emulated PMU: VA VB VC V1 I1 as float polar, frequency as float."""
    channels = tuple(PhasorChannel(name, _CURRENT if unit == "A" else 0) for name, unit in PHASORS)
    return Station(pmu.name, pmu.idcode, FORMAT, channels, fnom=int(nominal_hz == 50.0))


class EmulatedStream:
    """One stream: a PMU, or several PMUs in the frames of one concentrator."""

    def __init__(
        self, pmus: Sequence[PmuModel], rate: int, *, idcode: int | None = None, nominal_hz: float | None = None
    ) -> None:
        """``rate`` in frames/s; ``idcode`` of the stream, that of the first PMU unless given.

        ``nominal_hz`` of the grid, 50 or 60; unless given, that at which PMUs usually report at this rate.
        """
        self.pmus = tuple(pmus)
        self.nominal_hz = (50.0 if rate in (25, 50, 100) else 60.0) if nominal_hz is None else nominal_hz
        self.config = StreamConfig(
            self.pmus[0].idcode if idcode is None else idcode,
            tuple(station_of(pmu, nominal_hz=self.nominal_hz) for pmu in self.pmus),
            rate,
        )

    @cached_property
    def _packing(self) -> tuple[struct.Struct, tuple[int, ...]]:
        head = FrameType.DATA.sync, self.config.frame_size, self.config.idcode
        return layout_of(self.config).unpacker, head

    def config_frame(self, time_ns: int) -> bytes:
        """CFG-2, sent at ``time_ns``."""
        soc, fracsec = timebase.from_ns(time_ns, self.config.time_base)
        return encode_config(self.config, soc=soc, fracsec=fracsec)

    def data_frame(self, measurements: Sequence[Measurement]) -> bytes:
        """The frame of one reporting instant, one measurement a PMU."""
        values: list[float] = []
        for _, va, vb, vc, v1, i1, frequency_hz, rocof_hz_s in measurements:
            values += (0, *polar(va), *polar(vb), *polar(vc), *polar(v1), *polar(i1), frequency_hz, rocof_hz_s)
        soc, fracsec = timebase.from_ns(measurements[0].time_ns, self.config.time_base)
        packer, head = self._packing
        return sealed(packer.pack(*head, soc, fracsec, *values, 0)[:-CHK_SIZE])
