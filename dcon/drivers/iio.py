"""±10 V through a DAC of Linux's Industrial I/O subsystem, read back through an ADC.

The kernel's rule for a channel is mV = (raw + offset) * scale. ``out_voltageN_scale`` and ``_offset`` may be given once
for all channels (``out_voltage_scale``); an offset that is not there is 0. Counts are written to ``out_voltageN_raw``.

A write may wait for the SPI or I2C bus, so this belongs into a process of its own (``dcon output``).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from dcon.drivers.driver import Readback, bounded_v
from dcon.places import FULL_SCALE_V, IioPlace
from pmutools.errors import SettingsError, SourceError

SHORT_V = 0.05
"""A DAC of ±10 V may end so far below: its last count, and what its scale is rounded by."""
FARTHEST_V = 25.0
"""A DAC that would go beyond has a wrong scale: no converter for a ±10 V input does."""
MAX_BYTES = 4096
"""Of a file in sysfs: a page."""


class Channel(NamedTuple):
    """How counts of a channel are volts."""

    scale_mv: float
    """mV a count."""
    offset: float
    """Added to counts."""

    def volts(self, counts: int) -> float:
        return (counts + self.offset) * self.scale_mv / 1e3

    def counts(self, volts: float) -> int:
        return round(volts * 1e3 / self.scale_mv - self.offset)


class IioDriver:
    """One output channel, and the input channel that watches it."""

    def __init__(self, place: IioPlace) -> None:
        """Raises SourceError where the device is not there or cannot put out ±10 V, SettingsError where a key lacks."""
        keys, folder = place.keys, Path(place.folder)
        self._raw = folder / f"out_voltage{keys.channel}_raw"
        self._dac = channel(folder, "out", keys.channel)
        self._low, self._high = counts_range(folder, keys.channel, keys.bits, place)
        reach = sorted(self._dac.volts(counts) for counts in (self._low, self._high))
        if reach[0] > SHORT_V - FULL_SCALE_V or reach[1] < FULL_SCALE_V - SHORT_V:
            problem = "±10 V are needed; choose another range of the DAC, or another DAC"
        elif reach[0] < -FARTHEST_V or reach[1] > FARTHEST_V:
            problem = "no such converter is known: its scale must be in mV a count"
        else:
            problem = ""
        if problem:
            raise SourceError(f"{self._raw}: by its scale it reaches {reach[0]:g} to {reach[1]:g} V; {problem}")
        if _text(folder / f"out_voltage{keys.channel}_powerdown", "0") != "0":
            raise SourceError(f"{self._raw}: powered down; write 0 to out_voltage{keys.channel}_powerdown first")
        self._adc: tuple[Path, Channel] | None = None
        if keys.readback is not None:
            other = Path(keys.adc or folder)
            self._adc = other / f"in_voltage{keys.readback}_raw", channel(other, "in", keys.readback)
            _number(self._adc[0])
        self.driven = self.failed = 0
        self.reads_back = self._adc is not None
        self.settle_ns = round(keys.settle_ms * 1e6)
        self._unwritten = self._unread = ""

    @property
    def trouble(self) -> str:
        return self._unwritten or self._unread

    def drive(self, time_ns: int, output_v: float, flags: int = 0, /) -> None:
        counts = max(self._low, min(self._high, self._dac.counts(bounded_v(output_v))))
        self.driven += 1
        try:
            fd = os.open(self._raw, os.O_WRONLY | os.O_TRUNC | os.O_CLOEXEC)  # anew: the device may have gone and come
            try:
                os.write(fd, b"%d\n" % counts)
            finally:
                os.close(fd)
            self._unwritten = ""
        except OSError as error:
            self.failed += 1
            self._unwritten = f"{self._raw}: {error.strerror}"

    def readback(self) -> Readback | None:
        if self._adc is None or not self.driven:
            return None
        path, adc = self._adc
        try:
            output_v = adc.volts(int(_number(path)))
        except SourceError as error:
            self.failed += 1
            self._unread = str(error)
            return None
        self._unread = ""
        return Readback(self.driven, output_v)

    def close(self) -> None:
        self.drive(0, 0.0)


def channel(folder: Path, direction: str, number: int) -> Channel:
    """Scale and offset of channel ``number``, ``direction`` is ``in`` or ``out``. Raises SourceError."""
    if not folder.is_dir():
        raise SourceError(f"{folder}: no such device; see ls -d /sys/bus/iio/devices/iio:device*")
    if not (raw := folder / f"{direction}_voltage{number}_raw").exists():
        there = ", ".join(sorted(path.name for path in folder.glob(f"{direction}_voltage*_raw"))) or "none"
        raise SourceError(f"{raw}: no such channel; there are {there}")
    scale = next(_shared(folder, direction, number, "scale"), None)
    if scale is None:
        raise SourceError(f"{raw}: the device tells no scale (no {direction}_voltage{number}_scale)")
    scale_mv = _number(scale)
    if not 0 < scale_mv < float("inf"):
        raise SourceError(f"{scale}: {scale_mv:g} mV a count is no scale")
    offset = next(_shared(folder, direction, number, "offset"), None)
    return Channel(scale_mv, 0.0 if offset is None else _number(offset))


def counts_range(folder: Path, number: int, bits: int | None, place: object = "") -> tuple[int, int]:
    """Least and largest count: of ``raw_available`` (``[least step largest]``, or all of them), else by ``bits``."""
    available = next(_shared(folder, "out", number, "raw_available"), None)
    if available is None:
        if bits is None:
            raise SettingsError(f"{place}: the DAC does not tell its range of counts; add bits= (16 of most)")
        return 0, (1 << bits) - 1
    text = _text(available)
    try:
        counts = [int(word) for word in text.strip("[]").split()]
        if text.startswith("["):
            counts = [counts[0], counts[2]]
        return min(counts), max(counts)
    except (ValueError, IndexError):
        raise SourceError(f"{available}: {text!r} is no range of counts") from None


def _shared(folder: Path, direction: str, number: int, what: str) -> Iterator[Path]:
    """The channel's own file, or that of all channels."""
    for name in (f"{direction}_voltage{number}_{what}", f"{direction}_voltage_{what}"):
        if (folder / name).exists():
            yield folder / name


def _text(path: Path, otherwise: str | None = None) -> str:
    try:
        with path.open("rb") as file:
            return file.read(MAX_BYTES).decode("ascii", "replace").strip()
    except OSError as error:
        if otherwise is not None:
            return otherwise
        raise SourceError(f"{path}: {error.strerror}") from None


def _number(path: Path) -> float:
    text = _text(path)
    try:
        value = float(text)
        if value - value == 0:  # finite
            return value
    except ValueError:
        pass
    raise SourceError(f"{path}: {text[:40]!r} is no number")
