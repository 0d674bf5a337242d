"""``samples.parquet``: a row for every frame and every lost slot, written as they are counted.

Rows of a stream are in order of arrival; a lost slot comes when it can come no more. While the file is being written a
journal of the same rows lies beside it (``samples.parquet.journal``, an Arrow stream): it is what a run leaves that is
killed, up to the last flush. Memory: a row group of 65,536 rows.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pmutools import timebase
from pmutools.c37118.batch import NO_TIME, STAMP_SOURCES
from pmutools.errors import SourceError
from pmutools.formats import JOURNAL
from pmutools.formats.output import OutputFile
from pmutools.formats.parquet import ParquetRows
from pmutools.measure.stream import STATES, Seen, State
from pmutools.tools.characterizer.gauge import Gauge
from pmutools.tools.characterizer.names import SAMPLES

if TYPE_CHECKING:
    import pyarrow as pa

AT_ONCE = 1 << 14
"""Rows are made into columns so many at a time."""
_LOST = STATES.index(State.LOST)
_COLUMNS = ("stream", "slot", "time_ns", "arrival_ns", "delay_ns", "source", "state")


class Samples:
    """Takes what gauges see. Raises SourceError where the system refuses to write."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / SAMPLES
        self._schema = _schema()
        self._file = OutputFile(self.path)
        self._rows = ParquetRows(self._file, self._schema)
        self._journal = _Journal(self.path.with_name(self.path.name + JOURNAL), self._schema)
        self._names: list[str] = []
        self._waiting: list[tuple[npt.NDArray[Any], ...]] = []
        self._count = 0
        self.rows = 0

    def add(self, gauge: Gauge, seen: Seen) -> None:
        """Rows of frames, then those of lost slots."""
        while len(self._names) <= gauge.number:
            self._names.append("")
        self._names[gauge.number] = gauge.name
        if count := len(seen.slot):
            stream = np.full(count, gauge.number, np.int32)
            self._put((stream, seen.slot, seen.time_ns, seen.arrival_ns, seen.delay_ns, seen.stamp_source, seen.state))
        if count := len(seen.lost):
            stream, nowhen = np.full(count, gauge.number, np.int32), np.full(count, NO_TIME)
            times = timebase.slot_times_array(seen.lost, seen.rate)
            none, state = np.full(count, 0xFF, np.uint8), np.full(count, _LOST, np.uint8)
            self._put((stream, seen.lost, times, nowhen, nowhen, none, state))

    def _put(self, columns: tuple[npt.NDArray[Any], ...]) -> None:
        self._waiting.append(columns)
        self._count += len(columns[0])
        if self._count >= AT_ONCE:
            self._hand_on()

    def _hand_on(self) -> None:
        import pyarrow as pa

        waiting, self._waiting = self._waiting, []
        self.rows, self._count = self.rows + self._count, 0
        columns = dict(zip(_COLUMNS, (np.concatenate(parts) for parts in zip(*waiting, strict=True)), strict=True))

        def words(codes: npt.NDArray[Any], known: list[str]) -> pa.Array:
            indices = pa.array(codes.astype(np.int32), mask=codes >= len(known))
            return pa.DictionaryArray.from_arrays(indices, pa.array(known, pa.string()))

        def times(values: npt.NDArray[np.int64]) -> pa.Array:
            return pa.array(values, pa.int64(), mask=values == NO_TIME)

        arrays = [
            words(columns["stream"], self._names),
            pa.array(columns["slot"], pa.int64()),
            pa.array(columns["time_ns"], pa.int64()),
            times(columns["arrival_ns"]),
            times(columns["delay_ns"]),
            words(columns["source"], [str(source) for source in STAMP_SOURCES]),
            words(columns["state"], [str(state) for state in STATES]),
        ]
        rows = pa.RecordBatch.from_arrays(arrays, schema=self._schema)
        self._journal.write(rows)
        self._rows.write(rows)

    def flush(self) -> None:
        """What came so far can be read, whatever happens."""
        if self._waiting:
            self._hand_on()
        self._journal.flush()

    def close(self) -> None:
        """Finish the file; the journal goes, unless the file could not be finished."""
        try:
            if self._waiting:
                self._hand_on()
            self._rows.close()
            self._file.close()
        except SourceError:
            self._journal.close()
            with suppress(SourceError):
                self._file.close()
            raise
        self._journal.discard()


class _Journal:
    """The rows as they come, an Arrow stream."""

    def __init__(self, path: Path, schema: pa.Schema) -> None:
        import pyarrow as pa

        self._file = OutputFile(path)
        self._stream: Any = pa.ipc.new_stream(self._file, schema)

    def write(self, rows: pa.RecordBatch) -> None:
        self._stream.write_batch(rows)

    def flush(self) -> None:
        self._file.flush()

    def close(self) -> None:
        """Whatever does not fit: the file is closed, or a full disk would not get its room back."""
        for part in (self._stream, self._file):
            with suppress(SourceError):
                part.close()

    def discard(self) -> None:
        self.close()
        with suppress(OSError):
            self._file.final_path.unlink()


def _schema() -> pa.Schema:
    import pyarrow as pa

    word, number = pa.dictionary(pa.int32(), pa.string()), pa.int64()
    numbers = [(name, number) for name in ("slot", "time_ns", "arrival_ns", "delay_ns")]
    return pa.schema([("stream", word), *numbers, ("stamp_source", word), ("state", word)])
