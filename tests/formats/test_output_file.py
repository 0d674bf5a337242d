"""Files being written end where a write ended, whatever happens; what a full disk refuses is no part of them."""

from __future__ import annotations

import gzip
import io
import os
from pathlib import Path

import pytest

from pmutools.errors import SourceError
from pmutools.formats.capture.window import Window
from pmutools.formats.output import HELD_BYTES, OutputFile

SUFFIXES = (".csv", ".csv.gz", ".csv.zst")
ROW = b"row of text, number %06d\n"


class NarrowDisk(io.RawIOBase):
    """A file on a disk that takes ``room`` bytes and no more."""

    def __init__(self, path: Path, room: int) -> None:
        super().__init__()
        self.path, self.room = path, room
        self.file = path.open("wb", buffering=0)

    def write(self, data: object) -> int:
        piece = bytes(memoryview(data)[: self.room])  # type: ignore[arg-type]
        if not piece:
            raise OSError(28, "No space left on device")
        self.room -= len(piece)
        return self.file.write(piece)

    def truncate(self, size: int | None = None) -> int:
        return self.file.truncate(size)

    def close(self) -> None:
        self.file.close()


def content(path: Path) -> bytes:
    """What of a file can be read, through compression; that it has no end is no matter."""
    with Window(path) as window:
        window.advance(0, 1 << 30)
        return window.data


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_was_flushed_is_on_the_disk_and_nothing_else(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    with OutputFile(path) as file:
        file.write(ROW % 1)
        assert path.stat().st_size == 0
        file.flush()
        assert content(path) == ROW % 1
        file.write(ROW % 2)
        assert content(path) == ROW % 1
        assert file.nbytes == path.stat().st_size
        assert file.tell() == 2 * len(ROW % 1)
    assert content(path) == ROW % 1 + ROW % 2


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_file_always_ends_with_a_whole_write(suffix: str, tmp_path: Path) -> None:
    """Also where nobody flushes; what waits in memory is bounded."""
    path = tmp_path / f"a{suffix}"
    rows = 3 * HELD_BYTES // len(ROW)
    with OutputFile(path) as file:
        for number in range(rows):
            file.write(ROW % number)
        kept = content(path)
        assert kept.endswith(b"\n")
        assert 0 <= rows * len(ROW % 0) - len(kept) <= HELD_BYTES + len(ROW)
    assert content(path).count(b"\n") == rows


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_full_disk_leaves_what_was_flushed(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    file = OutputFile(path)
    file._raw.close()
    file._raw = NarrowDisk(path, 3000)  # type: ignore[assignment]
    flushed = 0
    with pytest.raises(SourceError, match=r"cannot write .*a\.csv.*No space left on device; make space"):
        for number in range(10_000):
            file.write(os.urandom(20).hex().encode() + b"\n")
            file.flush()
            flushed = number + 1
    assert flushed > 20
    with pytest.raises(SourceError, match="No space left"):
        file.write(b"more")
    file.close()
    assert content(path).count(b"\n") == flushed
    assert content(path).endswith(b"\n")


def test_the_same_content_gives_the_same_bytes(tmp_path: Path) -> None:
    for suffix in SUFFIXES:
        for name in ("a", "b"):
            with OutputFile(tmp_path / f"{name}{suffix}") as file:
                file.write(ROW * 100)
        assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()
    assert gzip.decompress((tmp_path / "a.csv.gz").read_bytes()) == ROW * 100


def test_too_many_open_files_are_told_with_a_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(SourceError, match="Too many open files; use --long"):
        OutputFile(tmp_path / "a.csv")
