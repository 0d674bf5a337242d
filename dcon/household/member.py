"""The processes of ``dcon run``: who they are, in which order, and the lives of one."""

from __future__ import annotations

import logging
import math
import os
import select
import signal
import socket
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from dcon.household.backoff import Backoff
from dcon.household.ear import Ear
from dcon.link import paths
from dcon.link.children import launch
from pmutools.errors import SourceError

LOG = logging.getLogger(__name__)


class Member(NamedTuple):
    """One process, and how long it may take to end."""

    name: str
    inbox: str
    """Its socket in the run folder."""
    kind: int = socket.SOCK_DGRAM
    patience_s: float = 5.0


WATCHDOG = Member("watchdog", paths.WATCHDOG)
SERVER = Member("server", paths.SERVER, socket.SOCK_SEQPACKET, 15.0)
OUTPUT = Member("output", paths.OUTPUT)
PLATFORM = Member("platform", paths.CONTROL, patience_s=10.0)
SPEAKERS = (SERVER, PLATFORM)
"""Their standard output is kept, in memory: what they say of the run at its end."""
SAID_BYTES = 1 << 20
"""Of which so much is read."""
STARTED = (WATCHDOG, SERVER, OUTPUT, PLATFORM)
"""In this order; who is not needed is left out."""
ENDED = (PLATFORM, SERVER, WATCHDOG, OUTPUT)
"""In this order: the command ramps down, the log is closed, and only then do the relays open."""


class Supervised:
    """A member, life after life. Raises SourceError where it cannot be heard."""

    def __init__(self, member: Member, folder: Path, poll: select.poll) -> None:
        """``poll`` wakes up for what it says, and when it ends."""
        self.member = member
        self.process: subprocess.Popen[str] | None = None
        """Of the present life."""
        self.again_s = math.inf
        """When to start it again, where it does not run, by the monotonic clock."""
        self.was_ready = False
        """In this life or one before."""
        self.ear = Ear(folder, member.name)
        self._poll = poll
        self._pidfd = -1
        self._said: int | None = None
        """A file for the standard output of the present life: no pipe, which may fill, and which others may hold."""
        self._started_s = 0.0
        self._backoff = Backoff()
        self.ear.register(poll)

    def start(self, command: Sequence[str]) -> None:
        """Raises SourceError where the system has no room for one more."""
        self.ear.begin()
        self._started_s = time.monotonic()
        environment = {**os.environ, "NOTIFY_SOCKET": self.ear.path}
        try:
            self._said = os.memfd_create(self.member.name) if self.member in SPEAKERS else None
            out = subprocess.DEVNULL if self._said is None else self._said
            self.process = launch(command, dies_by=signal.SIGTERM, stdout=out, env=environment)
            self._pidfd = os.pidfd_open(self.process.pid)
        except (OSError, subprocess.SubprocessError) as error:
            self._abandon()
            reason = getattr(error, "strerror", None) or error
            raise SourceError(f"the {self.member.name} process could not be started, {reason}") from None
        self._poll.register(self._pidfd, select.POLLIN)

    def _abandon(self) -> None:
        """End one that nobody could look after."""
        process, self.process = self.process, None
        if process is not None:
            process.kill()
            process.wait()
        self._last_words()

    def listen(self, passed_s: float) -> bool:
        """Hear what it says, ``passed_s`` after the last time; whether it has ended, its last words heard too."""
        has_ended = self.process is not None and self.process.poll() is not None
        self.ear.listen(passed_s)
        self.was_ready = self.was_ready or self.ear.is_ready
        return has_ended

    def kill(self) -> None:
        """It is buried when it is dead, and nobody waits for that: a disk may hold it."""
        if self.process is not None:
            self.process.kill()
            self.ear.silent_s = 0.0

    def put_off(self, most_s: float = math.inf) -> float:
        """It does not run: seconds until it is started again, the more the more often that has happened."""
        now_s = time.monotonic()
        self._backoff, wait_s = self._backoff.ended(now_s - self._started_s)
        wait_s = min(wait_s, most_s)
        self.again_s = now_s + wait_s
        return wait_s

    def ask_to_end(self) -> float:
        """When it is to have ended, by the monotonic clock."""
        assert self.process is not None
        self.process.terminate()
        return time.monotonic() + self.member.patience_s

    def bury(self) -> tuple[int, str | None]:
        """Its exit code, once it has ended, and what it wrote, where that is kept."""
        process, self.process = self.process, None
        assert process is not None
        code = process.wait()
        self._poll.unregister(self._pidfd)
        os.close(self._pidfd)
        return code, self._last_words()

    def _last_words(self) -> str | None:
        """What it wrote, which is all there will be."""
        said, self._said = self._said, None
        if said is None:
            return None
        text = os.pread(said, SAID_BYTES, 0).decode(errors="replace")
        os.close(said)
        return text
