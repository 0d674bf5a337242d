"""News on its way out: of what a flood of senders could make countless, so much as people can read."""

from __future__ import annotations

from collections.abc import Callable

from pmutools.net.dialogue import LinkEvent, LinkKind

COUNTED = frozenset((LinkKind.FOREIGN, LinkKind.NO_CONFIG, LinkKind.DUPLICATE, LinkKind.NOISE))
"""Kinds that anyone can cause who can send to a port."""
TOLD = 20
"""So many of one kind about one local port are told in :data:`WINDOW_NS`; the rest are counted, and told in one."""
WINDOW_NS = 60_000_000_000


class Notices:
    """Hands news to ``emit``; see the module's text. Times are monotonic ns."""

    def __init__(self, emit: Callable[[LinkEvent], None], now_ns: int) -> None:
        self._emit = emit
        self._seen: dict[tuple[LinkKind, str], tuple[int, LinkEvent]] = {}
        """How many have come in this window, and the last of them, by kind and local port."""
        self._since_ns = now_ns

    def tell(self, event: LinkEvent) -> None:
        if event.kind not in COUNTED:
            self._emit(event)
            return
        place = event.kind, event.flow.destination if event.flow is not None else event.where
        count = self._seen[place][0] + 1 if place in self._seen else 1
        self._seen[place] = count, event
        if count <= TOLD:
            self._emit(event)

    def sum_up(self, now_ns: int, *, end: bool = False) -> None:
        """Tell of what was only counted, once a window is over, or at the ``end``."""
        if not end and now_ns - self._since_ns < WINDOW_NS:
            return
        for count, last in self._seen.values():
            if count > TOLD:
                self._emit(last._replace(detail=f"{count - TOLD} more of this kind, the last: {last.detail}"))
        self._seen.clear()
        self._since_ns = now_ns
