"""Control of a running player: one JSON object a line, or a bare verb; sans-I/O.

::

    < {"hello": "pmutools player", "protocol": 1}
    > {"id": 1, "do": "seek 12.5"}
    < {"id": 1, "ok": true}
    > fault N9 loss=5%
    < {"ok": false, "error": "fault N9: no such stream; there are N1, S1"}
    > {"do": "watch", "every_s": 1}
    < {"ok": true}
    < {"event": "status", "result": {"state": "playing", ...}}

The player's loop has a millisecond to spare, so a session works in steps: a step obeys one request, or writes some
streams of a long answer. Whoever drives it decides how many steps there are. Nothing that a client sends raises.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Protocol

from pmutools.errors import PmuError
from pmutools.impair.profile import Action, parse_action
from pmutools.impair.verbs import PLAYER, SPEEDS
from pmutools.parsers import number, suggestion
from pmutools.timebase import NS
from pmutools.tools.player.status import PlayerStatus

PROTOCOL = 1
LINE_BYTES = 64 << 10
"""A longer line is refused, and skipped to its end."""
DO_CHARACTERS = 4096
"""The longest thing to do: what it takes to parse one is bounded by it."""
PORTION = 16
"""Streams that a step of a long answer writes: some 0.2 ms."""
PATIENCE = 20
"""Lines in a row that say nothing, before the client is sent away."""
FLOOD_REQUESTS = 1000
FLOOD_NS = 10 * NS
"""More than :data:`FLOOD_REQUESTS` lines in this time, and the client is sent away."""
EVERY_S = (0.1, 3600.0)
"""Limits of ``every_s``."""


class Controlled(Protocol):
    """What can be controlled: a player."""

    def act(self, action: Action) -> None:
        """Do it; raises SettingsError, one line with the remedy, where it cannot be done."""

    def status(self) -> PlayerStatus:
        """What is being done now. Of its ``streams`` only the length and slices are asked for."""


# --- verbs -------------------------------------------------------------------------------------------------------


class Order(NamedTuple):
    """One thing to do: how it is written, and what it means."""

    usage: str
    meaning: str
    check: Callable[[str], object] | None = None
    """What reads the arguments (raises ValueError) of a verb of the protocol itself; all others are the player's."""

    @property
    def internal(self) -> bool:
        """Whether it is the protocol's own, and never reaches the player."""
        return self.check is not None

    @property
    def name(self) -> str:
        return self.usage.split()[0]


def parse_every(text: str) -> int:
    """Seconds between two states of ``watch``, in ns."""
    return round(number(*EVERY_S)(text) * NS) if text else NS


def _nothing(text: str) -> None:
    if text:
        raise ValueError(f"takes no argument; leave out {text!r}")


VERBS = (
    Order(PLAYER["pause"].usage, "Stop the source's time where it is, for so long or until `resume`."),
    Order(PLAYER["resume"].usage, "Go on from there."),
    Order(PLAYER["step"].usage, "While paused: the next frame instant of all streams, or so many."),
    Order(PLAYER["seek"].usage, "Go on there: seconds into the source, or UTC."),
    Order(PLAYER["speed"].usage, "Source seconds per second, {:g} to {:g}.".format(*SPEEDS)),
    Order(PLAYER["loop"].usage, "Play from one time to the other over and over; `off` ends it."),
    Order("enable NAME", "Let these streams (a name, an IDCODE, a pattern) speak."),
    Order("disable NAME", "Silence these streams until they are enabled."),
    Order("fault NAME OPTION=VALUE", "Set a fault of these streams, as in a profile; `none` ends it."),
    Order("stats", "What the player is doing: the answer's `result`.", _nothing),
    Order("watch [SECONDS]", "Send that every so often (or `every_s`) from now on, 1 s if not said.", parse_every),
    Order("unwatch", "No longer.", _nothing),
    Order("help", "These verbs.", _nothing),
)
BY_NAME = {order.name: order for order in VERBS}


def parse_control(text: str) -> Action:
    """Something to do, its arguments checked; raises ValueError that says what to write."""
    if len(text) > DO_CHARACTERS:
        raise ValueError(f"{len(text)} characters are too many for one thing to do; {DO_CHARACTERS} at most")
    name, _, argument = text.strip().partition(" ")
    verb = BY_NAME.get(name.lower())
    if verb is None:
        raise ValueError(f"{name[:32]!r} is nothing to do; {suggestion(name.lower()[:32], BY_NAME)}")
    if verb.check is None:
        return parse_action(text)
    try:
        verb.check(argument.strip())
    except ValueError as error:
        raise ValueError(f"{verb.usage}: {error}") from None
    return Action(verb.name, argument=argument.strip())


# --- the status as JSON, in portions -----------------------------------------------------------------------------


def to_json(value: object) -> str:
    """One line of JSON; what is not finite is null."""
    try:
        return json.dumps(value, allow_nan=False)
    except ValueError:
        return json.dumps(_finite(value))


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    return [_finite(item) for item in value] if isinstance(value, list | tuple) else value


def _portions(opening: str, status: PlayerStatus) -> Iterator[bytes]:
    """One line with the whole status, some streams at a time."""
    yield f'{opening}"result": {to_json(status.to_json())[:-1]}, "streams": ['.encode()
    for at in range(0, len(status.streams), PORTION):
        streams = ", ".join(to_json(stream.to_json()) for stream in status.streams[at : at + PORTION])
        yield f"{', ' if at else ''}{streams}".encode()
    yield b"]}}\n"


# --- a session ---------------------------------------------------------------------------------------------------


class Request(NamedTuple):
    """A line that was understood: what to do, and the parts of an answer that repeat the question."""

    action: Action
    known: dict[str, Any]


class BadRequest(ValueError):
    """A line that was not, with what is known of it for the answer."""

    def __init__(self, why: object, known: dict[str, Any] | None = None) -> None:
        super().__init__(str(why))
        self.known = known or {}


def parse_request(line: bytes) -> Request | None:
    """A line taken apart; None for an empty one. Raises BadRequest."""
    try:
        text = line.decode("utf-8").strip()
    except UnicodeDecodeError as error:
        raise BadRequest(f"byte {error.start} of the line is not UTF-8; send UTF-8") from None
    if not text:
        return None
    if not text.startswith(("{", "[", '"')):
        return _request(text, {})
    try:
        said = json.loads(text, parse_constant=_no_number)
    except RecursionError:
        raise BadRequest("nested too deeply; a request is one flat object") from None
    except ValueError as error:
        raise BadRequest(f"no JSON ({error}); write {_EXAMPLE}, or a bare verb") from None
    if not isinstance(said, dict):
        raise BadRequest(f"no JSON object; write {_EXAMPLE}, or a bare verb")
    known = {}
    if "id" in said:
        if not isinstance(said["id"], str | int) or len(repr(said["id"])) > _ID_CHARACTERS:
            raise BadRequest("an id is a whole number or a short text")
        known["id"] = said["id"]
    do = said.get("do")
    if not isinstance(do, str) or not do.strip():
        raise BadRequest(f"what to do is missing; write {_EXAMPLE}", known)
    allowed = ("id", "do", "every_s") if do.strip().lower() == "watch" else ("id", "do")
    for key in said:
        if key not in allowed:
            raise BadRequest(f"unknown key {key[:32]!r}; {suggestion(key[:32], allowed)}", known)
    if "every_s" in said:
        every = said["every_s"]
        if isinstance(every, bool) or not isinstance(every, int | float):
            raise BadRequest("every_s is a number of seconds", known)
        do = f"{do.strip()} {float(every) if abs(every) < 1e9 else 1e9!r}"
    return _request(do, known)


_EXAMPLE = '{"do": "pause"}'
_ID_CHARACTERS = 80


def _no_number(text: str) -> None:
    raise ValueError(f"{text} is not a number")


def _request(do: str, known: dict[str, Any]) -> Request:
    try:
        return Request(parse_control(do), known)
    except ValueError as error:
        raise BadRequest(error, known) from None


class ControlSession:
    """One client's side of the talk: bytes in by :meth:`feed`, bytes out by :meth:`step`.

    ``heard`` is told each thing that was done. Its memory is a line of input and a portion of output; what is fed
    while it is not :attr:`hungry` adds to that.
    """

    def __init__(self, player: Controlled, heard: Callable[[str], None] = lambda text: None) -> None:
        self._player = player
        self._heard = heard
        self._input = bytearray()
        self._searched = 0
        self._skipping = False
        self._portions: Iterator[bytes] | None = None
        self._every_ns: int | None = None
        self._garbage = 0
        self._times = deque[int](maxlen=FLOOD_REQUESTS)
        self.due_ns: int | None = None
        """When ``watch`` next has something to send."""
        self.over: str = ""
        """Why the client is sent away; nothing happens any more once this is set."""

    @staticmethod
    def greeting() -> bytes:
        return f"{to_json({'hello': 'pmutools player', 'protocol': PROTOCOL})}\n".encode()

    @staticmethod
    def farewell(reason: str) -> bytes:
        """The last line that a client gets."""
        return f"{to_json({'event': 'bye', 'reason': reason})}\n".encode()

    @property
    def busy(self) -> bool:
        """Whether a step has something to do now, ``watch`` apart."""
        return not self.over and (self._portions is not None or self._line_end() >= 0 or self._too_long)

    @property
    def speaking(self) -> bool:
        """Whether a long answer is on its way."""
        return self._portions is not None

    @property
    def hungry(self) -> bool:
        """Whether more input is of use."""
        return not self.over and not self.busy

    @property
    def _too_long(self) -> bool:
        return not self._skipping and len(self._input) > LINE_BYTES

    def _line_end(self) -> int:
        end = self._input.find(b"\n", self._searched)
        self._searched = len(self._input) if end < 0 else end
        return end

    def feed(self, data: bytes) -> None:
        """Bytes from the client, in pieces of any size."""
        self._input += data
        if self._skipping:
            end = self._line_end()
            del self._input[: end + 1 if end >= 0 else len(self._input)]
            self._searched, self._skipping = 0, end < 0

    def end(self) -> None:
        """The client sends no more; what it sent last counts as a line."""
        if self._input:
            self.feed(b"\n")

    def step(self, now_ns: int) -> bytes:
        """Do one bounded piece of work; returns what it has to say, which may be nothing. ``now_ns`` is monotonic."""
        if self.over:
            return b""
        if self._portions is not None:
            if (portion := next(self._portions, None)) is not None:
                return portion
            self._portions = None
        if (line := self._next_line()) is not None:
            return self._hear(line, now_ns)
        if self.due_ns is not None and self._every_ns is not None and now_ns >= self.due_ns:
            late = now_ns - self.due_ns >= self._every_ns  # a slow client gets fewer, not all at once
            self.due_ns = (now_ns if late else self.due_ns) + self._every_ns
            return self._tell_status('{"event": "status", ')
        return b""

    def _next_line(self) -> bytes | None:
        end = self._line_end()
        if end > LINE_BYTES or (end < 0 and self._too_long):  # refused at once, not when its end has come
            self._skipping = end < 0
            del self._input[: end + 1 if end >= 0 else len(self._input)]
            self._searched = 0
            return _TOO_LONG
        if end < 0:
            return None
        line = bytes(self._input[:end])
        del self._input[: end + 1]
        self._searched = 0
        return line

    def _hear(self, line: bytes, now_ns: int) -> bytes:
        if len(self._times) == FLOOD_REQUESTS and now_ns - self._times[0] < FLOOD_NS:
            return self._send_away(f"more than {FLOOD_REQUESTS} lines in {FLOOD_NS // NS} s; ask less often")
        self._times.append(now_ns)
        if b" HTTP/1." in line[:LINE_BYTES]:  # from a browser, whose page must not control anything
            return self._send_away("this is no web server")
        try:
            if line is _TOO_LONG:
                raise BadRequest(f"a line of more than {LINE_BYTES} bytes; send shorter ones")
            request = parse_request(line)
        except BadRequest as error:
            self._garbage += 1
            if self._garbage >= PATIENCE:
                return self._send_away(f"{PATIENCE} lines in a row said nothing; the last: {error}")
            return _reply(error.known, error=str(error))
        self._garbage = 0
        return self._obey(request, now_ns) if request is not None else b""

    def _obey(self, request: Request, now_ns: int) -> bytes:
        action, known = request
        match action.verb:
            case "stats":
                return self._tell_status(to_json(known | {"ok": True})[:-1] + ", ")
            case "watch":
                self._every_ns = parse_every(action.argument)
                self.due_ns = now_ns
            case "unwatch":
                self._every_ns = self.due_ns = None
            case "help":
                return _reply(known, result={verb.usage: verb.meaning for verb in VERBS})
            case _:
                try:
                    self._player.act(action)
                except (PmuError, ValueError) as error:
                    return _reply(known, error=str(error))
                self._heard(_described(action))
        return _reply(known)

    def _tell_status(self, opening: str) -> bytes:
        self._portions = _portions(opening, self._player.status())
        return next(self._portions)

    def _send_away(self, reason: str) -> bytes:
        self.over = reason
        return self.farewell(reason)


_TOO_LONG = b"too long"


def _reply(known: dict[str, Any], *, error: str = "", result: object = None) -> bytes:
    said: dict[str, Any] = known | {"ok": not error}
    if error:
        said["error"] = " ".join(error.split())
    if result is not None:
        said["result"] = result
    return f"{to_json(said)}\n".encode()


def _described(action: Action) -> str:
    """An action in short, for those who look on."""
    if action.rule is None:
        return f"{action.verb} {action.argument}".rstrip()
    options = " ".join(option for option, _ in action.rule.settings)
    return f"{action.verb} {', '.join(action.rule.patterns)} {options}".rstrip()
