"""Names of files and folders that are made for streams: safe for file systems, unique, none of the user's touched."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from pmutools.c37118.config import StreamConfig
from pmutools.errors import SourceError
from pmutools.flow import Flow

Namer = Callable[[Flow, StreamConfig], str]


def stream_name(flow: Flow, config: StreamConfig) -> str:
    """``STATION-IDCODE``, by the stream's first station."""
    station = config.stations[0].name if config.stations else ""
    return f"{safe(station)}-{config.idcode}"


def safe(text: str) -> str:
    """``text`` as part of a file's name."""
    return re.sub(r"[^\w.+-]+", "_", text).strip("._") or "stream"


class FileNames:
    """Names of files in one folder, each given once, in whatever case."""

    def __init__(self, suffix: str) -> None:
        self.suffix = suffix
        self._taken: set[str] = set()

    def unique(self, stem: str) -> str:
        """``stem`` with the suffix; with ``-2``, ``-3`` ... before it where that was given before."""
        name, count = stem + self.suffix, 1
        while name.casefold() in self._taken:
            count += 1
            name = f"{stem}-{count}{self.suffix}"
        self._taken.add(name.casefold())
        return name


def folder_for(path: Path, suffix: str) -> Path:
    """A new folder, named as ``path`` without its suffix; with ``-2``, ``-3`` ... where that holds something already.

    Raises SourceError where it cannot be made.
    """
    wanted = path.with_name(path.name[: -len(suffix)])
    folder, count = wanted, 1
    try:
        while folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
            count += 1
            folder = wanted.with_name(f"{wanted.name}-{count}")
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise SourceError(
            f"cannot make the folder {folder}: {error.strerror}; check the place and its rights"
        ) from None
    return folder
