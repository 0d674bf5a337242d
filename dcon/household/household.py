"""``dcon run``: the processes of one controller, started in order, started again when they end, and ended in order.

A process that is started again begins anew: the watchdog with open relays, the controller in INIT and open loop. So
whatever dies, nothing is armed again but by an operator.
"""

from __future__ import annotations

import logging
import os
import select
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import NamedTuple

from dcon.household.backoff import Backoff
from dcon.link import paths
from dcon.link.children import ending, launch
from dcon.link.notify import ALIVE, READY, STOPPING, Notifier
from pmutools.errors import SourceError

LOG = logging.getLogger(__name__)
START_S = 20.0
"""For a process to take its socket, on a busy machine."""
LOOK_S = 0.02
"""Between two looks at whether it has."""
ROUND_S = 1.0
"""The longest between two rounds: so often systemd is told that all is well."""
USAGE = 2
"""Exit code of a process that was set up wrongly: it would be the same again."""
DONE = (0, 3)
"""Exit codes of a controller whose time is over."""


class Member(NamedTuple):
    """One process: when it may be called ready, and how long it may take to end."""

    name: str
    inbox: str
    """Its socket in the run folder."""
    kind: int = socket.SOCK_DGRAM
    patience_s: float = 5.0


WATCHDOG = Member("watchdog", paths.WATCHDOG)
SERVER = Member("server", paths.SERVER, socket.SOCK_SEQPACKET, 15.0)
OUTPUT = Member("output", paths.OUTPUT)
PLATFORM = Member("platform", paths.CONTROL, patience_s=10.0)
STARTED = (WATCHDOG, SERVER, OUTPUT, PLATFORM)
"""In this order; who is not needed is left out."""
ENDED = (PLATFORM, SERVER, WATCHDOG, OUTPUT)
"""In this order: the command ramps down, the log is closed, and only then do the relays open."""


@dataclass
class Outcome:
    """How a run went."""

    code: int = 0
    """Exit code of the controller that was the last."""
    restarts: dict[str, int] = field(default_factory=dict)
    said: str = ""
    """What the last controller wrote to its standard output."""


@dataclass
class _Running:
    member: Member
    process: subprocess.Popen[str] | None = None
    pidfd: int = -1
    started_s: float = 0.0
    again_s: float = 0.0
    """When to start it again, where it does not run."""
    backoff: Backoff = field(default_factory=Backoff)


class Household:
    """See the module's text.

    Parameters
    ----------
    folder
        The run folder, made.
    commands
        Arguments of Python for each member that is needed, by name; called anew for each start.
    notifier
        Is told when all are ready, and once a second that they are looked after.
    is_over
        Whether a controller that ends now, however it ends, has had its time.
    """

    def __init__(
        self,
        folder: Path,
        commands: Mapping[str, Callable[[], Sequence[str]]],
        notifier: Notifier | None = None,
        is_over: Callable[[], bool] = lambda: False,
    ) -> None:
        self.folder = folder
        self.outcome = Outcome()
        self.stopping = False
        self._over = False
        self._is_over = is_over
        self._commands = commands
        self._notifier = notifier or Notifier({})
        self._running = {member.name: _Running(member) for member in STARTED if member.name in commands}
        self._poll = select.poll()
        self._wake, self._woken = os.pipe()
        for fd in (self._wake, self._woken):
            os.set_blocking(fd, False)
        self._poll.register(self._wake, select.POLLIN)

    def stop(self) -> None:
        """Ask for the end, from a signal handler too."""
        self.stopping = True
        with suppress(OSError):
            os.write(self._woken, b"\0")

    def run(self) -> Outcome:
        """Until the controller's time is over, or :meth:`stop`.

        Raises SourceError where a process cannot start, or one that runs already has its place.
        """
        for each in self._running.values():
            path = self.folder / each.member.inbox
            if paths.is_held(path, each.member.kind):
                raise SourceError(
                    f"{path}: another process that is running has it; end that, or take another run folder"
                )
        try:
            for each in self._running.values():
                self._start(each)
                if not self._became_ready(each):
                    return self.outcome
            self._notifier.tell(READY, status="running")
            while not self.stopping and not self._over:
                self._round()
        finally:
            self._end()
        return self.outcome

    @contextmanager
    def stopped_by_signals(self) -> Iterator[None]:
        """SIGINT and SIGTERM ask for the end; a second one interrupts."""

        def stop(signum: int, frame: FrameType | None) -> None:
            if self.stopping:
                raise KeyboardInterrupt
            self.stop()

        before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    # --- starting

    def _start(self, each: _Running) -> None:
        """Raises SourceError where the system has no room for one more."""
        out = subprocess.PIPE if each.member is PLATFORM else subprocess.DEVNULL
        environment = {key: value for key, value in os.environ.items() if key != "NOTIFY_SOCKET"}
        command = self._commands[each.member.name]()
        each.started_s = time.monotonic()
        try:
            each.process = launch(command, dies_by=signal.SIGTERM, stdout=out, env=environment)
            each.pidfd = os.pidfd_open(each.process.pid)
        except (OSError, subprocess.SubprocessError) as error:
            self._abandon(each)
            reason = getattr(error, "strerror", None) or error
            raise SourceError(f"the {each.member.name} process could not be started, {reason}") from None
        self._poll.register(each.pidfd, select.POLLIN)

    def _abandon(self, each: _Running) -> None:
        """End one that nobody could look after."""
        process, each.process = each.process, None
        if process is not None:
            process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()

    def _became_ready(self, each: _Running) -> bool:
        """Wait until it has its socket; false where the end was asked for meanwhile."""
        assert each.process is not None
        end_s = time.monotonic() + START_S
        path = self.folder / each.member.inbox
        while not paths.is_held(path, each.member.kind) or each.process.poll() is not None:
            if self.stopping:
                return False
            if each.process.poll() is not None:
                self.outcome.code = each.process.returncode
                raise SourceError(f"the {each.member.name} process could not start, {ending(each.process.returncode)}")
            if time.monotonic() > end_s:
                raise SourceError(f"the {each.member.name} process has not taken {path} in {START_S:g} s")
            self._poll.poll(LOOK_S * 1000)
        return not self.stopping

    # --- looking after

    def _round(self) -> None:
        now_s = time.monotonic()
        waiting = [each.again_s - now_s for each in self._running.values() if each.process is None]
        self._poll.poll(1000 * max(min([ROUND_S, *waiting]), 0.0))
        with suppress(BlockingIOError):
            os.read(self._wake, 4096)
        for each in self._running.values():
            if each.process is not None and each.process.poll() is not None:
                self._bury(each)
            elif each.process is None and time.monotonic() >= each.again_s and not self.stopping:
                try:
                    self._start(each)
                except SourceError as error:
                    self._put_off(each, str(error))
        missing = [name for name, each in self._running.items() if each.process is None]
        self._notifier.tell(ALIVE, status=f"waiting to restart {', '.join(missing)}" if missing else "running")

    def _bury(self, each: _Running) -> None:
        """It has ended: is that the end of the run, or when is it to be started again?"""
        code = self._close(each)
        if each.member is PLATFORM and (code in DONE or code == USAGE or self._is_over()):
            self._over = True
            return
        self._put_off(each, f"the {each.member.name} process has ended, {ending(code)}")

    def _put_off(self, each: _Running, why: str) -> None:
        """It does not run: start it again, the later the more often that has happened."""
        now_s, name = time.monotonic(), each.member.name
        each.backoff, wait_s = each.backoff.ended(now_s - each.started_s)
        each.again_s = now_s + wait_s
        self.outcome.restarts[name] = self.outcome.restarts.get(name, 0) + 1
        LOG.warning("%s; started again in %g s", why, wait_s)

    def _close(self, each: _Running) -> int:
        process = each.process
        assert process is not None
        code = process.wait()
        if process.stdout is not None:
            self.outcome.said = process.stdout.read()
            process.stdout.close()
        self._poll.unregister(each.pidfd)
        os.close(each.pidfd)
        each.process = None
        if each.member is PLATFORM:
            self.outcome.code = code
        return code

    # --- ending

    def _end(self) -> None:
        self._notifier.tell(STOPPING, status="ending")
        try:
            for member in ENDED:
                each = self._running.get(member.name)
                if each is not None and each.process is not None:
                    self._ask_to_end(each)
        finally:
            for each in self._running.values():
                if each.process is not None:
                    each.process.kill()
                    self._close(each)
            os.close(self._wake)
            os.close(self._woken)

    def _ask_to_end(self, each: _Running) -> None:
        assert each.process is not None
        self._notifier.tell(ALIVE)
        each.process.terminate()
        try:
            each.process.wait(each.member.patience_s)
        except subprocess.TimeoutExpired:
            LOG.error("the %s process does not end, and is killed", each.member.name)
            each.process.kill()
        self._close(each)
