"""The latch of a trip in a file of the run folder, so that a watchdog that is started anew begins tripped.

That the file is there is the latch; what it holds are the causes. A thread of its own writes and removes it: neither a
disk nor a log that is stuck holds up a round, and a stuck log does not keep the latch from being written.
"""

from __future__ import annotations

import json
import os
import threading
from contextlib import suppress
from typing import Final

from dcon.watchdog.rules import BIT, names_of

NAME: Final = "watchdog.latch"
LONGEST: Final = 4096
RETRY_S: Final = 1.0
READING: Final = os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC
"""A pipe in its place holds nothing up, and a link is not followed."""
UNREADABLE: Final = BIT["latch_unreadable"]


def text_of(causes: int) -> bytes:
    """What the file holds."""
    return json.dumps({"causes": names_of(causes)}).encode() + b"\n"


def causes_in(text: bytes) -> int:
    """The causes that a file holds; never 0: one that makes no sense is a trip too."""
    try:
        names = json.loads(text)["causes"]
        return sum({BIT[name] for name in names}) or UNREADABLE
    except (ValueError, TypeError, KeyError, RecursionError):
        return UNREADABLE


def found(path: str) -> int:
    """The causes of a trip that nobody has reset; 0 only where no such file is there."""
    try:
        handle = os.open(path, READING)
    except FileNotFoundError:
        return 0
    except OSError:
        return UNREADABLE
    try:
        return causes_in(os.read(handle, LONGEST))
    except OSError:
        return UNREADABLE
    finally:
        os.close(handle)


def keep(path: str, causes: int) -> str:
    """Write the file whole, or remove it where there are no causes; why that could not be done, "" where it was.

    Where the disk has no room for the causes the file is left without: it is a trip still.
    """
    trouble = ""
    try:
        if causes:
            new = path + ".new"
            handle = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
            try:
                os.write(handle, text_of(causes))
            except OSError as error:
                trouble = f"{path}: {error.strerror}"
            finally:
                os.close(handle)
            os.replace(new, path)
        else:
            with suppress(FileNotFoundError):
                os.unlink(path)
    except OSError as error:
        return f"{path}: {error.strerror}"
    return trouble


class Latch:
    """Keeps the file as the newest :meth:`hold` says. Call from one thread only."""

    def __init__(self, path: str, causes: int) -> None:
        """``causes``: what the file holds already."""
        self._path, self._held = path, causes
        self._wanted: int | None = None
        self._wake, self._ending = threading.Event(), False
        self.trouble = ""
        """Why the file is not as it should be; set by the thread."""
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def hold(self, causes: int) -> None:
        """From now on the file shall hold these; 0 is none. Never waits, never raises."""
        if causes != self._held:
            self._held = self._wanted = causes
            self._wake.set()

    def close(self, timeout_s: float = 0.5) -> None:
        """Write what waits, for so long at most."""
        self._ending = True
        self._wake.set()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            self._wake.wait(RETRY_S if self.trouble else None)
            self._wake.clear()
            ending, wanted = self._ending, self._wanted
            if wanted is not None:
                self.trouble = keep(self._path, wanted)
            if ending:
                return
