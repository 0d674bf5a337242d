"""Batches -> rows of a table as Arrow record batches: wide (a row a frame) and long (a row a value)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.c37118.batch import NO_TIME, STAMP_SOURCES, Batch
from pmutools.c37118.config import StreamConfig, encode_config
from pmutools.formats.columns import FRAME_COLUMNS, INTEGERS, Column, Phasors, columns_of, quantities
from pmutools.formats.fields import Fields

CONFIG_KEY = b"c37118.config"
"""Schema metadata: the configuration frame, in hex."""
PHASORS_KEY = b"c37118.phasors"
LONG_COLUMNS = ("station", "channel", "quantity", "value")

# pyarrow has no types: its schemas, arrays and batches are Any here.


@cache
def _frame_fields() -> dict[str, Any]:
    import pyarrow as pa

    return {
        "time_ns": pa.field("time_ns", pa.int64(), nullable=False),
        "arrival_ns": pa.field("arrival_ns", pa.int64()),
        "stamp_source": pa.field("stamp_source", pa.dictionary(pa.int8(), pa.string())),
        "idcode": pa.field("idcode", pa.uint16(), nullable=False),
        "time_quality": pa.field("time_quality", pa.uint8(), nullable=False),
    }


def names_of(config: StreamConfig, phasors: Phasors) -> tuple[str, ...]:
    """All columns of a stream's wide table."""
    return (*FRAME_COLUMNS, *(column.name for column in columns_of(config, phasors)))


# --- wide -------------------------------------------------------------------------------------------------------


class _Layout(NamedTuple):
    """The columns of one stream's table; those of the frame by their names only."""

    columns: tuple[Column | str, ...]
    quantities: frozenset[str]
    schema: Any


@lru_cache(maxsize=8192)
def _layout(config: StreamConfig, phasors: Phasors, fields: Fields | None) -> _Layout:
    import pyarrow as pa

    by_name = {column.name: column for column in columns_of(config, phasors)}
    names = names_of(config, phasors)
    chosen = names if fields is None else fields.chosen(names)
    columns = tuple(by_name.get(name, name) for name in chosen)
    kinds = {True: pa.uint16(), False: pa.float64()}
    schema = pa.schema(
        [
            _frame_fields()[column]
            if isinstance(column, str)
            else pa.field(
                column.name,
                kinds[column.quantity in INTEGERS],
                metadata={"unit": column.unit} if column.unit else None,
            )
            for column in columns
        ],
        {CONFIG_KEY: encode_config(config).hex(), PHASORS_KEY: phasors},
    )
    return _Layout(columns, frozenset(c.quantity for c in columns if isinstance(c, Column)), schema)


def wide_schema(config: StreamConfig, phasors: Phasors, fields: Fields | None = None) -> Any:
    """Arrow schema of one stream's table; each field's metadata name its unit."""
    return _layout(config, phasors, fields).schema


def has_columns(config: StreamConfig, phasors: Phasors, fields: Fields) -> bool:
    """Whether the stream has any of the columns wanted, beside those that every stream has."""
    return fields.of_frames_only or bool(_layout(config, phasors, fields).quantities)


def wide_rows(batch: Batch, phasors: Phasors, fields: Fields | None = None) -> Any:
    """``batch`` as an Arrow record batch of :func:`wide_schema`."""
    import pyarrow as pa

    columns, wanted, schema = _layout(batch.config, phasors, fields)
    values = quantities(batch, phasors, wanted)
    turned = {quantity: np.ascontiguousarray(values[quantity].T) for quantity in wanted}
    arrays = [
        _FRAME_ARRAYS[column](batch) if isinstance(column, str) else pa.array(turned[column.quantity][column.at])
        for column in columns
    ]
    return pa.RecordBatch.from_arrays(arrays, schema=schema)


def _times(values: npt.NDArray[np.int64]) -> Any:
    import pyarrow as pa

    unknown = values == NO_TIME
    return pa.array(values, mask=unknown) if unknown.any() else pa.array(values)


@cache
def _stamp_sources() -> Any:
    import pyarrow as pa

    return pa.array(list(map(str, STAMP_SOURCES)))


def _sources(codes: npt.NDArray[Any]) -> Any:
    import pyarrow as pa

    return pa.DictionaryArray.from_arrays(codes.astype(np.int8), _stamp_sources())


def _plain(values: npt.NDArray[Any]) -> Any:
    import pyarrow as pa

    return pa.array(np.ascontiguousarray(values))


_FRAME_ARRAYS: dict[str, Callable[[Batch], Any]] = {
    "time_ns": lambda batch: _plain(batch.time_ns),
    "arrival_ns": lambda batch: _times(batch.arrival_ns),
    "stamp_source": lambda batch: _sources(batch.stamp_source),
    "idcode": lambda batch: _plain(np.full(len(batch), batch.config.idcode, np.uint16)),
    "time_quality": lambda batch: _plain(batch.time_quality),
}


# --- long -------------------------------------------------------------------------------------------------------


@cache
def long_schema(*, packed: bool = False) -> Any:
    """Arrow schema of a table in long form: ``quantity`` is stat, freq_hz, mag and so on.

    ``packed``: names are dictionary-encoded, for files whose dictionaries may grow.
    """
    import pyarrow as pa

    text = pa.dictionary(pa.int32(), pa.string()) if packed else pa.string()
    names = ((name, text) for name in LONG_COLUMNS[:-1])
    return pa.schema([*_frame_fields().values(), *names, ("value", pa.float64())])


class _Words:
    """Texts by number, as an Arrow dictionary; the empty one is null and has number -1."""

    def __init__(self) -> None:
        self._numbers = {"": -1}
        self._array: Any = None

    def number(self, word: str) -> int:
        return self._numbers.setdefault(word, len(self._numbers) - 1)

    def encoded(self, numbers: npt.NDArray[np.int32]) -> Any:
        import pyarrow as pa

        if self._array is None or len(self._array) < len(self._numbers) - 1:
            self._array = pa.array(list(self._numbers)[1:], pa.string())
        nulls = numbers < 0
        codes = pa.array(numbers, mask=nulls) if nulls.any() else pa.array(numbers)
        return pa.DictionaryArray.from_arrays(codes, self._array, safe=False)


class _Course(NamedTuple):
    """The values of one stream's frame: (quantity, places among it, places in the row), and their names' numbers."""

    parts: tuple[tuple[str, npt.NDArray[np.intp], npt.NDArray[np.intp]], ...]
    words: npt.NDArray[np.int32]
    """(3, C) numbers of station, channel and quantity."""

    @property
    def width(self) -> int:
        return int(self.words.shape[1])


class LongRows:
    """Makes rows of any number of streams, frame after frame. Memory: the names, and some words a configuration."""

    def __init__(self, phasors: Phasors, fields: Fields | None = None, *, packed: bool = False) -> None:
        self.schema = long_schema(packed=packed)
        self._phasors, self._fields, self._packed = phasors, fields, packed
        self._words = (_Words(), _Words(), _Words())
        self._courses: dict[StreamConfig, _Course] = {}

    def rows(self, batches: Sequence[Batch]) -> Any:
        """``batches`` as one Arrow record batch of ``schema``."""
        import pyarrow as pa

        courses = [self._course(batch.config) for batch in batches]
        counts, widths = [len(batch) for batch in batches], [course.width for course in courses]
        values = np.empty(sum(count * width for count, width in zip(counts, widths, strict=True)))
        words = np.empty((3, len(values)), np.int32)
        at = 0
        for batch, course, count, width in zip(batches, courses, counts, widths, strict=True):
            place = slice(at, at + count * width)
            self._fill(batch, course, values[place].reshape(count, width))
            words[:, place].reshape(3, count, width)[...] = course.words[:, None, :]
            at = place.stop
        times: Any = widths[0] if len(set(widths)) == 1 else np.repeat(widths, counts)

        def repeated(name: str) -> npt.NDArray[Any]:
            return np.repeat(np.concatenate([getattr(batch, name) for batch in batches]), times)

        idcodes = np.repeat(np.array([batch.config.idcode for batch in batches], np.uint16), counts)
        names = [known.encoded(numbers) for known, numbers in zip(self._words, words, strict=True)]
        arrays = [
            pa.array(repeated("time_ns")),
            _times(repeated("arrival_ns")),
            _sources(repeated("stamp_source")),
            pa.array(np.repeat(idcodes, times)),
            pa.array(repeated("time_quality")),
            *(names if self._packed else (name.dictionary_decode() for name in names)),
            pa.array(values),
        ]
        return pa.RecordBatch.from_arrays(arrays, schema=self.schema)

    def _course(self, config: StreamConfig) -> _Course:
        course = self._courses.get(config)
        if course is None:
            columns = columns_of(config, self._phasors)
            if self._fields is not None:
                wanted = set(self._fields.chosen(names_of(config, self._phasors)))
                columns = tuple(column for column in columns if column.name in wanted)
            places: dict[str, list[tuple[int, int]]] = {}
            for row, column in enumerate(columns):
                places.setdefault(column.quantity, []).append((column.at, row))
            parts = tuple((quantity, *np.array(pairs, np.intp).T) for quantity, pairs in places.items())
            texts = ((column.station, column.channel, column.quantity) for column in columns)
            numbers = [[known.number(word) for known, word in zip(self._words, text, strict=True)] for text in texts]
            course = _Course(parts, np.array(numbers, np.int32).reshape(-1, 3).T)
            self._courses[config] = course
        return course

    def _fill(self, batch: Batch, course: _Course, out: npt.NDArray[np.float64]) -> None:
        found = quantities(batch, self._phasors, {quantity for quantity, _, _ in course.parts})
        for quantity, sources, targets in course.parts:
            out[:, targets] = found[quantity][:, sources]
