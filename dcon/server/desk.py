"""What operators may ask, and what they are told: the same for a line of a socket and, one day, for a web page.

An ask is a JSON object: ``{"ask": "status"}``, ``{"ask": "watch"}``, or ``{"signed": "<a signed order>"}``. Orders are
handed on as they were signed, for the platform's own link to judge. The server reads the same key file and judges them
too: of ``estop``, ``release`` and ``reset`` it tells the watchdog itself, which takes its word. So whoever takes the
server over has the operators' keys, and can order whatever they may.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

from dcon.link.beats import Verb, encode_word
from dcon.link.orders import LONGEST, SignedOrder, Verifier
from dcon.link.paths import AIDE, WATCHDOG, Sender
from dcon.server.newest import TickSummary
from dcon.server.pending import Answer, Pending
from dcon.server.watchdog_word import TOLD, UNREACHED, Told, WatchdogWord

LOG = logging.getLogger(__name__)
ASKS = ("status", "watch")
VERBS = {"estop": Verb.ESTOP, "release": Verb.ESTOP_RELEASE, "reset": Verb.RESET}
"""Orders that are the watchdog's too: it is told at once, whatever the controller makes of them."""


class Desk:
    """Answers asks. An ask's answer comes at once, or (None) from :meth:`heard`, :meth:`reply` or :meth:`due`."""

    def __init__(self, folder: Path, status: Callable[[], dict[str, Any]], verifier: Verifier) -> None:
        """``verifier`` is asked before the watchdog is told; where it knows no operators, nobody orders anything."""
        self._status = status
        self._verifier = verifier
        self._folder = folder
        self._aide = Sender(folder / AIDE)
        self._watchdog = Sender(folder / WATCHDOG)
        self.reply_to = ""
        """Path of the socket that the platform's link may answer to."""
        self.pending = Pending()
        self.proven: set[Hashable] = set()
        """Askers of whom an order's signature held, until they are forgotten."""
        self.relayed = 0

    def ask(self, asker: Hashable, line: bytes, *, utc_ns: int, now_ns: int) -> dict[str, Any] | None:
        """The answer; None where it will come. ``{"watch": true}`` where the asker wants a status from now on."""
        try:
            said = json.loads(line)
        except (ValueError, RecursionError):
            return _error("no JSON")
        if not isinstance(said, dict):
            return _error("no JSON object")
        match said:
            case {"ask": "status"}:
                return self._status()
            case {"ask": "watch"}:
                return {"watch": True}
            case {"signed": str(text)}:
                return self._signed(asker, text, utc_ns, now_ns)
        return _error(f"ask for one of {', '.join(ASKS)}, or send a signed order")

    def heard(self, news: TickSummary) -> list[Answer]:
        return self.pending.heard(news)

    def reply(self, datagram: bytes) -> list[Answer]:
        """What the platform's link says of an order: ``{"digest", "refused"}``."""
        try:
            said = json.loads(datagram)
        except (ValueError, RecursionError):
            return []
        match said:
            case {"digest": str(name), "refused": str(reason)}:
                return self.pending.refused(name, reason)
        return []

    def due(self, word: WatchdogWord, now_ns: int) -> list[Answer]:
        """To orders that the controller has not spoken of in time, or of which the watchdog's word is known now."""
        return self.pending.expired(now_ns) + self.pending.settled(lambda told: word.after(told, now_ns))

    def forget(self, asker: Hashable) -> None:
        """It is gone: nobody waits for its answers any more."""
        self.pending.forget(asker)
        self.proven.discard(asker)

    def close(self) -> None:
        self._aide.close()
        self._watchdog.close()

    def _signed(self, asker: Hashable, text: str, utc_ns: int, now_ns: int) -> dict[str, Any] | None:
        signed = text.encode(errors="replace")
        if len(signed) > LONGEST:
            return {"refused": f"longer than {LONGEST} bytes"}
        if not self._verifier.operators:
            return {"refused": "this server knows no operators: set keys in [server]"}
        order = self._verifier.verify(signed, utc_ns)
        told: Told | None = None
        if isinstance(order, SignedOrder):
            self.proven.add(asker)
            told = self._tell_watchdog(order, now_ns)
        if self.pending.is_full(proven=isinstance(order, SignedOrder)):
            also = {} if told is None else {"watchdog": TOLD if told.reached else UNREACHED}
            return {"refused": "too many orders are on their way", **also}
        self.relayed += 1
        message = {"kind": "signed", "order": signed.hex(), "reply_to": self.reply_to}
        if self._aide.send(json.dumps(message).encode()):
            self.pending.add(asker, signed, now_ns, told)
            return None
        refused = {"refused": "the controller cannot be reached"}
        if told is None:
            return refused
        self.pending.hold(asker, refused, told)
        return None

    def _tell_watchdog(self, order: SignedOrder, now_ns: int) -> Told | None:
        """None for what is no order of its. The controller judges the order for itself."""
        if order.name not in VERBS:
            return None
        verb = VERBS[order.name]
        told = Told(verb, now_ns, self._watchdog.send(encode_word(verb, order.who)))
        if told.reached:
            LOG.warning("%s by %s: the watchdog was told", order.name, order.who)
        return told


def _error(text: str) -> dict[str, Any]:
    return {"error": text}
