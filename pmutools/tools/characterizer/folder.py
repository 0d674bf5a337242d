"""The folder of a run: what is in it, and files that are there whole or not at all."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from pmutools.errors import SourceError
from pmutools.formats.output import cannot_write
from pmutools.tools.characterizer.names import FILES


class Folder:
    """Made, and rid of the files that an earlier run left. Raises SourceError where the system refuses."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            path.mkdir(parents=True, exist_ok=True)
            for name in FILES:
                (path / name).unlink(missing_ok=True)
        except OSError as error:
            raise SourceError(
                f"cannot make the folder {path}: {error.strerror}; check the place and its rights"
            ) from None

    def put(self, name: str, text: str) -> None:
        """Write a file, in place of the one before, at once: who reads it sees one or the other."""
        path, fresh = self.path / name, self.path / f"{name}.new"
        try:
            fresh.write_text(text, encoding="utf-8")
            os.replace(fresh, path)
        except OSError as error:
            with contextlib.suppress(OSError):
                fresh.unlink(missing_ok=True)
            raise cannot_write(path, error) from None
