"""Copies of frames on their way out, a column each: what a plan hands to the sockets and to the ledger."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.flow import Segmentation
from pmutools.impair.outgoing import Fate
from pmutools.tools.player.reel import I64

FATES = tuple(Fate)
SENT, FAILED, SKIPPED = (FATES.index(fate) for fate in (Fate.SENT, Fate.FAILED, Fate.SKIPPED))


class Extra(NamedTuple):
    """What few copies have: how they are written to TCP, and whether a changed configuration is announced unasked."""

    write: Segmentation | None = None
    notice: bool = True


@dataclass(frozen=True, slots=True)
class Sheet:
    """N copies of frames in the order in which they leave; times in ns from the start of play, or POSIX UTC."""

    offset_ns: I64
    """When it is to leave."""
    part: npt.NDArray[np.int32]
    index: I64
    copy: npt.NDArray[np.int32]
    source_ns: I64
    """Stamp as recorded."""
    stamp_ns: I64
    """Stamp as sent."""
    fate: npt.NDArray[np.uint8]
    """Index into :data:`FATES`: what the faults decided."""
    edition: npt.NDArray[np.int32]
    """Which configuration rules its data."""
    faults: npt.NDArray[np.object_]
    """The ledger's list, a str each."""
    extra: npt.NDArray[np.object_]
    """:class:`Extra`, or None."""
    at: I64
    nbytes: I64
    wire: npt.NDArray[np.uint8]
    """The frames' bytes: ``nbytes`` from ``at`` on."""

    def __len__(self) -> int:
        return len(self.offset_ns)

    @property
    def special(self) -> bool:
        """Whether any copy has an :class:`Extra`."""
        return self.extra.base is not _Same.none and any(extra is not None for extra in self.extra)

    def frame(self, row: int) -> bytes:
        at = int(self.at[row])
        return self.wire[at : at + int(self.nbytes[row])].tobytes()

    def take(self, rows: npt.NDArray[Any] | slice) -> Sheet:
        """Some of the copies; their bytes are shared."""
        columns = {name: getattr(self, name)[rows] for name in _COLUMNS}
        return Sheet(**columns, wire=self.wire)

    def compact(self) -> Sheet:
        """The same with bytes of its own."""
        total = int(self.nbytes.sum())
        starts = np.cumsum(self.nbytes) - self.nbytes
        places = np.repeat(self.at - starts, self.nbytes) + np.arange(total)
        return replace(self, at=starts, wire=self.wire[places])

    def in_order(self) -> Sheet:
        """Sorted by time; copies of one time stay in order."""
        if np.all(self.offset_ns[1:] >= self.offset_ns[:-1]):
            return self
        return self.take(np.argsort(self.offset_ns, kind="stable"))


_COLUMNS = tuple(item.name for item in fields(Sheet) if item.name != "wire")
_TYPES = {
    "part": np.int32,
    "copy": np.int32,
    "fate": np.uint8,
    "edition": np.int32,
    "faults": np.object_,
    "extra": np.object_,
}


def joined(sheets: Sequence[Sheet]) -> Sheet:
    """Sheets one after the other."""
    if len(sheets) == 1:
        return sheets[0]
    if not sheets:
        return EMPTY
    columns = {name: np.concatenate([getattr(sheet, name) for sheet in sheets]) for name in _COLUMNS}
    sizes = [len(sheet.wire) for sheet in sheets]
    columns["at"] += np.repeat(np.cumsum([0, *sizes[:-1]]), [len(sheet) for sheet in sheets])
    return Sheet(**columns, wire=np.concatenate([sheet.wire for sheet in sheets]))


class _Same:
    """Columns that are the same in every clean sheet, and shared by them: not to be written to."""

    zero: npt.NDArray[np.int32]
    sent: npt.NDArray[np.uint8]
    blank: npt.NDArray[np.object_]
    none: npt.NDArray[np.object_]

    @classmethod
    def grow(cls, count: int) -> None:
        cls.zero, cls.sent = np.zeros(count, np.int32), np.full(count, SENT, np.uint8)
        cls.blank, cls.none = np.full(count, "", np.object_), np.full(count, None, np.object_)
        for column in (cls.zero, cls.sent, cls.blank, cls.none):
            column.flags.writeable = False


_Same.grow(1024)


def clean(
    offset_ns: I64,
    part: npt.NDArray[np.int32],
    index: I64,
    source_ns: I64,
    stamp_ns: I64,
    edition: npt.NDArray[np.int32],
    at: I64,
    nbytes: I64,
    wire: npt.NDArray[np.uint8],
) -> Sheet:
    """Frames to which nothing happens."""
    count = len(offset_ns)
    if count > len(_Same.zero):
        _Same.grow(2 * count)
    return Sheet(
        offset_ns,
        part,
        index,
        _Same.zero[:count],
        source_ns,
        stamp_ns,
        _Same.sent[:count],
        edition,
        _Same.blank[:count],
        _Same.none[:count],
        at,
        nbytes,
        wire,
    )


def changes(before: npt.NDArray[np.int32], part: npt.NDArray[np.int32], edition: npt.NDArray[np.int32]) -> list[int]:
    """The rows (of N) whose configuration is another than that of their part's row before, or than ``before`` (P,)."""
    rows = list[int]()
    if np.array_equal(before[part], edition):
        return rows
    now = before.copy()
    for row, (of, new) in enumerate(zip(part.tolist(), edition.tolist(), strict=True)):
        if now[of] != new:
            now[of] = new
            rows.append(row)
    return rows


EMPTY = Sheet(**{name: np.zeros(0, _TYPES.get(name, np.int64)) for name in _COLUMNS}, wire=np.zeros(0, np.uint8))
