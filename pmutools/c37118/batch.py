"""Many frames of one stream and configuration at once: a zero-copy wire view, and its columns in SI units.

N equal frames are one read-only big-endian structured array (:func:`wire_view`); :func:`decode_batch` turns it into
native columns, :func:`encode_batch` turns columns into frames. Both go by :mod:`pmutools.c37118.layout`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from pmutools import timebase
from pmutools.c37118.checksum import chk_array, seal_array
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import INT16_FILLER, STAT_DATA_ERROR_MASK, FrameType
from pmutools.c37118.frames import RAD_PER_COUNT, Data
from pmutools.c37118.layout import Layout, PhasorSlot, Run, block_dtype, dtype_of, layout_of
from pmutools.errors import ChecksumError, ConfigError, LengthError
from pmutools.flow import StampSource

NO_TIME = np.iinfo(np.int64).min
"""``arrival_ns`` of a frame whose arrival nobody saw."""
STAMP_SOURCES = tuple(StampSource)
_BLOCK_BYTES = 1 << 19
"""Frames are converted in pieces of about this size, which stay in the processor's cache."""


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """N frames of one stream, as columns. S stations, P phasors, A analogs, D digital words over all stations.

    Absent numbers are NaN; ``valid`` says whether STAT calls the station's data good and any of it is present.
    """

    config: StreamConfig
    time_ns: npt.NDArray[np.int64]
    """(N,) time of measurement, POSIX UTC."""
    arrival_ns: npt.NDArray[np.int64]
    """(N,) time of arrival, POSIX UTC; :data:`NO_TIME` where unknown."""
    stamp_source: npt.NDArray[np.uint8]
    """(N,) index into :data:`STAMP_SOURCES`."""
    time_quality: npt.NDArray[np.uint8]
    """(N,) the whole time quality byte: leap flags and MSG_TQ."""
    stat: npt.NDArray[np.uint16]
    """(N, S) STAT."""
    phasors: npt.NDArray[np.complex128]
    """(N, P) V or A RMS."""
    frequency: npt.NDArray[np.float64]
    """(N, S) absolute, Hz."""
    rocof: npt.NDArray[np.float64]
    """(N, S) Hz/s."""
    analogs: npt.NDArray[np.float64]
    """(N, A) wire values with CFG-1/2, scaled by ANSCALE with CFG-3."""
    digitals: npt.NDArray[np.uint16]
    """(N, D)."""
    valid: npt.NDArray[np.bool_]
    """(N, S)."""
    wire: npt.NDArray[np.void] | None = None
    """(N,) the frames these columns came from, if they came from frames; read-only."""

    def __len__(self) -> int:
        return len(self.time_ns)

    def __getitem__(self, rows: slice) -> Batch:
        """The frames of a slice, as views."""
        kept = {f.name: getattr(self, f.name) for f in fields(self)}
        return Batch(**{name: v if name == "config" or v is None else v[rows] for name, v in kept.items()})

    def cut(self, rows: slice, config: StreamConfig, frames: bytes) -> Batch:
        """A copy of a slice as ``frames`` of ``config``, which is laid out alike (layout_of)."""
        assert self.wire is not None
        return Batch(
            config,
            self.time_ns[rows].copy(),
            self.arrival_ns[rows].copy(),
            self.stamp_source[rows].copy(),
            self.time_quality[rows].copy(),
            self.stat[rows].copy(),
            self.phasors[rows].copy(),
            self.frequency[rows].copy(),
            self.rocof[rows].copy(),
            self.analogs[rows].copy(),
            self.digitals[rows].copy(),
            self.valid[rows].copy(),
            np.frombuffer(frames, self.wire.dtype),
        )

    def data(self) -> Iterator[Data]:
        """Each frame as :class:`Data`, from its wire bytes, encoded first where there are none."""
        wire = self.wire if self.wire is not None else wire_view(encode_batch(self)[0].tobytes(), self.config)
        raw, size, layout = wire.tobytes(), self.config.frame_size, layout_of(self.config)
        for at in range(0, len(raw), size):
            yield Data(self.config, layout.unpacker.unpack_from(raw, at))


def joined(batches: Sequence[Batch]) -> Batch:
    """Batches of one configuration, one after the other. Wire bytes are kept where all have them."""
    if len(batches) == 1:
        return batches[0]
    columns = {
        f.name: np.concatenate([getattr(batch, f.name) for batch in batches])
        for f in fields(Batch)
        if f.name not in ("config", "wire")
    }
    config = batches[0].config
    wires = [batch.wire.tobytes() for batch in batches if batch.wire is not None]
    return Batch(config, wire=wire_view(b"".join(wires), config) if len(wires) == len(batches) else None, **columns)


def wire_view(frames: bytes, config: StreamConfig) -> npt.NDArray[np.void]:
    """Data frames laid end to end, as a read-only structured array (N,) that shares their memory.

    Raises LengthError where ``frames`` is no whole number of frames of this configuration.
    """
    size = config.frame_size
    if len(frames) % size:
        raise LengthError(f"data frames of {config.idcode}", size, len(frames) % size, idcode=config.idcode)
    view = np.frombuffer(frames, dtype_of(config))
    view.flags.writeable = False
    return view


def decode_batch(
    frames: bytes | npt.NDArray[np.void],
    config: StreamConfig,
    arrival_ns: npt.ArrayLike | None = None,
    stamp_source: npt.ArrayLike = 0,
    *,
    check: bool = True,
) -> Batch:
    """Columns of N data frames laid end to end (or of their :func:`wire_view`).

    ``arrival_ns`` is (N,) or None, ``stamp_source`` (N,) or one index into :data:`STAMP_SOURCES`. ``check=False``
    skips CHK and the prefix, for frames that a framer has passed.

    Raises
    ------
    LengthError, ChecksumError, ConfigError
        Not a whole number of frames; a CHK is wrong; a frame is not a data frame of this stream.
    """
    wire = frames if isinstance(frames, np.ndarray) else wire_view(frames, config)
    count, layout = len(wire), layout_of(config)
    batch = Batch(
        config,
        timebase.to_ns_array(wire["soc"], wire["fracsec"] & np.uint32(0xFFFFFF), config.time_base),
        np.full(count, NO_TIME) if arrival_ns is None else np.asarray(arrival_ns, np.int64),
        np.broadcast_to(np.asarray(stamp_source, np.uint8), (count,)),
        (wire["fracsec"] >> 24).astype(np.uint8),
        np.empty((count, len(layout.slots)), np.uint16),
        np.empty((count, len(layout.phasors)), np.complex128),
        np.empty((count, len(layout.slots))),
        np.empty((count, len(layout.slots))),
        np.empty((count, len(layout.analogs))),
        np.empty((count, sum(len(slots.digitals) for slots in layout.slots)), np.uint16),
        np.empty((count, len(layout.slots)), np.bool_),
        wire,
    )
    step = max(1, _BLOCK_BYTES // config.frame_size)
    for first in range(0, count, step):
        rows = slice(first, first + step)
        if check:
            _check(wire[rows], config, first)
        with _quiet():
            _fill(batch, rows)
    return batch


def _quiet() -> np.errstate:
    """The wire may hold any float, as a value or as a scale: what comes of it is infinity or NaN, and no news."""
    return np.errstate(over="ignore", invalid="ignore", divide="ignore")


def _check(wire: npt.NDArray[np.void], config: StreamConfig, first: int) -> None:
    """Hold CHK and prefix of a piece of rows that begins at frame ``first``."""
    size = config.frame_size
    octets = np.ascontiguousarray(wire).view(np.uint8).reshape(-1, size)
    if (chks := chk_array(octets)).any():
        worst = int(np.flatnonzero(chks)[0])
        frame = octets[worst]
        expected = int(chk_array(frame[None, :-2])[0])
        raise ChecksumError(expected, int(wire["chk"][worst]), idcode=config.idcode)
    right = (
        (wire["sync"] & 0xFFF0 == FrameType.DATA.sync & 0xFFF0)
        & (wire["framesize"] == size)
        & (wire["idcode"] == config.idcode)
    )
    if not right.all():
        raise ConfigError(f"frame {first + int(np.argmin(right))} is no data frame of stream {config.idcode}")


def _blocks(wire: npt.NDArray[np.void], run: Run) -> npt.NDArray[np.void]:
    """The PMU blocks of a run of stations laid out alike, as a view (N, R)."""
    strides = (wire.strides[0], run.size)
    return np.ndarray((len(wire), run.stations), block_dtype(run.fields), wire, run.offset, strides)


def _fill(batch: Batch, rows: slice) -> None:
    """Convert one piece of rows, run by run."""
    assert batch.wire is not None
    wire, layout = batch.wire[rows], layout_of(batch.config)
    parts = batch.phasors[rows].view(np.float64).reshape(len(wire), -1, 2)
    frequency, rocof, stat = batch.frequency[rows], batch.rocof[rows], batch.stat[rows]
    for run in layout.runs:
        blocks, names = _blocks(wire, run), {field.name for field in run.fields}
        columns = slice(run.first, run.first + run.stations)
        stat[:, columns] = blocks["stat"]
        frequency[:, columns], rocof[:, columns] = blocks["freq"], blocks["dfreq"]
        head = layout.slots[run.first]
        if not head.freq_float:
            _scale_frequency(frequency[:, columns], head.fnom_hz, 1000)
            _scale_frequency(rocof[:, columns], 0.0, 100)
        if "phasors" in names:
            _phasors(parts[:, run.phasors], _pairs(wire, run), layout.phasors[run.phasors])
        if "analogs" in names:
            out = batch.analogs[rows, run.analogs]
            out[...] = blocks["analogs"].reshape(out.shape)
            scales = layout.analogs[run.analogs]
            if any(scale.multiplier != 1 or scale.offset != 0 for scale in scales):
                out *= [scale.multiplier for scale in scales]
                out += [scale.offset for scale in scales]
        if "digitals" in names:
            batch.digitals[rows, run.digitals] = blocks["digitals"].reshape(len(wire), -1)
    good = (stat & STAT_DATA_ERROR_MASK) == 0
    unknown = np.isnan(frequency)
    if unknown.any():  # then only phasors can make it valid
        for number in np.flatnonzero(unknown.any(0)).tolist():
            of_station = layout.slots[number].phasor_columns
            absent = np.isnan(batch.phasors[rows, of_station.start : of_station.stop]).all(1)
            good[:, number] &= ~(unknown[:, number] & absent)
    batch.valid[rows] = good


def _scale_frequency(column: npt.NDArray[np.float64], base: float, counts: int) -> None:
    absent = column == INT16_FILLER
    column /= counts
    if base:
        column += base
    if absent.any():
        column[absent] = np.nan


_PAIRS = {"ff": ">f4", "hh": ">i2", "Hh": ">u2"}


def _pairs(wire: npt.NDArray[np.void], run: Run) -> npt.NDArray[Any]:
    """The phasors of a run of stations as sent, (N, R*P, 2), native float32, int16 or (integer polar) uint16."""
    field = next(field for field in run.fields if field.name == "phasors")
    strides = (wire.strides[0], run.size)
    octets = np.ndarray((len(wire), run.stations), f"V{field.size}", wire, field.offset, strides)
    # opaque bytes are gathered fastest, and only what is contiguous is swapped fast
    pairs = np.ascontiguousarray(octets).view(_PAIRS[field.code])
    return pairs.astype(pairs.dtype.newbyteorder("=")).reshape(len(wire), -1, 2)


@cache
def _unit_phasors() -> npt.NDArray[np.complex128]:
    """exp(jθ) of every integer angle, by its count as uint16; NaN for the filler."""
    angle = np.arange(1 << 16, dtype=np.uint16).view(np.int16) * RAD_PER_COUNT
    unit: npt.NDArray[np.complex128] = np.cos(angle) + 1j * np.sin(angle)
    unit[INT16_FILLER] = complex(np.nan, np.nan)
    return unit


def _phasors(out: npt.NDArray[np.float64], raw: npt.NDArray[Any], slots: Sequence[PhasorSlot]) -> None:
    """Wire phasors of alike stations into ``out`` (N, R*P, 2), as real and imaginary parts in SI units."""
    factor = np.array([slot.factor for slot in slots])
    turn = np.array([slot.angle_offset_rad for slot in slots])
    floating, first, second = slots[0].floating, raw[..., 0], raw[..., 1]
    if slots[0].polar:
        if floating:
            angle = second - turn
            cosine, sine = np.cos(angle), np.sin(angle)
        else:
            unit = _unit_phasors().take(second)
            if turn.any():
                unit *= np.exp(-1j * turn)
            cosine, sine = unit.real, unit.imag
        magnitude = first * factor
        np.multiply(magnitude, cosine, out=out[..., 0])
        np.multiply(magnitude, sine, out=out[..., 1])
        return
    out[...] = raw
    if not floating:
        out[(first == INT16_FILLER) & (second == INT16_FILLER)] = np.nan
    if (factor != 1).any():
        out *= factor[:, None]
    if turn.any():
        turned = (out[..., 0] + 1j * out[..., 1]) * np.exp(-1j * turn)
        out[..., 0], out[..., 1] = turned.real, turned.imag


def encode_batch(batch: Batch) -> tuple[npt.NDArray[np.uint8], int]:
    """Frames of ``batch``'s columns, (N, FRAMESIZE) bytes, and how many values were clipped to their field's range.

    Integer fields take the nearest count; NaN becomes the filler of its FORMAT. ``batch.wire`` is not looked at.
    """
    config, layout, count = batch.config, layout_of(batch.config), len(batch)
    wire = np.zeros(count, dtype_of(config))
    soc, fracsec = timebase.from_ns_array(batch.time_ns, config.time_base)
    wire["sync"], wire["framesize"], wire["idcode"] = FrameType.DATA.sync, config.frame_size, config.idcode
    wire["soc"], wire["fracsec"] = soc, fracsec | batch.time_quality.astype(np.int64) << 24
    octets = wire.view(np.uint8).reshape(count, config.frame_size)
    step = max(1, _BLOCK_BYTES // config.frame_size)
    clipped = 0
    for first in range(0, count, step):
        rows = slice(first, first + step)
        with _quiet():
            clipped += sum(_put(wire[rows], batch[rows], layout, run) for run in layout.runs)
        seal_array(octets[rows])
    return octets, clipped


def _put(wire: npt.NDArray[np.void], batch: Batch, layout: Layout, run: Run) -> int:
    """Write one piece of rows of one run of stations; how many values were clipped."""
    blocks, names, clipped = _blocks(wire, run), {field.name for field in run.fields}, 0
    columns = slice(run.first, run.first + run.stations)
    head = layout.slots[run.first]
    blocks["stat"] = batch.stat[:, columns]
    if head.freq_float:
        blocks["freq"], blocks["dfreq"] = batch.frequency[:, columns], batch.rocof[:, columns]
    else:
        blocks["freq"], over = _int16((batch.frequency[:, columns] - head.fnom_hz) * 1000)
        blocks["dfreq"], over_rocof = _int16(batch.rocof[:, columns] * 100)
        clipped += over + over_rocof
    if "phasors" in names:
        clipped += _put_phasors(blocks["phasors"], batch.phasors[:, run.phasors], layout.phasors[run.phasors])
    if "analogs" in names:
        out, scales = blocks["analogs"], layout.analogs[run.analogs]
        shifted = batch.analogs[:, run.analogs] - [scale.offset for scale in scales]
        counts = (shifted / [scale.multiplier for scale in scales]).reshape(out.shape)
        if out.dtype.kind == "i":
            out[...], over = _int16(counts)
            clipped += over
        else:
            out[...] = counts
    if "digitals" in names:
        blocks["digitals"] = batch.digitals[:, run.digitals].reshape(blocks["digitals"].shape)
    return clipped


def _put_phasors(out: npt.NDArray[Any], phasors: npt.NDArray[np.complex128], slots: Sequence[PhasorSlot]) -> int:
    factor = np.array([slot.factor for slot in slots])
    turn = np.array([slot.angle_offset_rad for slot in slots])
    whole = np.where(factor == 0, np.inf, factor)  # PHUNIT 0: the count says nothing, send 0
    counts = phasors if (factor == 1).all() else phasors / whole
    if turn.any():
        counts = counts * np.exp(1j * turn)
    if not slots[0].polar:
        parts = np.ascontiguousarray(counts).view(np.float64).reshape(out.shape)
        if slots[0].floating:
            out[...] = parts
            return 0
        out[...], over = _int16(parts)
        blank = (out == INT16_FILLER).all(axis=-1) & ~np.isnan(parts).any(axis=-1)
        out[blank] = INT16_FILLER + 1  # both parts at their end would read as absent
        return over
    shape = out.shape[:3]
    magnitude, angle = np.abs(counts).reshape(shape), np.angle(counts).reshape(shape)
    if slots[0].floating:
        out[..., 0], out[..., 1] = magnitude, angle
        return 0
    absent = np.isnan(magnitude)
    out["mag"], over = _whole(magnitude, 0, 0xFFFF)
    out["angle"] = np.where(absent, INT16_FILLER, np.rint(np.nan_to_num(angle) / RAD_PER_COUNT))
    return over


def _int16(values: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], int]:
    """Nearest int16 counts with NaN as the filler, and how many were out of range (-32768 itself is the filler)."""
    return _whole(values, INT16_FILLER, -INT16_FILLER - 1)


def _whole(values: npt.NDArray[np.float64], low: int, high: int) -> tuple[npt.NDArray[np.float64], int]:
    absent = np.isnan(values)
    counts = np.rint(np.where(absent, low, values))
    clipped = np.clip(counts, low, high)
    return clipped, int(np.count_nonzero(clipped != counts))
