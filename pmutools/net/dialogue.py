"""A client role with its timer, told as news: what a stream's state is, whenever that changes."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import NamedTuple

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import FrameType
from pmutools.c37118.demux import Message
from pmutools.c37118.session import ClientAction, ClientEvent, ClientRole, ClientState
from pmutools.flow import Flow
from pmutools.net.reactor import Reactor, Timer


class LinkKind(StrEnum):
    """What can be told of an endpoint or one of its streams."""

    BOUND = "bound"
    CONNECTED = "connected"
    CONFIGURED = "configured"
    """A configuration came that differs from the one before."""
    STREAMING = "streaming"
    SILENT = "silent"
    """Data have stopped coming."""
    NO_CONFIG = "no-config"
    """Data come, and no configuration fits them; they are held."""
    LOST = "lost"
    """The connection has ended; it is tried again after a while."""
    FAILED = "failed"
    """No connection could be made; it is tried again after a while."""
    UNANSWERED = "unanswered"
    """Connected, but requests stay without an answer."""
    NOTHING = "nothing"
    """Some seconds after the start, nothing at all has come."""
    FOREIGN = "foreign"
    """Frames come that no endpoint asks for: another IDCODE, or another sender."""
    DUPLICATE = "duplicate"
    """Two senders send one IDCODE to one port."""
    NOISE = "noise"
    """What comes to a port is no C37.118."""
    OWN_DROPS = "own-drops"
    """This machine's receive buffer was full: ``datagrams`` are lost, and not by the network."""


AGEING_NS = 120_000_000_000, 600_000_000_000
"""A switch that snoops IGMP forgets a group some four minutes after the last report that it has seen."""


def silence(multicast: bool, open_ns: int) -> str:
    """What a silence may come from that began when a stream had been listened to for ``open_ns``."""
    if not multicast or not AGEING_NS[0] <= open_ns <= AGEING_NS[1]:
        return ""
    return (
        f"{open_ns // 60_000_000_000} minutes after the group was joined; if other groups stop too, a switch has "
        "forgotten who listens: there must be an IGMP querier in this network"
    )


class LinkEvent(NamedTuple):
    """News of the endpoints ``owners`` (their places in the list given). ``detail`` is for people.

    ``label`` is what people are told instead of ``where``, if anything: their own words for it.
    """

    kind: LinkKind
    where: str
    owners: tuple[int, ...]
    detail: str = ""
    idcode: int | None = None
    flow: Flow | None = None
    datagrams: int = 0
    label: str = ""


def own_drops(where: str, owners: tuple[int, ...], datagrams: int) -> LinkEvent:
    """That the receive buffer of ``where`` was full."""
    return LinkEvent(LinkKind.OWN_DROPS, where, owners, "this machine's receive buffer was full", datagrams=datagrams)


class Dialogue:
    """Plays a :class:`ClientRole`: feeds it what is heard and the passing of time, hands its actions to ``act``.

    ``tell`` takes (kind, detail) of each change of state.
    """

    def __init__(
        self,
        role: ClientRole,
        reactor: Reactor,
        tell: Callable[[LinkKind, str], None],
        act: Callable[[ClientAction, ClientState], None] | None = None,
    ) -> None:
        self.role = role
        self._reactor = reactor
        self._tell = tell
        self._act = act
        self._timer: Timer | None = None
        self._known: StreamConfig | None = None

    def step(self, event: ClientEvent) -> None:
        before = self.role.state
        self._after(before, self.role.handle(event, self._reactor.clock.monotonic_ns()))

    def hear(self, message: Message, now_ns: int) -> None:
        """Take note of a message of this stream; ``now_ns`` is monotonic."""
        frame, _, config = message
        role, before = self.role, self.role.state
        kind = frame.data[1] >> 4
        if kind == FrameType.DATA and config is not None:
            actions = role.hear_data(frame.data, config, now_ns)
            if actions or role.state is not before:
                self._after(before, actions)
        elif config is not None and frame.type.rules_data:
            if config != self._known:
                self._known = config
                self._tell(LinkKind.CONFIGURED, f"{config.kind.name}, {_rate(config)}, {len(config.stations)} stations")
            self._after(before, role.hear_config(config, now_ns))

    def hear_alike(self, config: StreamConfig, now_ns: int) -> None:
        """Take note of data frames of this stream in which STAT announces what it did (``role.announced``)."""
        role, before = self.role, self.role.state
        actions = role.hear_alike(config, now_ns)
        if actions or role.state is not before:
            self._after(before, actions)

    def hear_misfit(self, now_ns: int) -> None:
        """A data frame came that no known configuration fits."""
        before = self.role.state
        self._after(before, self.role.hear_misfit(now_ns))

    def close(self) -> None:
        if self._timer is not None:
            self._timer.cancelled = True
            self._timer = None

    def _after(self, before: ClientState, actions: tuple[ClientAction, ...]) -> None:
        state = self.role.state
        if state is ClientState.STREAMING and before is not state:
            self._tell(LinkKind.STREAMING, "")
        elif before is ClientState.STREAMING and state is ClientState.WAIT_DATA:
            self._tell(LinkKind.SILENT, "")
        if self._act is not None:
            for action in actions:
                self._act(action, before)
        self._arm()

    def _arm(self) -> None:
        """Have the timer ring when the role's next time-out is due; one that rings too early does no harm."""
        deadline_ns = self.role.deadline_ns
        if deadline_ns is None or (self._timer is not None and self._timer.deadline_ns <= deadline_ns):
            return
        self.close()
        self._timer = self._reactor.call_at(deadline_ns, self._ring)

    def _ring(self) -> None:
        self._timer = None
        before = self.role.state
        self._after(before, self.role.check_time(self._reactor.clock.monotonic_ns()))


def _rate(config: StreamConfig) -> str:
    rate = config.rate
    return f"{rate} frames/s" if rate.denominator == 1 else f"a frame every {1 / rate} s"
