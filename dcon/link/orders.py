"""Orders that an operator signs, and what is made of those that come: pure.

One line of JSON: ``{"who", "sequence", "time_ns", "name", "value", "text", "why", "mac"}``. ``mac`` is the HMAC-SHA256
(RFC 2104) under the operator's key over the JSON of the rest, keys sorted, no spaces, ASCII only; 64 hexadecimal
digits. Who has the key can make an order, and nobody else: the operator, and each process that reads the key file to
judge what comes (the aides; the server, for the watchdog).
"""

from __future__ import annotations

import hashlib
import hmac
import json
import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

from dcon.core.system import LINK_REFUSED, ORDERS
from dcon.core.values import Order

LONGEST = 4000
"""Bytes of a signed order."""
WORDS = 200
"""Characters of ``who``, ``text`` and ``why``, each."""
WINDOW_NS: Final = 5_000_000_000
ANSWER_NS: Final = 2_000_000_000
"""An order that the controller has not spoken of for so long is answered with that."""
REFUSALS_A_SECOND = 10
"""Refused orders that become inputs; more are counted."""
MOST_STOPS = 1000
TOO_OLD: Final = "too old: is the operator's clock right?"
ESTOP: Final = "estop"
REPLAYED: Final = "replayed, or overtaken by a later order"
_NS = 1_000_000_000


class SignedOrder(NamedTuple):
    """An order, who signed it, and when."""

    who: str
    sequence: int
    """Greater than that of any order of the operator before; ``time_ns`` will do."""
    time_ns: int
    """POSIX UTC by the operator's clock."""
    name: str
    value: float = 0.0
    text: str = ""
    why: str = ""

    @property
    def order(self) -> Order:
        """What the controller is given."""
        return Order(self.name, self.value, self.text, self.who, self.why)


class Operator(NamedTuple):
    """Who may order what; ``may`` None is everything."""

    name: str
    key: bytes
    may: frozenset[str] | None = None


class Refused(NamedTuple):
    """Why something is no order of ours, and by whom it says it is."""

    reason: str
    who: str = ""


def sign(order: SignedOrder, key: bytes) -> bytes:
    """The line, without its end. Raises ValueError for an order that no receiver would take."""
    order = order._replace(value=float(order.value))
    if problem := _malformed(order._asdict()):
        raise ValueError(problem)
    signed = _canonical({**order._asdict(), "mac": mac_of(order, key)})
    if len(signed) > LONGEST:
        raise ValueError(f"longer than {LONGEST} bytes: use fewer words")
    return signed


def mac_of(order: SignedOrder, key: bytes) -> str:
    """64 hexadecimal digits."""
    return hmac.new(key, _canonical(order._asdict()), hashlib.sha256).hexdigest()


def digest(signed: bytes) -> str:
    """A short name of a signed order, by which its sender finds what became of it."""
    return hashlib.sha256(signed).hexdigest()[:16]


class _Case(NamedTuple):
    """A signed order and what it is judged by."""

    order: SignedOrder
    mac: str
    operator: Operator | None
    last: int
    """Sequence of the operator's last order."""
    is_known: bool
    """It is an emergency stop that was taken before."""
    floor_ns: int
    window_ns: int
    now_ns: int


def _unknown(case: _Case) -> bool:
    return case.operator is None


def _forged(case: _Case) -> bool:
    assert case.operator is not None
    return not hmac.compare_digest(mac_of(case.order, case.operator.key), case.mac)


def _old(case: _Case) -> bool:
    return case.order.time_ns < case.now_ns - case.window_ns


def _future(case: _Case) -> bool:
    return case.order.time_ns > case.now_ns + case.window_ns


def _ahead(case: _Case) -> bool:
    """It would lock its operator out until then."""
    return case.order.sequence > case.now_ns + case.window_ns


def _replayed(case: _Case) -> bool:
    """An emergency stop needs no sequence above the last: no other order may keep one from stopping."""
    if case.order.name == ESTOP:
        return case.is_known
    return case.order.sequence <= case.last or case.order.time_ns <= case.floor_ns


def _forbidden(case: _Case) -> bool:
    assert case.operator is not None
    return case.operator.may is not None and case.order.name not in case.operator.may


REFUSALS: Final[tuple[tuple[str, Callable[[_Case], bool]], ...]] = (
    ("unknown operator", _unknown),
    ("the signature does not hold", _forged),
    (TOO_OLD, _old),
    ("from the future: is the operator's clock right?", _future),
    ("its sequence is above the time and the window", _ahead),
    (REPLAYED, _replayed),
    ("not allowed to this operator", _forbidden),
)
"""In this order; what is no order at all is refused before."""


class Verifier:
    """Judges signed orders, and remembers the last of each operator and the emergency stops that are not too old yet.

    Memory: a number an operator, and the newest :data:`MOST_STOPS`.
    """

    def __init__(
        self,
        operators: Mapping[str, Operator],
        *,
        window_ns: int = WINDOW_NS,
        last: Mapping[str, int] | None = None,
        floor_ns: int = 0,
    ) -> None:
        """``last`` are sequences accepted in an earlier life; where it cannot be had, ``floor_ns`` is now: nothing that
        was signed before is taken."""
        self.operators = dict(operators)
        self.window_ns = window_ns
        self.floor_ns = floor_ns
        self.last = dict(last or {})
        self._stops: dict[str, int] = {}
        """``time_ns`` of those that were taken, by their MAC."""

    def verify(self, signed: bytes, now_ns: int) -> SignedOrder | Refused:
        """The order, whose sequence is used up by this; or why it is refused."""
        parsed = _parsed(signed)
        if isinstance(parsed, Refused):
            return parsed
        order, mac = parsed
        operator, last = self.operators.get(order.who), self.last.get(order.who, -1)
        case = _Case(order, mac, operator, last, mac in self._stops, self.floor_ns, self.window_ns, now_ns)
        for reason, is_up in REFUSALS:
            if is_up(case):
                return Refused(reason, order.who)
        self.last[order.who] = max(last, order.sequence)
        if order.name == ESTOP:
            recent = [stop for stop in self._stops.items() if stop[1] >= now_ns - self.window_ns]
            self._stops = dict([*recent, (mac, order.time_ns)][-MOST_STOPS:])
        return order


class RefusalLog:
    """Makes inputs of refused orders, so that they are logged and replay; bounded, so that nobody can flood a log."""

    def __init__(self) -> None:
        self._recent: deque[int] = deque(maxlen=REFUSALS_A_SECOND)
        self._untold = 0

    def order(self, refused: Refused, signed: bytes, now_ns: int) -> Order | None:
        """The input; None where there were too many in the last second, which the next one tells."""
        if len(self._recent) == REFUSALS_A_SECOND and 0 <= now_ns - self._recent[0] < _NS:
            self._untold += 1
            return None
        self._recent.append(now_ns)
        more, self._untold = self._untold, 0
        text = f"{refused.reason}; and {more} more were refused" if more else refused.reason
        return Order(LINK_REFUSED, text=text, who=refused.who, why=digest(signed))


def read(signed: bytes) -> SignedOrder | Refused:
    """What it says, whoever signed it."""
    parsed = _parsed(signed)
    return parsed if isinstance(parsed, Refused) else parsed[0]


def _canonical(values: Mapping[str, object]) -> bytes:
    return json.dumps(values, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def _parsed(signed: bytes) -> tuple[SignedOrder, str] | Refused:
    if len(signed) > LONGEST:
        return Refused(f"longer than {LONGEST} bytes")
    try:
        values = json.loads(signed)
        mac = values.pop("mac")
        # only the very bytes that sign() makes: nothing is left open to another reading
        exact = signed == _canonical({**values, "mac": mac})
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return Refused("no signed order")
    if not exact or not isinstance(mac, str) or not mac.isascii():
        return Refused("no signed order")
    if problem := _malformed(values):
        return Refused(problem)
    values["value"] = float(values["value"])
    return SignedOrder(**values), mac


def _malformed(values: Mapping[str, object]) -> str:
    """Why these are no fields of an order; "" where they are."""
    if set(values) != set(SignedOrder._fields):
        return "no signed order"
    if any(type(values[name]) is not int or not 0 <= values[name] < 1 << 63 for name in ("sequence", "time_ns")):  # type: ignore[operator]
        return "sequence and time must be whole numbers"
    value = values["value"]
    if type(value) is not float or not math.isfinite(value):
        return "value must be a finite number"
    for name in ("who", "name", "text", "why"):
        word = values[name]
        if not isinstance(word, str) or len(word) > WORDS or not word.isprintable():
            return f"{name} must be at most {WORDS} characters that print"
    if values["name"] not in ORDERS:
        return "no such order"
    return ""
