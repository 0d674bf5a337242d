"""Numbered recordings, one after the other: OUT-0001.csv, OUT-0002.csv ..., each complete in itself."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from pmutools.errors import SourceError
from pmutools.formats import Sink, suffix_of
from pmutools.formats.source import Block
from pmutools.tools.reader.log import Log
from pmutools.tools.reader.reading import Round
from pmutools.tools.reader.split import Split

Begin = Callable[[Path], Sink]
"""Begins a recording at a path."""


class Files:
    """The recordings of one run, side by side in ``folder``."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.undecoded = 0
        self._recordings: deque[list[Path]] = deque()

    @property
    def paths(self) -> list[Path]:
        return [path for recording in list(self._recordings) for path in recording]

    def add(self, log: Log) -> None:
        """A recording is finished."""
        self.undecoded += log.undecoded
        if log.paths:
            self._recordings.append(list(log.paths))

    def trim(self, count: int) -> None:
        """Delete the oldest, so that ``count`` are left. Raises SourceError where one cannot be deleted."""
        while len(self._recordings) > count:
            self.delete(self._recordings.popleft())

    def delete(self, paths: list[Path]) -> None:
        """Delete a recording's files, and the folder that was made for them."""
        try:
            for path in paths:
                path.unlink(missing_ok=True)
        except OSError as error:
            raise SourceError(f"cannot delete {error.filename}: {error.strerror}; check its rights") from None
        for folder in {path.parent for path in paths} - {self._folder}:
            with suppress(OSError):  # one that holds something else stays
                folder.rmdir()


class Rolling:
    """Records rounds into one recording after the other; cuts between rounds. ``now`` reads UTC in ns.

    Numbers go on after those that are there already; nothing is overwritten. ``keep`` recordings of this run are kept,
    the present one among them.
    """

    def __init__(
        self, path: Path, begin: Begin, split: Split, now: Callable[[], int], *, keep: int | None = None
    ) -> None:
        self._path, self._begin, self._split, self._now = path, begin, split, now
        self._number = _last_number(path)
        self._keep = keep
        self._files = Files(path.parent)
        self._slot = self._present_slot()
        self._filled = self._closed = False
        self._log = self._next()

    @property
    def paths(self) -> list[Path]:
        return self._files.paths + ([] if self._closed else self._log.paths)

    @property
    def undecoded(self) -> int:
        return self._files.undecoded + (0 if self._closed else self._log.undecoded)

    def take(self, found: Round) -> None:
        if self._filled and self._is_due():
            self._end()
            self._log = self._next()
        self._slot = self._present_slot()
        items = list(found)
        self._log.take(items)
        self._filled = self._filled or self._log.undecoded > 0 or any(isinstance(item, Block) for item in items)

    def flush(self) -> None:
        self._log.flush()

    def close(self) -> None:
        """End the present recording; one without data is taken away."""
        if not self._closed:
            self._closed = True
            self._end()

    def _next(self) -> Log:
        if self._keep is not None:
            self._files.trim(self._keep - 1)
        self._number += 1
        self._filled = False
        return Log(self._begin(_numbered(self._path, self._number)))

    def _end(self) -> None:
        self._log.close()
        if self._filled:
            self._files.add(self._log)
        else:
            self._files.delete(self._log.paths)

    def _is_due(self) -> bool:
        limit = self._split.nbytes
        if limit is not None and sum(map(_size, self._log.paths)) >= limit:
            return True
        return self._present_slot() != self._slot

    def _present_slot(self) -> int:
        return self._now() // self._split.span_ns if self._split.span_ns is not None else 0


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:  # taken away by someone else: nothing to count
        return 0


def _numbered(path: Path, number: int) -> Path:
    suffix = suffix_of(path)
    return path.with_name(f"{path.name[: len(path.name) - len(suffix)]}-{number:04d}{suffix}")


def _last_number(path: Path) -> int:
    """The highest number of a file or folder that is there already."""
    suffix = suffix_of(path)
    stem = re.escape(path.name[: len(path.name) - len(suffix)])
    form = re.compile(rf"{stem}-(\d{{4,}})(?:-\d+|{re.escape(suffix)})?")
    try:
        found = [form.fullmatch(each.name) for each in path.parent.iterdir()]
    except OSError:  # opening the first file will say it better
        return 0
    return max((int(match[1]) for match in found if match), default=0)
