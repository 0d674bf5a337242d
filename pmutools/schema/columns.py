"""Many protobuf messages of one kind at once: each wanted field as an array.

The messages are walked in step. Where they stand before the same tag, which they mostly do, one field of all of them is
read by a few array operations, whatever the lengths of varints and strings; those before another tag go on by
themselves. What few messages have to themselves, and what our own writer would not write, goes to the protobuf
library, message by message; the values are the same.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.schema.descriptors import message_class, unnamed_fields
from pmutools.schema.messages import MESSAGES, Field

Array = npt.NDArray[Any]
Ints = npt.NDArray[np.int64]
Bytes = npt.NDArray[np.uint8]

FEW: Final = 4
"""So many messages, or fewer, are quicker read one by one."""
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_LONGEST_VARINT = 10
_DTYPES: Final = {"double": np.float64, "uint64": np.uint64, "bool": np.bool_}
_RANGES: Final = {"int32": (-(1 << 31), (1 << 31) - 1), "uint32": (0, (1 << 32) - 1)}


class Texts(NamedTuple):
    """Strings as codes: ``values[code]``; -1 where a list has no such place."""

    codes: npt.NDArray[np.int32]
    values: list[str]


class Columns(NamedTuple):
    """Fields of M messages.

    ``rows`` (M,): which of the messages given they are, those that do not decode left out. ``fields`` by name: (M,) of
    float64, uint64, bool or int64, or :class:`Texts`; of a list (M, L), L the longest, filled up with NaN, 0 or -1.
    ``unnamed`` are the numbers of fields that the table lacks.
    """

    rows: Ints
    fields: dict[str, Any]
    unnamed: frozenset[int] = frozenset()


def decode_columns(name: str, messages: Sequence[bytes], fields: Collection[str]) -> Columns:
    """The named ``fields`` (none of bytes) of ``messages``, which are of the kind ``name`` of the table.

    Of fields that the table lacks only the numbers are told; strings that are not wanted are not looked at.
    """
    return _Decoder(name, messages, fields).columns()


class _Group(NamedTuple):
    """Messages that are walked in step: their numbers, the byte of each, and what of their lists has been read."""

    rows: Ints
    at: Ints
    places: dict[str, int]

    def among(self, chosen: Array) -> _Group:
        return _Group(self.rows[chosen], self.at[chosen], dict(self.places))


class _Decoder:
    def __init__(self, name: str, messages: Sequence[bytes], fields: Collection[str]) -> None:
        self._name = name
        self._messages = messages
        self._known = dict(enumerate(MESSAGES[name].fields, 1))
        self._wanted = {field.name: field for field in self._known.values() if field.name in fields}
        count = len(messages)
        self._good = np.zeros(count, np.bool_)
        self._unnamed: set[int] = set()
        self._arrays = {key: _empty(field, count, int(not field.repeated)) for key, field in self._wanted.items()}
        self._codes: dict[str, dict[bytes, int]] = {key: {} for key in self._wanted}
        self._octets = np.frombuffer(b"".join(messages) + bytes(_LONGEST_VARINT), np.uint8)
        lengths = np.fromiter(map(len, messages), np.int64, count)
        self._stops = np.cumsum(lengths)
        self._waiting = [_Group(np.arange(count), self._stops - lengths, {})]
        while self._waiting:
            group: _Group | None = self._waiting.pop()
            while group is not None:
                group = self._step(group)

    def columns(self) -> Columns:
        rows = np.flatnonzero(self._good)
        fields: dict[str, Any] = {}
        for key, field in self._wanted.items():
            array = self._arrays[key] if len(rows) == len(self._good) else self._arrays[key][rows]
            if not field.repeated:
                array = array[:, 0]
            if field.type == "string":
                if not field.repeated and (array < 0).any():  # proto3 leaves the empty string out
                    array = np.where(array < 0, np.int32(self._code(key, b"")), array)
                fields[key] = Texts(array, [text.decode() for text in self._codes[key]])
            else:
                fields[key] = array
        return Columns(rows, fields, frozenset(self._unnamed))

    def _step(self, group: _Group) -> _Group | None:
        """Read the next field of every message; returns those that go on, and puts aside who has another."""
        ended = group.at >= self._stops[group.rows]
        if ended.any():
            whole = group.at == self._stops[group.rows]
            self._good[group.rows[whole]] = True
            self._one_by_one(group.rows[ended & ~whole])
            group = group.among(~ended)
        if len(group.rows) <= FEW:
            self._one_by_one(group.rows)
            return None
        tags = self._octets[group.at].astype(np.int64)
        if (long := tags >= 0x80).any():
            more = self._octets[group.at + 1].astype(np.int64)
            tags = np.where(long, tags & 0x7F | more << 7, tags)
            if (long & ((more == 0) | (more >= 0x80))).any():  # longer than need be, or a number of 2,048 and more
                self._one_by_one(group.rows)
                return None
        tag = int(tags[0])
        alike = tags == tag
        if not alike.all():
            self._waiting.append(group.among(~alike))
            group = group.among(alike)
        group = group._replace(at=group.at + (2 if tag >= 0x80 else 1))
        field, kind = self._known.get(tag >> 3), tag & 7
        if not tag >> 3 or (field is not None and kind != _kind(field)):
            self._one_by_one(group.rows)
            return None
        if field is None:
            self._unnamed.add(tag >> 3)
        wanted = field if field is not None and field.name in self._wanted else None
        if kind == _VARINT:
            return self._varint(group, wanted)
        if kind == _FIXED64:
            if wanted is not None:
                self._put(group, wanted, self._taken(group.at, 8).view("<f8"))
            return group._replace(at=group.at + 8)
        if kind == _BYTES:
            return self._bytes(group, wanted)
        if kind == _FIXED32:
            return group._replace(at=group.at + 4)
        self._one_by_one(group.rows)
        return None

    def _varint(self, group: _Group, field: Field | None) -> _Group:
        values, sizes = self._varints(group.at)
        good = sizes > 0
        if field is not None and field.type in _RANGES:
            low, high = _RANGES[field.type]
            good &= (low <= values) & (values <= high)
        if not good.all():
            self._one_by_one(group.rows[~good])
            group, values, sizes = group.among(good), values[good], sizes[good]
        if field is not None:
            self._put(group, field, values[:, np.newaxis])
        return group._replace(at=group.at + sizes)

    def _bytes(self, group: _Group, field: Field | None) -> _Group:
        lengths, sizes = self._varints(group.at)
        begin = group.at + sizes
        good = (sizes > 0) & (lengths >= 0) & (lengths <= self._stops[group.rows] - begin)
        if not good.all():
            self._one_by_one(group.rows[~good])
            group, lengths, begin = group.among(good), lengths[good], begin[good]
        if field is None:
            return group._replace(at=begin + lengths)
        kept = np.ones(len(group.rows), np.bool_)
        longest = 0
        for length in np.unique(lengths).tolist():
            same = lengths == length
            part = self._taken(begin[same], length)
            values = self._listed(field, part)
            if values is None:  # no list as our writer writes it, or no text
                kept &= ~same
                continue
            self._put(group.among(same), field, values)
            longest = max(longest, values.shape[1])
        self._one_by_one(group.rows[~kept])
        places = dict(group.places)
        if field.repeated:
            places[field.name] = places.get(field.name, 0) + longest
        return _Group(group.rows[kept], (begin + lengths)[kept], places)

    def _listed(self, field: Field, part: Bytes) -> Array | None:
        """Values (n, L) of a field whose bytes are ``part`` (n, length)."""
        if field.type == "string":
            return self._text_codes(field.name, part)
        if field.type == "double":
            return None if part.shape[1] % 8 else part.view("<f8")
        return None if (part >= 0x80).any() else part  # varints of one byte

    def _varints(self, at: Ints) -> tuple[Ints, Ints]:
        """(values, sizes) of the varints at ``at``; size 0 where there is none. Negative ones have ten bytes."""
        part = self._taken(at, _LONGEST_VARINT)
        ends = part < 0x80
        sizes = np.where(ends.any(axis=1), ends.argmax(axis=1) + 1, 0)
        values = np.zeros(len(at), np.uint64)
        for k in range(int(sizes.max(initial=0))):
            septet = (part[:, k] & 0x7F).astype(np.uint64) << np.uint64(7 * k)
            values |= np.where(k < sizes, septet, np.uint64(0))
        return values.view(np.int64), sizes

    def _taken(self, at: Ints, size: int) -> Bytes:
        """``size`` bytes from each place, (n, size)."""
        if not size or not len(at):
            return np.zeros((len(at), size), np.uint8)
        windows = np.lib.stride_tricks.sliding_window_view(self._octets, size)
        return windows[np.minimum(at, len(windows) - 1)]

    def _put(self, group: _Group, field: Field, values: Array) -> None:
        """Store ``values`` (n, L) behind what of the list is there; of a single field, the last word counts."""
        first = group.places.get(field.name, 0) if field.repeated else 0
        array = self._column(field, first + values.shape[1])
        array[group.rows, first : first + values.shape[1]] = values

    def _column(self, field: Field, width: int) -> Array:
        array = self._arrays[field.name]
        if width > array.shape[1]:
            wider = np.concatenate((array, _empty(field, len(array), width - array.shape[1])), axis=1)
            array = self._arrays[field.name] = wider
        return array

    def _one_by_one(self, rows: Ints) -> None:
        """Read messages by way of the protobuf library; those that do not decode are left out."""
        from google.protobuf.message import DecodeError

        for row in rows.tolist():
            try:
                message = message_class(self._name).FromString(self._messages[row])
            except DecodeError:
                continue
            self._good[row] = True
            self._unnamed |= unnamed_fields(message)
            for key, field in self._wanted.items():
                given = getattr(message, key)
                values = list(given) if field.repeated else [given]
                if field.type == "string":
                    values = [self._code(key, text.encode()) for text in values]
                array = self._column(field, len(values))
                array[row] = _empty(field, 1, array.shape[1])[0]
                array[row, : len(values)] = values

    def _text_codes(self, key: str, part: Bytes) -> Array | None:
        """Code of each row of ``part`` (n, length), (n, 1); None where one is no UTF-8."""
        codes = np.zeros((len(part), 1), np.int32)
        left = np.arange(len(part))
        while len(left):
            text = part[left[0]]
            try:
                text.tobytes().decode()
            except UnicodeDecodeError:
                return None
            alike = (part[left] == text).all(axis=1)
            codes[left[alike]] = self._code(key, text.tobytes())
            left = left[~alike]
        return codes

    def _code(self, key: str, text: bytes) -> int:
        known = self._codes[key]
        return known.setdefault(text, len(known))


def _kind(field: Field) -> int:
    """Wire type of a field as proto3 writes it: lists of numbers packed."""
    if field.repeated or field.type in ("string", "bytes"):
        return _BYTES
    return _FIXED64 if field.type == "double" else _VARINT


def _empty(field: Field, count: int, width: int) -> Array:
    """``count`` rows of a field that no message has; of a list, that has no such place."""
    if field.type == "string":
        return np.full((count, width), -1, np.int32)
    fill = np.nan if field.type == "double" and field.repeated else 0
    return np.full((count, width), fill, _DTYPES.get(field.type, np.int64))
