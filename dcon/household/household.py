"""``dcon run``: the processes of one controller, started in order, started again when they end, and ended in order.

What ends with an error before it was ever ready ends the whole. What ends later, or hangs and is killed, is started
again and begins anew: the watchdog with open relays, the controller in INIT and open loop. So whatever dies, nothing is
armed again but by an operator.
"""

from __future__ import annotations

import logging
import math
import os
import select
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

from dcon.household.ear import ear_of
from dcon.household.member import ENDED, PLATFORM, SERVER, STARTED, Supervised
from dcon.household.predecessor import await_places
from dcon.link.children import HUNG_S, ending
from dcon.link.notify import ALIVE, READY, STOPPING, Notifier
from pmutools.errors import SourceError

LOG = logging.getLogger(__name__)
START_S = 30.0
"""For a process to be ready, on a busy machine: the controller may wait 10 s for the watchdog."""
ROUND_S = 1.0
"""The longest between two rounds: so often systemd is told that all is well."""
SOON_S = 0.25
"""A server is started again as soon as this while the controller ends, however often it has died."""
FAILED, USAGE = 1, 2
"""Exit codes of a process that has said why; of the latter it was set up wrongly, and would be the same again."""
MOST_SAID = 256
"""Supervised of one process whose last words are kept."""
DONE = (0, 3)
"""Exit codes of a controller whose time is over."""


class NotStarted(SourceError):
    """A process ended before it was ready, with the exit code ``code``."""

    def __init__(self, text: str, code: int) -> None:
        super().__init__(text)
        self.code = code

    @property
    def is_told(self) -> bool:
        """Whether the process has said why itself, in a line of its own."""
        return self.code in (FAILED, USAGE)


@dataclass
class Outcome:
    """How a run went."""

    code: int = 0
    """Exit code of the controller that was the last."""
    restarts: dict[str, int] = field(default_factory=dict)
    said: dict[str, list[str]] = field(default_factory=dict)
    """What each controller and each server wrote to its standard output, by name; one that was killed wrote nothing."""


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
        self._starting = True
        self._ending = False
        self._is_over = is_over
        self._commands = commands
        self._notifier = notifier or Notifier({})
        self._running: dict[str, Supervised] = {}
        self._poll = select.poll()
        self._round_s = time.monotonic()
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

        Raises SourceError where a process cannot start, or one that runs already keeps its place.
        """
        needed = [member for member in STARTED if member.name in self._commands]
        await_places(
            [self.folder / ear_of(of.name) for of in needed],
            [(self.folder / of.inbox, of.kind) for of in needed],
            lambda: self.stopping,
            lambda seconds: self._poll.poll(1000 * seconds),
        )
        try:
            for member in needed:
                if self.stopping or self._over:
                    break
                each = self._running[member.name] = Supervised(member, self.folder, self._poll)
                each.start(self._commands[member.name]())
                while not (each.was_ready or self.stopping or self._over):
                    self._round()
            self._starting = False
            if not self.stopping and not self._over:
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

    # --- looking after

    def _round(self) -> None:
        """Wait for news, at most ROUND_S, and see to everybody. Raises SourceError for one that cannot start."""
        passed_s = self._pause(ROUND_S, self._running.values())
        for each in self._running.values():
            self._see_to(each, passed_s)
        if self._starting:
            return
        missing = [name for name, each in self._running.items() if each.process is None]
        self._notifier.tell(ALIVE, status=f"waiting to restart {', '.join(missing)}" if missing else "running")

    def _pause(self, most_s: float, of: Iterable[Supervised]) -> float:
        """Wait for news, or until one of these is to be started again; how long ago the last such wait was over."""
        now_s = time.monotonic()
        waiting = [each.again_s - now_s for each in of if each.process is None]
        self._poll.poll(1000 * max(min([most_s, *waiting]), 0.0))
        with suppress(BlockingIOError):
            os.read(self._wake, 4096)
        last_s, self._round_s = self._round_s, time.monotonic()
        return min(self._round_s - last_s, ROUND_S)  # where the whole machine stood still, nobody has hung

    def _see_to(self, each: Supervised, passed_s: float) -> None:
        """Raises SourceError for one that cannot start."""
        has_ended = each.listen(passed_s)
        if each.process is None:
            if time.monotonic() >= each.again_s and (self._ending or not self.stopping):
                self._start_again(each)
        elif has_ended:
            self._bury(each)
        else:
            self._judge(each)

    def _start_again(self, each: Supervised) -> None:
        try:
            each.start(self._commands[each.member.name]())
        except SourceError as error:
            self._put_off(each, str(error))

    def _judge(self, each: Supervised) -> None:
        """Kill one that hangs."""
        ear, name = each.ear, each.member.name
        limit_s = HUNG_S if ear.is_ready else START_S
        if ear.silent_s <= limit_s:
            return
        if not each.was_ready:
            raise SourceError(f"the {name} process is not ready after {START_S:g} s")
        LOG.error("the %s process has not beaten for %g s, and is killed", name, limit_s)
        each.kill()

    def _bury(self, each: Supervised) -> None:
        """It has ended: is that the end of the run, or when is it to be started again?

        Raises SourceError where it never was ready: it would be the same again.
        """
        code = self._close(each)
        is_mistake = code == USAGE and PLATFORM.name not in self.outcome.restarts  # one that has run does not end all
        if each.member is PLATFORM and (code in DONE or self._is_over() or is_mistake):
            self._over = True
        elif not each.was_ready:
            raise NotStarted(f"the {each.member.name} process could not start, {ending(code)}", code)
        else:
            self._put_off(each, f"the {each.member.name} process has ended, {ending(code)}")

    def _put_off(self, each: Supervised, why: str) -> None:
        name = each.member.name
        self.outcome.restarts[name] = self.outcome.restarts.get(name, 0) + 1
        LOG.warning("%s; started again in %g s", why, each.put_off(SOON_S if self._ending else math.inf))

    def _close(self, each: Supervised) -> int:
        code, text = each.bury()
        if text is not None:
            said = self.outcome.said.setdefault(each.member.name, [])
            said.append(text)
            del said[:-MOST_SAID]
        if each.member is PLATFORM:
            self.outcome.code = code
        return code

    # --- ending

    def _end(self) -> None:
        self._notifier.tell(STOPPING, status="ending")
        self._ending = True
        try:
            for member in ENDED:
                each = self._running.get(member.name)
                if each is not None and each.process is not None:
                    self._end_of(each)
        finally:
            for each in self._running.values():
                if each.process is not None:
                    each.process.kill()
                    self._close(each)
                each.ear.close()
            os.close(self._wake)
            os.close(self._woken)

    def _end_of(self, each: Supervised) -> None:
        """Ask it to end, and wait; kill it where it takes too long.

        The server is looked after as long as the controller ends, and started again at once: the log's end goes to it.
        """
        server = self._running.get(SERVER.name) if each.member is PLATFORM else None
        end_s = each.ask_to_end()
        if server is not None and server.process is None:
            self._start_again(server)
        while each.process is not None:
            self._notifier.tell(ALIVE)
            left_s = max(end_s - time.monotonic(), 0.0)
            passed_s = self._pause(min(left_s, ROUND_S), () if server is None else (server,))
            for other in self._running.values():
                if other is server:
                    self._see_to(other, passed_s)
                elif other.listen(passed_s):
                    self._close(other)
            if each.process is not None and time.monotonic() >= end_s:
                LOG.error("the %s process does not end, and is killed", each.member.name)
                each.process.kill()
                self._close(each)
