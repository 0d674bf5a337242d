"""The news of live endpoints: what is out of the ordinary, and why nothing came where nothing came."""

from __future__ import annotations

from pmutools.host import ClockStep, Stall
from pmutools.net.dialogue import LinkEvent, LinkKind

USUAL = frozenset((LinkKind.BOUND, LinkKind.CONNECTED, LinkKind.CONFIGURED, LinkKind.STREAMING))
"""How every connection begins."""
_NO_REASON = frozenset((LinkKind.OWN_DROPS, LinkKind.STREAMING))
_AFTER_FOREIGN = frozenset((LinkKind.NOTHING, LinkKind.SILENT, LinkKind.UNANSWERED))
"""Follow from frames that are another's."""
TOLD = 3
"""Endpoints whose reasons are told together."""


def told(event: LinkEvent) -> str:
    """The news without where it happened, which is said beside it."""
    detail = event.detail.removeprefix(f"{event.where}: ")
    return f"{event.kind}: {detail}" if detail else str(event.kind)


def host_told(event: Stall | ClockStep) -> str:
    """The news of the measuring machine."""
    if isinstance(event, Stall):
        return f"the measuring host stood still for {event.length_ns / 1e6:.0f} ms"
    return f"the receiver's clock was set by {event.step_ns / 1e6:+.3f} ms"


class Reasons:
    """Remembers of each endpoint, by its place, what was last heard of it that keeps data from coming."""

    def __init__(self) -> None:
        self._last: dict[int, LinkEvent] = {}

    def hear(self, event: LinkEvent) -> None:
        """Take note of news; those of one place come in order."""
        if event.kind in _NO_REASON:
            return
        for place in event.owners:
            known = self._last.get(place)
            if known is None or known.kind is not LinkKind.FOREIGN or event.kind not in _AFTER_FOREIGN:
                self._last[place] = event

    def refused(self, place: int) -> bool:
        """Whether the last that was heard is that no connection could be made."""
        event = self._last.get(place)
        return event is not None and event.kind is LinkKind.FAILED

    def why_all(self, places: int) -> str:
        """The same of the first :data:`TOLD` of so many endpoints, each reason once."""
        return "; ".join(dict.fromkeys(map(self.why, range(min(places, TOLD)))))

    def why(self, place: int = 0) -> str:
        """Why nothing came of an endpoint, as part of a sentence, with what to do."""
        event = self._last.get(place)
        if event is None or event.kind is LinkKind.BOUND:
            return "nothing came; is the sender on, and sending to this address and port?"
        detail = event.detail.removeprefix(f"{event.where}: ")
        if event.kind is LinkKind.CONNECTED:
            asked = "its own IDCODE only, name it with ?idcode=N" if event.idcode is None else "its own IDCODE only"
            return f"connected, but nothing came; a device answers to {asked}"
        return _SAID.get(event.kind, "{detail}").format(detail=detail)


_SAID = {
    LinkKind.CONFIGURED: "a configuration came, but no data",
    LinkKind.SILENT: "data have stopped coming",
    LinkKind.NO_CONFIG: "data came, but no configuration that fits them: {detail}",
    LinkKind.FOREIGN: "nothing came that was asked for: {detail}",
}
