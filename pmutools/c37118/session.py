"""Who says what when, without a socket: the client (PDC, reader) and the server (PMU, PDC) side of a conversation.

Rules of this file: a state machine is a table ``(state, event) -> Step(next state, actions)``; a pair that is not in
the table changes nothing. Time is an argument. Actions are carried out by whoever owns the transport. The standard
has no errors and no acknowledgements (clause 6.6): what a server does not know or cannot give, it answers by silence,
so a client lives on time-outs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from pmutools.c37118.config import StreamConfig, encode_config, frames_in
from pmutools.c37118.config_kinds import as_kind
from pmutools.c37118.constants import Command, FrameType
from pmutools.c37118.frames import decode_command, encode_command, encode_header, restamp
from pmutools.errors import EncodeError, WireError
from pmutools.timebase import NS, from_ns

# --- client ------------------------------------------------------------------------------------------------------


class ClientState(StrEnum):
    """Where a client stands with one stream."""

    IDLE = "idle"
    """No transport."""
    WAIT_CFG3 = "wait-cfg3"
    WAIT_CFG2 = "wait-cfg2"
    """A configuration is awaited: asked for, or, from a spontaneous stream, of whatever kind comes."""
    WAIT_DATA = "wait-data"
    STREAMING = "streaming"


class ClientEvent(StrEnum):
    """What a client can meet."""

    OPENED = "opened"
    CLOSED = "closed"
    CONFIG = "config"
    DATA = "data"
    """A data frame that the configuration in force fits."""
    CHANGED = "changed"
    """The configuration is, or will be, another: STAT bit 10 rose or fell, or frames of another size come."""
    TIMEOUT = "timeout"
    EXHAUSTED = "exhausted"
    """As many time-outs in a row as :attr:`Timing.tries`."""
    STOP = "stop"
    """The user has had enough; the owner closes the transport."""


class ClientAction(StrEnum):
    """What the client's owner is to do."""

    REQUEST_CFG3 = "request-cfg3"
    REQUEST_CFG2 = "request-cfg2"
    SEND_START = "send-start"
    SEND_STOP = "send-stop"
    FALL_BACK = "fall-back"
    """This server does not know CFG-3: do not ask for it again."""
    DISCONNECT = "disconnect"
    """Give the transport up; come back after :func:`backoff_ns`."""


class Step(NamedTuple):
    """What a table answers: the next state, and what to do, in order."""

    state: ClientState
    actions: tuple[ClientAction, ...] = ()


ClientTable = Mapping[tuple[ClientState, ClientEvent], Step]
_S, _E, _A = ClientState, ClientEvent, ClientAction


def _ends(*states: ClientState, goodbye: tuple[ClientAction, ...] = ()) -> dict[tuple[ClientState, ClientEvent], Step]:
    """How each of ``states`` ends: the transport is gone, or the user stops."""
    return {(state, _E.CLOSED): Step(_S.IDLE) for state in states} | {
        (state, _E.STOP): Step(_S.IDLE, goodbye) for state in states
    }


CFG2_FIRST: ClientTable = {
    **_ends(_S.WAIT_CFG2, _S.WAIT_DATA, _S.STREAMING, goodbye=(_A.SEND_STOP,)),
    (_S.IDLE, _E.OPENED): Step(_S.WAIT_CFG2, (_A.REQUEST_CFG2,)),
    (_S.WAIT_CFG2, _E.CONFIG): Step(_S.WAIT_DATA, (_A.SEND_START,)),
    (_S.WAIT_CFG2, _E.TIMEOUT): Step(_S.WAIT_CFG2, (_A.REQUEST_CFG2,)),
    (_S.WAIT_CFG2, _E.EXHAUSTED): Step(_S.IDLE, (_A.DISCONNECT,)),
    (_S.WAIT_DATA, _E.DATA): Step(_S.STREAMING),
    (_S.WAIT_DATA, _E.CHANGED): Step(_S.WAIT_CFG2, (_A.REQUEST_CFG2,)),
    (_S.WAIT_DATA, _E.TIMEOUT): Step(_S.WAIT_DATA, (_A.SEND_START,)),
    (_S.WAIT_DATA, _E.EXHAUSTED): Step(_S.IDLE, (_A.DISCONNECT,)),
    (_S.STREAMING, _E.CHANGED): Step(_S.WAIT_CFG2, (_A.REQUEST_CFG2,)),
    (_S.STREAMING, _E.TIMEOUT): Step(_S.WAIT_DATA, (_A.SEND_START,)),
}
"""Commanded: CFG-2, then start."""

CFG3_FIRST: ClientTable = {
    **CFG2_FIRST,
    **_ends(_S.WAIT_CFG3, goodbye=(_A.SEND_STOP,)),
    (_S.IDLE, _E.OPENED): Step(_S.WAIT_CFG3, (_A.REQUEST_CFG3,)),
    (_S.WAIT_CFG3, _E.CONFIG): Step(_S.WAIT_DATA, (_A.SEND_START,)),
    (_S.WAIT_CFG3, _E.TIMEOUT): Step(_S.WAIT_CFG2, (_A.FALL_BACK, _A.REQUEST_CFG2)),
    (_S.WAIT_DATA, _E.CHANGED): Step(_S.WAIT_CFG3, (_A.REQUEST_CFG3,)),
    (_S.STREAMING, _E.CHANGED): Step(_S.WAIT_CFG3, (_A.REQUEST_CFG3,)),
}
"""Commanded: CFG-3, or CFG-2 from a server that stays silent (CFG-3 is optional), then start."""

SAVED_CONFIG: ClientTable = {
    **CFG2_FIRST,
    (_S.IDLE, _E.OPENED): Step(_S.WAIT_DATA, (_A.REQUEST_CFG2, _A.SEND_START)),
}
"""Commanded, with a configuration known beforehand: start without waiting for the server's."""

SPONTANEOUS: ClientTable = {
    **_ends(_S.WAIT_CFG2, _S.WAIT_DATA, _S.STREAMING),
    (_S.IDLE, _E.OPENED): Step(_S.WAIT_CFG2),
    (_S.WAIT_CFG2, _E.CONFIG): Step(_S.WAIT_DATA),
    (_S.WAIT_CFG2, _E.DATA): Step(_S.STREAMING),
    (_S.WAIT_DATA, _E.DATA): Step(_S.STREAMING),
    (_S.STREAMING, _E.TIMEOUT): Step(_S.WAIT_DATA),
}
"""No command channel: the stream brings its configuration, customarily once a minute (annex F)."""

CLIENT_TABLES: Mapping[str, ClientTable] = {
    "cfg3-first": CFG3_FIRST,
    "cfg2-first": CFG2_FIRST,
    "saved-config": SAVED_CONFIG,
    "spontaneous": SPONTANEOUS,
}

REQUESTS: Mapping[ClientAction, Command] = {
    _A.REQUEST_CFG3: Command.SEND_CFG3,
    _A.REQUEST_CFG2: Command.SEND_CFG2,
    _A.SEND_START: Command.START_DATA,
    _A.SEND_STOP: Command.STOP_DATA,
}


def command_for(action: ClientAction, idcode: int, now_ns: int) -> bytes | None:
    """The command frame that an action sends, stamped with UTC ``now_ns``; None if it sends nothing."""
    code = REQUESTS.get(action)
    return None if code is None else encode_command(idcode, code, soc=now_ns // NS)


@dataclass(frozen=True, slots=True)
class Timing:
    """How long a client waits, in ns."""

    answer_ns: int = 3 * NS
    """For a configuration, before it asks again; also the shortest time between two requests that changes provoke."""
    cfg3_ns: int = NS
    """For a CFG-3, before it asks for CFG-2: most devices know none, and stay silent."""
    tries: int = 3
    """Time-outs in a row before the connection is given up."""
    silence_ns: int = 5 * NS
    """For data, before it sends start again; at least :attr:`silence_frames` reporting intervals."""
    silence_frames: int = 3


def backoff_ns(attempt: int, *, first_ns: int = NS // 2, longest_ns: int = 30 * NS) -> int:
    """Wait before connection attempt number ``attempt`` (0 = the first retry): doubles from 0.5 s up to 30 s."""
    return min(first_ns << min(attempt, 32), longest_ns)


class ClientRole:
    """One stream as its client sees it: a state of one of the tables, and the next time-out (monotonic ns).

    Each method takes the time and returns the actions to carry out.
    """

    def __init__(self, table: ClientTable, timing: Timing | None = None) -> None:
        self.table = table
        self.timing = timing or Timing()
        self.state = ClientState.IDLE
        self.deadline_ns: int | None = None
        self.config: StreamConfig | None = None
        self.heard_ns = 0
        """When data last came."""
        self.announced = False
        """Whether a change of the configuration is announced: STAT bit 10 of any station."""
        self._timeouts = 0
        self._asked_ns: int | None = None
        self._unfit: StreamConfig | None = None
        """The CFG-3 that did not fit last."""

    def handle(self, event: ClientEvent, now_ns: int) -> tuple[ClientAction, ...]:
        """Take one step of the table."""
        step = self.table.get((self.state, event))
        if step is None:
            return ()
        self.state, actions = step
        if ClientAction.FALL_BACK in actions:
            self.table = CFG2_FIRST
        if event is not ClientEvent.TIMEOUT:
            self._timeouts = 0
        if any(action in REQUESTS for action in actions):
            self._asked_ns = now_ns
        self.deadline_ns = self._next_deadline_ns(now_ns)
        return actions

    def hear_config(self, config: StreamConfig, now_ns: int) -> tuple[ClientAction, ...]:
        """A configuration for this stream came, asked for or not.

        A CFG-2 that came unasked and says something else than the CFG-3 before it is in force, and makes us ask again.
        """
        before, self.config = self.config, config
        less = before is not None and before.kind is FrameType.CFG3 and config.kind is not FrameType.CFG3
        event = ClientEvent.CHANGED if less and self.state in _RUNNING and self._may_ask(now_ns) else ClientEvent.CONFIG
        return self.handle(event, now_ns)

    def hear_data(self, frame: bytes, config: StreamConfig, now_ns: int) -> tuple[ClientAction, ...]:
        """A data frame came that ``config`` fits."""
        actions = self.hear_alike(config, now_ns)
        announced = False
        for at in config.stat_offsets:  # STAT 0xFFFF is some senders' "undefined"
            if frame[at] & 4 and frame[at : at + 2] != b"\xff\xff":
                announced = True
        if announced is not self.announced and self._may_ask(now_ns):
            self.announced = announced
            actions += self.handle(ClientEvent.CHANGED, now_ns)
        return actions

    def hear_alike(self, config: StreamConfig, now_ns: int) -> tuple[ClientAction, ...]:
        """Data frames came that ``config`` fits, and whose STAT bits 10 announce what :attr:`announced` says."""
        self.config = config
        self.heard_ns = now_ns
        self._timeouts = 0
        return self.handle(ClientEvent.DATA, now_ns) if self.state is not ClientState.STREAMING else ()

    def hear_misfit(self, now_ns: int) -> tuple[ClientAction, ...]:
        """A data frame came that no known configuration fits.

        A server whose CFG-3 does not fit, and is the same when asked for again, is asked for CFG-2 from then on.
        """
        self.heard_ns = now_ns
        if not self._may_ask(now_ns):
            return ()
        if self.config is not None and self.config.kind is FrameType.CFG3:
            if self.table is CFG3_FIRST and self._unfit == self.config:
                self.table = CFG2_FIRST
            self._unfit = self.config
        return self.handle(ClientEvent.CHANGED, now_ns)

    def check_time(self, now_ns: int) -> tuple[ClientAction, ...]:
        """To be called at :attr:`deadline_ns` or later; does nothing before."""
        if self.deadline_ns is None or now_ns < self.deadline_ns:
            return ()
        if self.state is ClientState.STREAMING and now_ns - self.heard_ns < self.silence_ns:
            self.deadline_ns = self.heard_ns + self.silence_ns
            return ()
        self._timeouts += 1
        exhausted = self._timeouts >= self.timing.tries and self.state is not ClientState.STREAMING
        return self.handle(ClientEvent.EXHAUSTED if exhausted else ClientEvent.TIMEOUT, now_ns)

    @property
    def silence_ns(self) -> int:
        """How long this stream may be silent, given its reporting rate."""
        rate = self.config.rate if self.config is not None else 0
        frames_ns = int(self.timing.silence_frames * NS / rate) if rate else 0
        return max(self.timing.silence_ns, frames_ns)

    def _may_ask(self, now_ns: int) -> bool:
        return self._asked_ns is None or now_ns - self._asked_ns >= self.timing.answer_ns

    def _next_deadline_ns(self, now_ns: int) -> int | None:
        if (self.state, ClientEvent.TIMEOUT) not in self.table:
            return None
        waits_for_data = self.state in (ClientState.WAIT_DATA, ClientState.STREAMING)
        if waits_for_data:
            return now_ns + self.silence_ns
        return now_ns + (self.timing.cfg3_ns if self.state is ClientState.WAIT_CFG3 else self.timing.answer_ns)


_RUNNING = (ClientState.WAIT_DATA, ClientState.STREAMING)


# --- server ------------------------------------------------------------------------------------------------------


class SendState(StrEnum):
    """Of one stream towards one client."""

    STOPPED = "stopped"
    STARTED = "started"


class Reply(NamedTuple):
    """What the server's table answers: the stream's state towards this client from now on."""

    state: SendState
    frame: FrameType | None = None
    """What is sent back."""


_ANSWERS = {
    Command.SEND_HEADER: FrameType.HEADER,
    Command.SEND_CFG1: FrameType.CFG1,
    Command.SEND_CFG2: FrameType.CFG2,
    Command.SEND_CFG3: FrameType.CFG3,
}
SERVER: Mapping[tuple[SendState, Command], Reply] = (
    {(state, command): Reply(state, frame) for state in SendState for command, frame in _ANSWERS.items()}
    | {(state, Command.START_DATA): Reply(SendState.STARTED) for state in SendState}
    | {(state, Command.STOP_DATA): Reply(SendState.STOPPED) for state in SendState}
    | {(state, Command.EXTENDED): Reply(state) for state in SendState}
)
"""What a PMU or PDC does with a command (Table 15); a command that is not here is ignored."""


@dataclass(frozen=True)
class Served:
    """A stream on offer: its IDCODE, ticks per second, and the frames it answers with (absent ones: silence)."""

    idcode: int
    time_base: int
    frames: Mapping[FrameType, bytes]
    announced: tuple[FrameType, ...] = (FrameType.CFG2,)
    """The configurations that go with the data where nobody asks; the last one holds for them."""

    def announcements(self, now_ns: int) -> list[bytes]:
        """The configurations to send unasked, stamped with UTC ``now_ns``."""
        told = (self.frame(kind, now_ns) for kind in self.announced)
        return [part for frame in told if frame is not None for part in frames_in(frame)]

    def frame(self, kind: FrameType, now_ns: int) -> bytes | None:
        """The answer of this kind, stamped with its time of transmission (clause 6.2.2), UTC ``now_ns``.

        Of a CFG-3 in several frames all of them, end to end.
        """
        frame = self.frames.get(kind)
        if frame is None:
            return None
        stamp = from_ns(now_ns, self.time_base)
        return b"".join(restamp(part, *stamp) for part in frames_in(frame))


def served(config: StreamConfig, header: str = "") -> Served:
    """What a device that sends ``config``'s data answers: CFG-1, 2 and 3, and a header if there is a text.

    Unasked it sends CFG-2, and CFG-3 after it where the data need that: CFG-2 cannot say all that CFG-3 says. A kind
    that has no room for so many channels is not on offer. Raises EncodeError where ``config`` itself is no frame.
    """
    frames = {config.kind: encode_config(config)}
    for kind in (FrameType.CFG1, FrameType.CFG2, FrameType.CFG3):
        with suppress(EncodeError):
            frames.setdefault(kind, encode_config(config if config.kind is kind else as_kind(config, kind)))
    if header:
        frames[FrameType.HEADER] = encode_header(config.idcode, header)
    announced = (FrameType.CFG2, FrameType.CFG3) if config.kind is FrameType.CFG3 else (FrameType.CFG2,)
    return Served(config.idcode, config.time_base, frames, announced)


class Outcome(StrEnum):
    """What came of a frame that a client sent."""

    STARTED = "started"
    STOPPED = "stopped"
    ANSWERED = "answered"
    UNAVAILABLE = "unavailable"
    """A frame was asked for that this stream does not have."""
    EXTENDED = "extended"
    """User data, for the application; nothing is sent back."""
    UNKNOWN = "unknown-command"
    FOREIGN = "foreign-idcode"
    """No stream of that IDCODE here: silence is what the standard asks for."""
    NO_COMMAND = "no-command"
    """Something else than a command frame."""


class Answer(NamedTuple):
    """What came of a client's frame, and what to send back."""

    outcome: Outcome
    idcode: int
    code: int = 0
    frame: bytes | None = None
    """To be sent to this client."""
    extended: bytes = b""


class ServerRole:
    """One client as the server sees it: which of the offered streams it has started.

    ``streams`` may be replaced from outside (another configuration); it is looked up at each command.
    """

    def __init__(self, streams: Mapping[int, Served]) -> None:
        self.streams = streams
        self.started: set[int] = set()

    def hear(self, frame: bytes, now_ns: int) -> Answer:
        """Judge a verified frame from the client; ``now_ns`` is UTC. Never raises."""
        idcode = frame[4] << 8 | frame[5]
        try:
            command = decode_command(frame)
        except WireError:
            return Answer(Outcome.NO_COMMAND, idcode)
        stream = self.streams.get(idcode)
        if stream is None:
            return Answer(Outcome.FOREIGN, idcode, command.code)
        if command.code not in _COMMANDS:
            return Answer(Outcome.UNKNOWN, idcode, command.code, extended=command.extended)
        code = Command(command.code)
        state, kind = SERVER[SendState.STARTED if idcode in self.started else SendState.STOPPED, code]
        (self.started.add if state is SendState.STARTED else self.started.discard)(idcode)
        if kind is not None:
            reply = stream.frame(kind, now_ns)
            return Answer(Outcome.UNAVAILABLE if reply is None else Outcome.ANSWERED, idcode, code, reply)
        return Answer(_OUTCOMES[code], idcode, code, extended=command.extended)


_COMMANDS = frozenset(Command)
_OUTCOMES = {
    Command.START_DATA: Outcome.STARTED,
    Command.STOP_DATA: Outcome.STOPPED,
    Command.EXTENDED: Outcome.EXTENDED,
}


def transitions(table: ClientTable) -> Iterable[tuple[ClientState, ClientEvent, Step]]:
    """The rows of a client table in the order of the states, for diagrams and tests."""
    order = list(ClientState)
    for (state, event), step in sorted(table.items(), key=lambda row: order.index(row[0][0])):
        yield state, event, step
