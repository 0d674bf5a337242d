"""Asking a program, for a bounded time and a bounded answer."""

from __future__ import annotations

import os
import select
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Sequence
from contextlib import suppress

ANSWER_BYTES = 1 << 16
"""Of an answer; what is more is left out."""
SLICE_S = 0.1
"""How soon it is noticed that nobody wants the answer any more."""
SYSTEM_PATHS = ("/usr/local/sbin", "/usr/sbin", "/sbin")
"""Where such programs are, even where an ordinary user's PATH does not have these."""


class NoAnswer(Exception):
    """A source that says nothing; its text is the reason, for people."""


class Patience:
    """How long an answer is waited for: ``seconds`` from now, or until ``stopped`` is set."""

    def __init__(self, seconds: float, stopped: threading.Event | None = None) -> None:
        self._end_s = time.monotonic() + seconds
        self._stopped = stopped

    @property
    def left_s(self) -> float:
        """0 when it is over."""
        if self._stopped is not None and self._stopped.is_set():
            return 0.0
        return max(0.0, self._end_s - time.monotonic())

    def at_most(self, seconds: float) -> Patience:
        """The same, for ``seconds`` if that is less."""
        return Patience(min(seconds, self.left_s), self._stopped)


def find(program: str) -> str | None:
    """Path of an installed program; None where there is none, and on systems without POSIX pipes."""
    if os.name != "posix":
        return None
    return shutil.which(program) or shutil.which(program, path=os.pathsep.join(SYSTEM_PATHS))


def ask(command: Sequence[str], patience: Patience) -> str:
    """What a program writes, errors included, in English. Raises NoAnswer where it does not start or does not end."""
    name = os.path.basename(command[0])
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, "LC_ALL": "C"},
            start_new_session=True,
        )
    except OSError as error:
        raise NoAnswer(f"{name} cannot be run: {error.strerror}") from None
    assert process.stdout is not None
    try:
        answer = _read(process.stdout.fileno(), patience)
        process.wait(max(patience.left_s, SLICE_S))
    except (NoAnswer, subprocess.TimeoutExpired):
        raise NoAnswer(f"{name} does not answer in time") from None
    finally:
        process.stdout.close()
        if process.returncode is None:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            with suppress(
                subprocess.TimeoutExpired
            ):  # then the kernel has it, and it is waited for at some later start
                process.wait(SLICE_S)
    return answer.decode("utf-8", "replace")


def _read(fd: int, patience: Patience) -> bytes:
    answer = bytearray()
    while (left_s := patience.left_s) > 0:
        if not select.select([fd], [], [], min(left_s, SLICE_S))[0]:
            continue
        if not (data := os.read(fd, ANSWER_BYTES)):
            return bytes(answer)
        answer += data[: ANSWER_BYTES - len(answer)]
    raise NoAnswer


def shortened(text: str, room: int = 80) -> str:
    """The beginning of an answer, on one line."""
    line = " ".join(text.split())
    return line if len(line) <= room else f"{line[: room - 1]}…"
