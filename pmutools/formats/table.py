"""Tables of measurements as Arrow data: what CSV, Parquet and Arrow files share, both ways.

A wide table has one row a data frame and is of one stream; its columns are those of :mod:`pmutools.formats.columns`,
its metadata hold the configuration frame (in hex, because Parquet metadata are text), so that it plays back. Long form
has one row a value, of any number of streams, and is for analysis: it does not play back. Absent floats are NaN, an
unknown arrival is null.

What a wide table keeps of a frame, byte for byte, and what it cannot keep:

- integers: everything, but the magnitude beside a polar filler, and phasors whose PHUNIT (or PHSCALE) is 0;
- floats: everything in the notation of FORMAT, but the payload of NaN and CFG-3 scaling other than 1;
- floats in the other notation: to within 1e-15 of the phasor's magnitude; polar angles beyond ±180° come back within,
  and beside a magnitude of 0 as 0;
- the SYNC version nibble of data frames becomes 1, FRACSEC of TIME_BASE or more goes into SOC.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pmutools.c37118.batch import NO_TIME, STAMP_SOURCES, Batch
from pmutools.c37118.config import StreamConfig, decode_config, encode_config
from pmutools.errors import PmuError, SourceError, WireError
from pmutools.formats import UNSAID, Nominal
from pmutools.formats.columns import INTEGERS, FrameValues, Phasors, columns_of, quantities
from pmutools.formats.files import END_NS
from pmutools.formats.rows import Rows, idcodes_of, qualities_of, stamp_code, table_source
from pmutools.formats.source import BLOCK_FRAMES, TableSource

CONFIG_KEY = b"c37118.config"
"""Schema metadata: the configuration frame, in hex."""
PHASORS_KEY = b"c37118.phasors"
LONG_COLUMNS = ("station", "channel", "quantity", "value")

# pyarrow has no types: its schemas, arrays and batches are Any here.


# --- writing ----------------------------------------------------------------------------------------------------


def _frame_fields() -> list[Any]:
    import pyarrow as pa

    return [
        pa.field("time_ns", pa.int64(), nullable=False),
        pa.field("arrival_ns", pa.int64()),
        pa.field("stamp_source", pa.dictionary(pa.int8(), pa.string())),
        pa.field("idcode", pa.uint16(), nullable=False),
        pa.field("time_quality", pa.uint8(), nullable=False),
    ]


@lru_cache(maxsize=1024)
def wide_schema(config: StreamConfig, phasors: Phasors) -> Any:
    """Arrow schema of one stream's table; each field's metadata name its unit."""
    import pyarrow as pa

    fields = _frame_fields()
    for column in columns_of(config, phasors):
        kind = pa.uint16() if column.quantity in INTEGERS else pa.float64()
        fields.append(pa.field(column.name, kind, metadata={"unit": column.unit} if column.unit else None))
    return pa.schema(fields, {CONFIG_KEY: encode_config(config).hex(), PHASORS_KEY: phasors})


@lru_cache(maxsize=1)
def long_schema() -> Any:
    """Arrow schema of a table in long form: ``quantity`` is stat, freq_hz, mag and so on."""
    import pyarrow as pa

    return pa.schema([*_frame_fields(), *((name, pa.string()) for name in LONG_COLUMNS[:-1]), ("value", pa.float64())])


def wide_rows(batch: Batch, phasors: Phasors) -> Any:
    """``batch`` as an Arrow record batch of :func:`wide_schema`."""
    import pyarrow as pa

    values = quantities(batch, phasors)
    columns = [
        pa.array(np.ascontiguousarray(values[column.quantity][:, column.at]))
        for column in columns_of(batch.config, phasors)
    ]
    return pa.RecordBatch.from_arrays([*_frame_arrays(batch, 1), *columns], schema=wide_schema(batch.config, phasors))


def long_rows(batch: Batch, phasors: Phasors) -> Any:
    """``batch`` as an Arrow record batch of :func:`long_schema`, frame after frame."""
    import pyarrow as pa

    columns, values = columns_of(batch.config, phasors), quantities(batch, phasors)
    flat = np.stack([values[column.quantity][:, column.at].astype(np.float64) for column in columns], axis=1)
    codes = np.tile(np.arange(len(columns), dtype=np.int32), len(batch))
    names = [
        pa.DictionaryArray.from_arrays(codes, [value or None for value in named]).dictionary_decode()
        for named in zip(*((column.station, column.channel, column.quantity) for column in columns), strict=True)
    ]
    arrays = [*_frame_arrays(batch, len(columns)), *names, pa.array(flat.reshape(-1))]
    return pa.RecordBatch.from_arrays(arrays, schema=long_schema())


def _frame_arrays(batch: Batch, times: int) -> list[Any]:
    """The frame columns, each row ``times`` times."""
    import pyarrow as pa

    def repeated(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.repeat(values, times)

    arrival = repeated(batch.arrival_ns)
    return [
        pa.array(repeated(batch.time_ns)),
        pa.array(arrival, mask=arrival == NO_TIME),
        pa.DictionaryArray.from_arrays(repeated(batch.stamp_source).astype(np.int8), list(map(str, STAMP_SOURCES))),
        pa.array(np.full(len(arrival), batch.config.idcode, np.uint16)),
        pa.array(repeated(batch.time_quality)),
    ]


# --- reading ----------------------------------------------------------------------------------------------------


@contextmanager
def reading(path: Path, kind: str) -> Iterator[None]:
    """Turn what Arrow raises on a damaged file into a SourceError."""
    import pyarrow as pa

    try:
        yield
    except PmuError:
        raise
    except (OSError, ValueError, pa.ArrowException) as error:
        reason = str(error).partition("\n")[0].rstrip(".")
        raise SourceError(f"{path} is no readable {kind} file ({reason}); was its writer killed?") from None


def arrow_source(
    path: Path,
    kind: str,
    schema: Any,
    parts: Iterable[Any],
    configs: Iterable[StreamConfig] = (),
    defects: Counter[str] | None = None,
    nominal: Nominal = UNSAID,
) -> TableSource:
    """A source of Arrow record batches of ``schema``.

    Raises SourceError for tables in long form, without a time column, or without rows.
    """
    names = list(schema.names)
    if set(LONG_COLUMNS) <= set(names):
        raise SourceError(f"{path} is a table in long form, which cannot be played back; write it without --long")
    if "time_ns" not in names and "time" not in names:
        raise SourceError(f"{path} has no column time_ns or time; is it a table of measurements?")
    counts = Counter[str]() if defects is None else defects
    own = _config_in(schema.metadata or {}, path)
    rows = _rows(parts, counts)
    return table_source(path, kind, names, rows, own=own, configs=configs, defects=counts, nominal=nominal)


def _config_in(metadata: dict[bytes, bytes], path: Path) -> StreamConfig | None:
    if (frame := metadata.get(CONFIG_KEY)) is None:
        return None
    try:
        return decode_config(bytes.fromhex(frame.decode("ascii", "replace")))[1]
    except (ValueError, WireError) as error:
        raise SourceError(f"{path}: metadata {CONFIG_KEY.decode()} is no configuration frame: {error}") from None


def _rows(parts: Iterable[Any], defects: Counter[str]) -> Iterator[Rows]:
    import pyarrow as pa

    for part in parts:
        try:
            part.validate(full=True)  # what was bent on the way may point anywhere
        except (ValueError, pa.ArrowException):
            defects["damaged rows"] += part.num_rows
            continue
        for first in range(0, part.num_rows, BLOCK_FRAMES):
            rows = _Part(part.slice(first, BLOCK_FRAMES)).rows(defects)
            if len(rows.idcode):
                yield rows


class _Part:
    """Some rows of an Arrow table."""

    def __init__(self, part: Any) -> None:
        self.part = part
        self.names = set(part.schema.names)

    def rows(self, defects: Counter[str]) -> Rows:
        time_ns = self._integers("time_ns" if "time_ns" in self.names else "time")
        good = (time_ns >= 0) & (time_ns < END_NS)
        if not good.all():
            defects["rows without a time"] += int(np.count_nonzero(~good))
            return _Part(self.part.filter(_array(good))).rows(defects)
        count = len(time_ns)
        arrivals = self._integers("arrival_ns") if "arrival_ns" in self.names else np.full(count, NO_TIME)
        return Rows(
            FrameValues(time_ns, arrivals, self._stamp_sources(), qualities_of(self.values("time_quality"), count)),
            idcodes_of(self.values("idcode"), count),
            self.values,
        )

    def values(self, name: str) -> npt.NDArray[np.float64] | None:
        """A column as floats, null as NaN; None where there is none or it holds no numbers."""
        import pyarrow as pa

        if name not in self.names:
            return None
        column = self.part.column(name)
        if not (pa.types.is_integer(column.type) or pa.types.is_floating(column.type)):
            return None
        found: npt.NDArray[np.float64] = column.cast(pa.float64()).to_numpy(zero_copy_only=False)
        return found

    def _integers(self, name: str) -> npt.NDArray[np.int64]:
        """A column of ns, or of Arrow timestamps, as ns; null and what is neither as NO_TIME."""
        import pyarrow as pa

        column = self.part.column(name)
        if pa.types.is_timestamp(column.type):
            column = column.cast(pa.timestamp("ns", column.type.tz), safe=False).view(pa.int64())
        if not pa.types.is_integer(column.type):
            return np.full(len(column), NO_TIME)
        found: npt.NDArray[np.int64] = column.cast(pa.int64()).fill_null(NO_TIME).to_numpy(zero_copy_only=False)
        return found

    def _stamp_sources(self) -> npt.NDArray[np.uint8]:
        import pyarrow as pa

        count = self.part.num_rows
        default = np.full(count, stamp_code(None), np.uint8)
        if "stamp_source" not in self.names:
            return default
        column = self.part.column("stamp_source")
        if not pa.types.is_dictionary(column.type):
            if not (pa.types.is_string(column.type) or pa.types.is_large_string(column.type)):
                return default
            column = column.dictionary_encode()
        codes = np.array([*map(stamp_code, column.dictionary.to_pylist()), stamp_code(None)], np.uint8)
        found: npt.NDArray[np.uint8] = codes[column.indices.fill_null(len(codes) - 1).to_numpy(zero_copy_only=False)]
        return found


def _array(values: npt.NDArray[Any]) -> Any:
    import pyarrow as pa

    return pa.array(values)
