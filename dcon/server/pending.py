"""Orders on their way: relayed to the controller, and answered by what its ticks say became of them. Pure.

An order that is the watchdog's too is answered when both are known: what the controller has made of it, and what the
watchdog says after it was told.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

from dcon.core.orders import SYSTEM
from dcon.core.system import LINK_REFUSED
from dcon.core.values import Order
from dcon.link.orders import ANSWER_NS, Refused, digest, read
from dcon.server.newest import TickSummary
from dcon.server.watchdog_word import Told

MOST = 256
"""On their way at once."""


class Answer(NamedTuple):
    """To whom, and what became of the order."""

    asker: Hashable
    said: dict[str, Any]


class _Waiting(NamedTuple):
    asker: Hashable
    digest: str
    order: Order | None
    """None where it is no order at all: it will be refused."""
    due_ns: int
    told: Told | None
    """None where it is no order of the watchdog's."""
    said: dict[str, Any] | None = None
    """What the controller has made of it, where the watchdog's word is awaited still."""


class Pending:
    """Every order that is added is answered, after ``ANSWER_NS`` and the wait for the watchdog's word at the latest."""

    def __init__(self) -> None:
        self._waiting: list[_Waiting] = []

    def __len__(self) -> int:
        return len(self._waiting)

    def is_full(self, *, proven: bool) -> bool:
        """Half of the room is for orders whose signature holds."""
        return len(self._waiting) >= (MOST if proven else MOST // 2)

    def add(self, asker: Hashable, signed: bytes, now_ns: int, told: Told | None = None) -> None:
        """An order was relayed; ``now_ns`` on a clock without steps."""
        said = read(signed)
        order = None if isinstance(said, Refused) else said.order
        self._waiting.append(_Waiting(asker, digest(signed), order, now_ns + ANSWER_NS, told))

    def hold(self, asker: Hashable, said: dict[str, Any], told: Told) -> None:
        """This is to be the answer, once the watchdog's word is known."""
        self._waiting.append(_Waiting(asker, "", None, 0, told, said))

    def awaits(self, asker: Hashable) -> bool:
        return any(waiting.asker == asker for waiting in self._waiting)

    def heard(self, news: TickSummary) -> list[Answer]:
        """Answers that a tick gives."""
        if not news.orders or not self._waiting:
            return []
        refused = [event for event in news.events if event.name == "refused"]
        answers = []
        for order in news.orders:
            if order.name == LINK_REFUSED:
                answers += self.refused(order.why, order.text)
                continue
            waiting = next((each for each in self._waiting if each.order == order), None)
            if waiting is None:
                continue
            self._waiting.remove(waiting)
            by = f"; order by {order.who}"
            event = next((e for e in refused if e.subject == order.name and (e.detail.endswith(by))), None)
            if event is not None:
                refused.remove(event)
                answers += self._answers(waiting, {"refused": event.detail.removesuffix(by)})
            else:
                told = [f"{e.name} {e.detail}".strip() for e in news.events if e.subject == SYSTEM]
                said = {"accepted": order.name, "tick_ns": news.tick_ns, "state": news.state, "events": told}
                answers += self._answers(waiting, said)
        return answers

    def refused(self, name: str, reason: str) -> list[Answer]:
        """The answer to the order of that digest: the platform's link refuses it."""
        return self._become({"refused": reason}, lambda waiting: waiting.digest == name)

    def expired(self, now_ns: int) -> list[Answer]:
        """Those that the controller has not spoken of in time."""
        silence = f"the controller has not answered in {ANSWER_NS // 10**9} s"
        return self._become({"unknown": silence}, lambda waiting: now_ns >= waiting.due_ns)

    def settled(self, after: Callable[[Told], str | None]) -> list[Answer]:
        """Those whose watchdog's word is known now: ``after`` gives it, or None."""
        answers, waiting = [], []
        for each in self._waiting:
            word = after(each.told) if each.said is not None and each.told is not None else None
            if each.said is None or word is None:
                waiting.append(each)
            else:
                answers.append(Answer(each.asker, {**each.said, "watchdog": word}))
        self._waiting = waiting
        return answers

    def forget(self, asker: Hashable) -> None:
        """Nobody waits there any more."""
        self._waiting = [waiting for waiting in self._waiting if waiting.asker != asker]

    def _become(self, said: dict[str, Any], which: Callable[[_Waiting], bool]) -> list[Answer]:
        found = [waiting for waiting in self._waiting if waiting.said is None and which(waiting)]
        for waiting in found:
            self._waiting.remove(waiting)
        return [answer for waiting in found for answer in self._answers(waiting, said)]

    def _answers(self, waiting: _Waiting, said: dict[str, Any]) -> list[Answer]:
        """What can be told at once."""
        if waiting.told is None:
            return [Answer(waiting.asker, said)]
        self.hold(waiting.asker, said, waiting.told)
        return []
