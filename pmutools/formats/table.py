"""Tables of measurements as Arrow data: what CSV, Parquet and Arrow files share. Read here; written: ``table_rows``.

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
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pmutools.c37118.batch import NO_TIME
from pmutools.c37118.config import StreamConfig, decode_config
from pmutools.errors import PmuError, SourceError, WireError
from pmutools.formats import UNSAID, Nominal
from pmutools.formats.columns import FrameValues
from pmutools.formats.files import END_NS
from pmutools.formats.rows import NO_IDCODE, Rows, idcodes_of, qualities_of, stamp_code, table_source
from pmutools.formats.source import BLOCK_FRAMES, TableSource
from pmutools.formats.table_rows import CONFIG_KEY, LONG_COLUMNS


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
    rows = _rows(parts, counts, own.idcode if own else NO_IDCODE)
    return table_source(path, kind, names, rows, own=own, configs=configs, defects=counts, nominal=nominal)


def _config_in(metadata: dict[bytes, bytes], path: Path) -> StreamConfig | None:
    if (frame := metadata.get(CONFIG_KEY)) is None:
        return None
    try:
        return decode_config(bytes.fromhex(frame.decode("ascii", "replace")))[1]
    except (ValueError, WireError) as error:
        raise SourceError(f"{path}: metadata {CONFIG_KEY.decode()} is no configuration frame: {error}") from None


def _rows(parts: Iterable[Any], defects: Counter[str], idcode: int) -> Iterator[Rows]:
    import pyarrow as pa

    for part in parts:
        try:
            part.validate(full=True)  # what was bent on the way may point anywhere
        except (ValueError, pa.ArrowException):
            defects["damaged rows"] += part.num_rows
            continue
        for first in range(0, part.num_rows, BLOCK_FRAMES):
            rows = _Part(part.slice(first, BLOCK_FRAMES), idcode).rows(defects)
            if len(rows.idcode):
                yield rows


class _Part:
    """Some rows of an Arrow table; ``idcode`` is theirs where they do not say it."""

    def __init__(self, part: Any, idcode: int) -> None:
        self.part, self.idcode = part, idcode
        self.names = set(part.schema.names)

    def rows(self, defects: Counter[str]) -> Rows:
        time_ns = self._integers("time_ns" if "time_ns" in self.names else "time")
        good = (time_ns >= 0) & (time_ns < END_NS)
        if not good.all():
            defects["rows without a time"] += int(np.count_nonzero(~good))
            return _Part(self.part.filter(_array(good)), self.idcode).rows(defects)
        count = len(time_ns)
        arrivals = self._integers("arrival_ns") if "arrival_ns" in self.names else np.full(count, NO_TIME)
        return Rows(
            FrameValues(time_ns, arrivals, self._stamp_sources(), qualities_of(self.values("time_quality"), count)),
            idcodes_of(self.values("idcode"), count, self.idcode),
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
