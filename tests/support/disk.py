"""A disk that fills up, as the log writer sees it: short writes, then ENOSPC; and room again when files go."""

from __future__ import annotations

import errno
import io
import os
from pathlib import Path
from typing import Any

import pytest

from pmutools.schema import log_writer


class Disk:
    """What is in ``folder`` may not be more than ``capacity`` bytes."""

    def __init__(self, folder: Path, capacity: float = float("inf")) -> None:
        self.folder = folder
        self.capacity = capacity

    @property
    def used(self) -> int:
        return sum(path.stat().st_size for path in self.folder.iterdir())

    def open(self, path: Any, mode: str, buffering: int) -> _File:
        assert buffering == 0
        return _File(self, path, mode)


class _File(io.FileIO):
    def __init__(self, disk: Disk, path: Any, mode: str) -> None:
        super().__init__(path, mode)
        self.disk = disk

    def write(self, data: Any, /) -> int:
        room = max(self.disk.capacity - self.disk.used, 0)
        if not room:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(memoryview(data)[: int(min(room, len(data)))])


def full_disk(folder: Path, monkeypatch: pytest.MonkeyPatch, capacity: float = float("inf")) -> Disk:
    """Every log that is opened from now on lies on this disk."""
    disk = Disk(folder, capacity)
    monkeypatch.setattr(log_writer, "open", disk.open, raising=False)
    return disk
