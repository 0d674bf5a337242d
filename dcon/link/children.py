"""Processes that another one starts, and that must not outlive it."""

from __future__ import annotations

import logging
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from types import FrameType

from pmutools import linux

LOG = logging.getLogger(__name__)
PATIENCE_S = 3.0
HUNG_S = 10.0
"""A process that has been heard, and says nothing for so long, hangs: the ``WatchdogSec`` of the units."""


def launch(
    arguments: Sequence[str],
    *,
    dies_by: signal.Signals = signal.SIGKILL,
    pass_fds: Sequence[int] = (),
    stdout: int | None = None,
    stderr: int | None = None,
    env: Mapping[str, str] | None = None,
) -> subprocess.Popen[str]:
    """``python ARGUMENTS`` in a process group of its own: Ctrl-C at the terminal is for its parent to pass on.

    It gets ``dies_by`` should this process end before it.
    """
    return subprocess.Popen(
        [sys.executable, *arguments],
        stdin=subprocess.DEVNULL,
        stdout=stdout,
        stderr=stderr,
        text=True,
        env=env,
        pass_fds=pass_fds,
        process_group=0,
        preexec_fn=partial(linux.end_with_parent, dies_by),  # one thread, still: nobody holds a lock at the fork
    )


class Children:
    """The control process's own: the kernel tells when one ends, so nobody has to ask.

    One at a time in a process: it takes SIGCHLD, and gives it back when it is closed.
    """

    def __init__(self) -> None:
        self.processes: dict[str, subprocess.Popen[str]] = {}
        self._rang = False
        self._before = signal.signal(signal.SIGCHLD, self._ring)

    def start(self, name: str, arguments: Sequence[str], pass_fds: Sequence[int] = ()) -> None:
        """Its standard output is nobody's: who reads this process's waits for nobody else's end."""
        self.processes[name] = launch(arguments, pass_fds=pass_fds, stdout=subprocess.DEVNULL)

    def trouble(self) -> str:
        """Who has ended, in words; "" while all are there."""
        if not self._rang:
            return ""
        self._rang = False
        for name, process in self.processes.items():
            if process.poll() is not None:
                self._rang = True
                return f"the {name} process has ended, {ending(process.returncode)}"
        return ""

    def close(self) -> None:
        for process in self.processes.values():
            process.kill()  # they hold nothing that an orderly end would save
        for name, process in self.processes.items():
            try:
                process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:  # a disk holds it: it ends when that lets it go
                LOG.error("the %s process was killed, and is still there after %g s", name, PATIENCE_S)
        signal.signal(signal.SIGCHLD, self._before)

    def _ring(self, signum: int, frame: FrameType | None) -> None:
        self._rang = True


def ending(code: int | None) -> str:
    """How a process ended, for people."""
    if code is not None and code < 0:
        try:
            return f"by {signal.Signals(-code).name}"
        except ValueError:
            return f"by signal {-code}"
    return f"exit code {code}"
