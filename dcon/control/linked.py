"""The control loop's ends where it is one process of several: the front's pair, and the sockets of the run folder.

Every call returns at once; what is not taken is counted.
"""

from __future__ import annotations

import logging
import random
import socket
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from dcon.control import hanging
from dcon.control.hanging import Silences, hung, look
from dcon.control.heard import Heard, counted, hear, is_there, surroundings, watchdog_of
from dcon.control.ports import Ends, Told
from dcon.core.values import Order
from dcon.limiter import MW_PER_V
from dcon.link import paths
from dcon.link.beats import LoopName
from dcon.link.bundle import Entry
from dcon.link.children import Children
from dcon.link.command import CommandOut, encode
from dcon.link.counts import FrontCounts
from dcon.link.crossing import Item, decode
from dcon.link.failure import Failure
from dcon.link.paths import Sender
from dcon.link.pulse import Pulse
from dcon.link.shipper import Ring, Shipper
from dcon.link.shipping import Shipping
from dcon.session.codec import Watchdog
from dcon.session.encode import watchdog_entry
from dcon.session.head import Head
from dcon.settings import Settings
from pmutools.clock import Clock
from pmutools.errors import SourceError
from pmutools.net.sockets import raise_sndbuf
from pmutools.timebase import NS

LOG = logging.getLogger(__name__)
PAIR_BYTES = 4 << 20
"""Asked for in the pair: seconds of eight PMUs."""
MESSAGES_A_TICK = 64
"""Of the front, before a deadline and after it; what is left waits in the pair."""
ITEMS_A_TICK = 2048
"""Of these messages' frames and news, and one message more."""
LARGEST_BYTES = 1 << 18
NEWS_A_TICK = 64
LAST_S = 5.0
"""How long, at the end, the server is given to store what it does not have yet."""
HEALTHY_S = 10.0
"""How long, at the start, the watchdog is waited for."""
ROUND_NS = 16_666_667
BEAT_NS = 10_000_000
"""A tick is longer: each beats, but for those that are made up for."""
NEWS_BYTES = 1 << 16


class PairFrames:
    """What the front found since the last tick."""

    def __init__(self, sock: socket.socket, clock: Clock) -> None:
        sock.setblocking(False)
        self._sock, self._clock = sock, clock
        self.counts = FrontCounts()
        self._early: list[Item] = []

    def wait(self, deadline_ns: int) -> None:
        self._clock.sleep_until(deadline_ns)

    def take(self) -> Sequence[Item]:
        items, self._early = self._early, []
        items += self._drained()
        return items

    def keep(self) -> None:
        """Take what is there now, for the first tick. Raises PmuError where the front could not start."""
        for item in self._drained():
            if isinstance(item, Failure):
                raise item.error
            self._early.append(item)

    def _drained(self) -> Iterable[Item]:
        taken = 0
        for _ in range(MESSAGES_A_TICK):
            if taken >= ITEMS_A_TICK:
                return
            try:
                message = self._sock.recv(LARGEST_BYTES)
            except OSError:
                return
            if not message:  # the front has ended: the kernel says so to its parent too
                return
            for item in decode(message):
                taken += 1
                if isinstance(item, FrontCounts):
                    self.counts = item
                else:
                    yield item

    def close(self) -> None:
        self._sock.close()


class WatchdogCommand:
    """The command, and with it the control loop's sign of life, to the watchdog."""

    def __init__(self, sender: Sender, clock: Clock) -> None:
        self._sender, self._clock = sender, clock
        self._pulse = Pulse(LoopName.CONTROL, sender, BEAT_NS)
        self._sequence = 0
        self.failed = 0
        self.sent_ns = 0
        """When the last command left, monotonic."""

    def send(self, time_ns: int, output_v: float, flags: int = 0) -> None:
        self.sent_ns = self._clock.monotonic_ns()
        datagram = encode(CommandOut(self._sequence, time_ns, output_v * MW_PER_V, output_v, flags))
        self._sequence += 1
        self.failed += not self._sender.send(datagram)
        self._pulse.beat(self.sent_ns)

    def close(self) -> None:
        self._sender.close()


class RunNews:
    """``control.in``, and whether the processes that this one has started are there still, and beat."""

    def __init__(self, sock: socket.socket, children: Children, command: WatchdogCommand, heard: Heard) -> None:
        self._sock, self._children, self._command = sock, children, command
        self._orders: list[Order] = []
        self._silences = Silences(heard.started_ns)
        self.heard = heard

    def listen(self, now_ns: int) -> None:
        """Take what there is."""
        for _ in range(NEWS_A_TICK):
            try:
                datagram = self._sock.recv(NEWS_BYTES)
            except OSError:
                return
            self.heard, order = hear(self.heard, datagram, now_ns)
            if order is not None:
                self._orders.append(order)

    def told(self, now_ns: int) -> Told:
        self.listen(now_ns)
        orders, self._orders = tuple(self._orders), []
        around = surroundings(self.heard, now_ns, self._command.sent_ns)
        self._silences = look(self._silences, self.heard, now_ns)
        return Told(orders, around, self.trouble() or hung(self._silences, hanging.HUNG_NS))

    def trouble(self) -> str:
        """Why a child has ended, in its own words where it had some; "" while all are there."""
        return self._children.trouble() if self.heard.failed is None else self.heard.failed.reason

    @property
    def counts(self) -> Mapping[str, int]:
        return counted(self.heard)

    def close(self) -> None:
        self._children.close()
        paths.release(self._sock)  # the last: who finds it free finds the children's ports free too


class ShippedLog:
    """The session log, by way of the server. It has the watchdog's state too: each second, and when it changes."""

    parts: tuple[str, ...] = ()

    def __init__(self, head: Head, settings: Settings, server: Path, news: RunNews, clock: Clock) -> None:
        self.session = random.getrandbits(32)  # tells it from the one before, to a server that was there
        limits = settings.log
        ring = Ring(round(limits.backfill_s * 1e9), round(limits.backfill_mb * 1e6))
        self._shipping = Shipping(server, Shipper(self.session, head.pieces(self.session), ring))
        self._news, self._clock = news, clock
        self._shown: Watchdog | None = None

    def config(self, name: str, frame: bytes, time_ns: int) -> None:
        self._shipping.shipper.config(name, frame, time_ns, self._clock.monotonic_ns())

    def write(self, entries: Sequence[Entry], tick_ns: int) -> None:
        now_ns = self._clock.monotonic_ns()
        watchdog = watchdog_of(self._news.heard, tick_ns, now_ns)
        if watchdog is not None and self._is_due(watchdog):
            entries = (*entries, watchdog_entry(watchdog))
            self._shown = watchdog
        self._shipping.shipper.tick(tick_ns, entries, now_ns)
        self._shipping.service(now_ns)

    def _is_due(self, watchdog: Watchdog) -> bool:
        shown = self._shown
        if shown is None or watchdog.time_ns - shown.time_ns >= NS:
            return True
        return (
            watchdog._replace(time_ns=shown.time_ns, heartbeats=shown.heartbeats) != shown
        )  # ages change all the time

    @property
    def unlogged_ticks(self) -> int:
        """Those that the server does not have, and cannot get any more."""
        return self._shipping.shipper.ring.unsafe_ticks

    def close(self) -> None:
        shipper = self._shipping.shipper
        shipper.end(self._clock.monotonic_ns())
        end_s = time.monotonic() + (LAST_S if shipper.sent else 0.0)  # of a server that was never there nothing comes
        while len(shipper.ring) and time.monotonic() < end_s:
            self._shipping.service(self._clock.monotonic_ns())
            time.sleep(0.01)
        self._shipping.close()


class Linked:
    """Starts the front and the aides, and joins the control loop to them and to the run folder."""

    def __init__(self, settings: Settings, ini: Path, folder: Path, clock: Clock) -> None:
        """Raises SourceError where another control process lives in the folder."""
        self._clock = clock
        inbox = paths.bind_datagram(folder, paths.CONTROL)
        command = self._command = WatchdogCommand(Sender(folder / paths.WATCHDOG), clock)
        self._children = Children()
        ours, theirs = pair()
        self._frames = PairFrames(ours, clock)
        heard = Heard(clock.monotonic_ns(), round(settings.watchdog.status_timeout_ms * 1e6))
        self._news = RunNews(inbox, self._children, command, heard)
        self.ends = Ends(
            self._frames,
            lambda head: ShippedLog(head, settings, folder / paths.SERVER, self._news, clock),
            command,
            self._news,
            self._wait,
        )
        here = ("--ini", str(ini), "--run-dir", str(folder))
        try:
            with theirs:
                front = ("-m", "dcon.front", *here, "--fd", str(theirs.fileno()))
                self._children.start("front", front, (theirs.fileno(),))
            self._children.start("aides", ("-m", "dcon.aides", *here))
        except BaseException:
            self.ends.close()
            raise

    def _wait(self, stopping: Callable[[], bool]) -> None:
        """Drive 0 V and beat until the watchdog finds everybody well, so that the first tick finds it healthy.

        One that has tripped waits for an operator, and so would this; where it takes too long the session begins
        without, and shows it. Raises PmuError where the front or the aides cannot start.
        """
        clock = self._clock
        now_ns = clock.monotonic_ns()
        end_ns = now_ns + round(HEALTHY_S * 1e9)
        while not stopping():
            self._command.send(clock.realtime_ns(), 0.0)
            self._frames.keep()
            self._news.listen(now_ns)
            if trouble := self._news.trouble():
                self._frames.keep()  # the front's last words
                self._news.listen(now_ns)
                raise SourceError(trouble) if (failed := self._news.heard.failed) is None else failed.error
            if is_there(self._news.heard, now_ns):
                return
            if now_ns >= end_ns:
                LOG.warning("the watchdog is not healthy after %g s; it says why", HEALTHY_S)
                return
            clock.sleep_until(now_ns + ROUND_NS)
            now_ns = clock.monotonic_ns()


def pair(nbytes: int = PAIR_BYTES) -> tuple[socket.socket, socket.socket]:
    """(control's end, front's end): sequenced packets, with room for seconds."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    raise_sndbuf(theirs, nbytes)
    return ours, theirs
