"""Orders given beforehand: what an operator will order, and when."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from dcon.core.system import ORDERS
from dcon.core.values import Order
from pmutools.errors import SettingsError
from pmutools.parsers import number, suggestion

LONGEST_S = 1e9
"""An order is no further from the start: 30 years."""


class TimedOrder(NamedTuple):
    at_ns: int
    """POSIX UTC, or ns from the start of the session."""
    order: Order


def parse_order(text: str) -> TimedOrder:
    """``SECONDS:NAME`` or ``SECONDS:NAME=VALUE``, seconds from the start. Raises SettingsError."""
    when, colon, rest = text.partition(":")
    name, equals, value = rest.partition("=")
    try:
        at_ns = round(number(-LONGEST_S, LONGEST_S)(when) * 1e9)
        amount = number()(value) if equals else 0.0
    except ValueError:
        colon = ""
        at_ns, amount = 0, 0.0
    if not colon:
        raise SettingsError(f"--order {text}: write SECONDS:NAME or SECONDS:NAME=VALUE, as in 30:arm or 40:gain=12")
    if name not in ORDERS:
        raise SettingsError(f"--order {text}: {name!r} is no order; {suggestion(name, map(str, ORDERS))}")
    if name == "gain" and not equals:
        raise SettingsError(f"--order {text}: no value; write {when}:gain=MW_PER_MHZ")
    if equals and name != "gain":
        raise SettingsError(f"--order {text}: {name} takes no value")
    return TimedOrder(at_ns, Order(name, amount))


class OrderBook:
    """Timed orders, handed out once each as their time comes."""

    def __init__(self, orders: Sequence[TimedOrder], start_ns: int) -> None:
        """``orders`` count from ``start_ns`` (POSIX UTC)."""
        self._waiting = sorted((start_ns + order.at_ns, number, order.order) for number, order in enumerate(orders))

    def due(self, now_ns: int) -> tuple[Order, ...]:
        """Those whose time has come by ``now_ns``."""
        count = sum(at_ns <= now_ns for at_ns, *_ in self._waiting)
        due = tuple(order for *_, order in self._waiting[:count])
        del self._waiting[:count]
        return due
