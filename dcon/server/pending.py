"""Orders on their way: relayed to the controller, and answered by what its ticks say became of them. Pure."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any, NamedTuple

from dcon.core.orders import SYSTEM
from dcon.core.system import LINK_REFUSED
from dcon.core.values import Order
from dcon.link.orders import ANSWER_NS, Refused, digest, read
from dcon.server.newest import TickSummary

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
    also: dict[str, Any]
    """What its answer says besides."""

    def answer(self, said: dict[str, Any]) -> Answer:
        return Answer(self.asker, said | self.also)


class Pending:
    """Every order that is added is answered, after ``ANSWER_NS`` at the latest."""

    def __init__(self) -> None:
        self._waiting: list[_Waiting] = []

    def __len__(self) -> int:
        return len(self._waiting)

    def is_full(self, *, proven: bool) -> bool:
        """Half of the room is for orders whose signature holds."""
        return len(self._waiting) >= (MOST if proven else MOST // 2)

    def add(self, asker: Hashable, signed: bytes, now_ns: int, also: dict[str, Any] | None = None) -> None:
        """An order was relayed; ``now_ns`` on a clock without steps. ``also`` is in its answer, whatever that is."""
        said = read(signed)
        order = None if isinstance(said, Refused) else said.order
        self._waiting.append(_Waiting(asker, digest(signed), order, now_ns + ANSWER_NS, also or {}))

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
                answers.append(waiting.answer({"refused": event.detail.removesuffix(by)}))
            else:
                told = [f"{e.name} {e.detail}".strip() for e in news.events if e.subject == SYSTEM]
                said = {"accepted": order.name, "tick_ns": news.tick_ns, "state": news.state, "events": told}
                answers.append(waiting.answer(said))
        return answers

    def refused(self, name: str, reason: str) -> list[Answer]:
        """The answer to the order of that digest: the platform's link refuses it."""
        found = [waiting for waiting in self._waiting if waiting.digest == name]
        self._waiting = [waiting for waiting in self._waiting if waiting.digest != name]
        return [waiting.answer({"refused": reason}) for waiting in found]

    def expired(self, now_ns: int) -> list[Answer]:
        """Those that the controller has not spoken of in time."""
        late = [waiting for waiting in self._waiting if now_ns >= waiting.due_ns]
        self._waiting = [waiting for waiting in self._waiting if now_ns < waiting.due_ns]
        silence = f"the controller has not answered in {ANSWER_NS // 10**9} s"
        return [waiting.answer({"unknown": silence}) for waiting in late]

    def forget(self, asker: Hashable) -> None:
        """Nobody waits there any more."""
        self._waiting = [waiting for waiting in self._waiting if waiting.asker != asker]
