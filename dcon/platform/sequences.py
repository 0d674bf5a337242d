"""The last sequence of each operator, across restarts: what was accepted once is never accepted again.

They are in one small file, which is replaced as a whole. It is not forced to the disk (a disk that hangs must not hold
up the loop): a crash of the process loses nothing, and after one of the machine an order is too old anyway. Where the
file is missing, damaged or could not be written, orders signed before the next start are refused instead.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

LOG = logging.getLogger(__name__)
FILE = "operators.seq"
FILE_BYTES = 1 << 16


class Remembered(NamedTuple):
    """What is known of an earlier life."""

    last: dict[str, int]
    """Sequence of each operator's last order."""
    floor_ns: int
    """UTC before which nothing can have been signed that is to be accepted; 0 where ``last`` is known."""


def load(path: Path, now_ns: int) -> Remembered:
    """What :func:`save` left, or a floor of ``now_ns`` (UTC). Never raises."""
    try:
        with path.open("rb") as file:
            return Remembered(_parsed(file.read(FILE_BYTES)), 0)
    except FileNotFoundError:
        pass
    except (OSError, ValueError) as error:
        LOG.warning("%s: %s; orders signed before now are refused", path, error)
    return Remembered({}, now_ns)


def save(path: Path, last: Mapping[str, int]) -> None:
    """Replace the file. Never raises: where that fails there is none, rather than one that is behind."""
    new = path.with_suffix(".new")
    try:
        new.write_text(json.dumps(last))
        os.replace(new, path)
    except OSError as error:
        LOG.warning("%s: %s", path, error.strerror)
        with suppress(OSError):
            path.unlink()


def _parsed(data: bytes) -> dict[str, int]:
    try:
        found = json.loads(data)
    except (ValueError, RecursionError):
        raise ValueError("no JSON") from None
    if not isinstance(found, dict) or not all(type(value) is int and value >= 0 for value in found.values()):
        raise ValueError("not the sequences of operators")
    return found
