"""Where frames come from, what a tick is told, where the command goes and where the log goes.

The control loop knows these four only. In one process they are sockets and a file (:mod:`dcon.control.alone`); with a
run folder they are the sockets of other processes (:mod:`dcon.control.linked`). None of them may wait, but
:meth:`Frames.wait` for its deadline.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple, Protocol

from dcon.core.values import NOTHING, Order, Surroundings
from dcon.link.bundle import Entry
from dcon.link.counts import FrontCounts
from dcon.link.crossing import Item
from dcon.session.head import Head


class Frames(Protocol):
    """Where frames come from."""

    counts: FrontCounts
    """What did not become frames."""

    def wait(self, deadline_ns: int) -> None:
        """Return at ``deadline_ns`` (monotonic); at once where that is past."""

    def take(self) -> Sequence[Item]:
        """What has come by now, in order."""

    def close(self) -> None: ...


class Told(NamedTuple):
    """What a tick is told."""

    orders: tuple[Order, ...] = ()
    surroundings: Surroundings = NOTHING
    trouble: str = ""
    """Why the session must end; "" as long as it need not."""


class News(Protocol):
    """What a tick is told."""

    @property
    def counts(self) -> Mapping[str, int]:
        """What the news count (:data:`dcon.link.counts.COUNTS`)."""

    def listen(self, now_ns: int) -> None:
        """Take in what is there already, for the tick to come."""

    def told(self, now_ns: int) -> Told:
        """News up to now (monotonic); each order once."""

    def close(self) -> None: ...


class Command(Protocol):
    """Where the command goes."""

    failed: int
    """Commands that were not taken."""

    def send(self, time_ns: int, output_v: float, flags: int = 0) -> None:
        """Drive ``output_v`` volts from now on; ``time_ns`` is the tick's UTC."""

    def close(self) -> None: ...


class Log(Protocol):
    """Where the session log goes; errors are counted, never raised."""

    def config(self, name: str, frame: bytes, time_ns: int) -> None:
        """A configuration frame that came at ``time_ns``."""

    def write(self, entries: Sequence[Entry], tick_ns: int) -> None:
        """What the tick at ``tick_ns`` was given and has decided (:func:`~dcon.session.encode.tick_entries`)."""

    def close(self) -> None:
        """All ticks have been logged; the one call that may take its time."""

    session: int
    """What a server knows it by; 0 where there is none."""

    @property
    def unlogged_ticks(self) -> int: ...

    @property
    def parts(self) -> Sequence[object]:
        """Files of the log, where this process knows them."""


class Quiet:
    """Nothing is told."""

    counts: Mapping[str, int] = MappingProxyType({})

    def listen(self, now_ns: int) -> None:
        pass

    def told(self, now_ns: int) -> Told:
        return Told()

    def close(self) -> None:
        pass


class Nowhere:
    """No output: a session that computes and logs."""

    failed = 0

    def send(self, time_ns: int, output_v: float, flags: int = 0) -> None:
        pass

    def close(self) -> None:
        pass


@dataclass
class Ends:
    """All four. They are open once made, so that nothing sent later is missed; the log is begun with the session."""

    frames: Frames
    open_log: Callable[[Head], Log]
    """Raises SourceError where it cannot be begun."""
    command: Command = field(default_factory=Nowhere)
    news: News = field(default_factory=Quiet)
    wait: Callable[[Callable[[], bool]], object] = lambda stopping: None
    """Called before the first tick, with what tells whether the end was asked for: until the others are there."""

    def close(self) -> None:
        for end in (self.command, self.news, self.frames):
            end.close()
