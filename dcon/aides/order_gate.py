"""Signed orders on their way to the control process: who may pass is decided here, and nowhere else.

The server hands on what operators have signed, unchanged, and its own judgement of it counts for nothing here. What is
refused becomes an input of the controller too, so that it is in the session log and replays.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from dcon.core.values import Order
from dcon.link.keys import SEQUENCES, load_sequences, save_sequences
from dcon.link.orders import Operator, RefusalLog, Refused, Verifier, digest
from pmutools.timebase import NS

LOG = logging.getLogger(__name__)


class Passed(NamedTuple):
    """What became of one datagram."""

    news: Order | None = None
    """For the control process."""
    reply: dict[str, Any] | None = None
    """For who handed it on: ``{"digest", "refused"}``. What was accepted shows in the log of the session."""
    reply_to: str = ""
    """Path of the socket that wants to hear it."""
    order: str = ""
    """Digest of the order that ``news`` is; "" where that is a refusal."""


class OrderGate:
    """Verifies orders, remembers what was accepted in ``operators.seq``, and tells of what is refused."""

    def __init__(self, operators: Mapping[str, Operator], window_s: float, run_dir: Path, utc_ns: int) -> None:
        """Where ``operators.seq`` is not there or damaged, nothing counts that was signed before ``utc_ns`` (now)."""
        self._folder = run_dir
        last = load_sequences(run_dir)
        floor_ns = utc_ns if last is None else 0
        self.verifier = Verifier(operators, window_ns=round(window_s * NS), last=last, floor_ns=floor_ns)
        self._refusals = RefusalLog()
        self.refused = 0
        self.malformed = 0
        """Datagrams that are not even ``{"kind": "signed", ...}``, or whose ``reply_to`` no path can be."""

    def take(self, datagram: bytes, now_ns: int, utc_ns: int) -> Passed:
        """Judge ``{"kind": "signed", "order": HEX, "reply_to": PATH}``. Never raises.

        ``now_ns`` is of a clock without steps. What is accepted is remembered before it is passed on.
        """
        try:
            said = json.loads(datagram)
            if said["kind"] != "signed":
                raise ValueError("another kind")
            signed = bytes.fromhex(said["order"])
            reply_to = str(said.get("reply_to") or "")
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            self.malformed += 1
            return Passed()
        found = self.verifier.verify(signed, utc_ns)
        if isinstance(found, Refused):
            self.refused += 1
            told = self._refusals.order(found, signed, now_ns)
            return Passed(told, {"digest": digest(signed), "refused": found.reason}, reply_to)
        if not save_sequences(self._folder, self.verifier.last):
            LOG.warning("%s: cannot be written", self._folder / SEQUENCES)
            with suppress(OSError):  # better none than one that is behind
                (self._folder / SEQUENCES).unlink()
        return Passed(found.order, None, reply_to, digest(signed))
