"""Datagrams that no PMU of the settings sends, by sender and first six bytes: a flood of them costs next to nothing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from pmutools.c37118.constants import MIN_FRAME_SIZE
from pmutools.flow import Chunk, Flow

SHOWN = 8
"""The first of each sender and IDCODE are looked at like any other, so that people are told of them."""
MOST = 4096
"""Senders and IDCODEs that are remembered; when another comes they are met again as new."""
_SYNC = 0xAA


class Strangers:
    """Who sends what nobody asks for. ``hears(flow, idcode)`` is whether somebody may; of None, whatever the IDCODE."""

    def __init__(self, hears: Callable[[Flow, int | None], bool]) -> None:
        self._hears = hears
        self._met = Counter[tuple[str, str, int | None]]()
        self.dropped = 0
        """Datagrams that were not looked at."""

    def drop(self, chunk: Chunk) -> bool:
        """Whether ``chunk`` is one more of a stranger's; then it is counted."""
        flow = chunk.flow
        if flow.is_stream:
            return False
        claimed = _claimed(chunk.data)
        if self._hears(flow, claimed):
            return False
        # a host that nobody asks anything of is one stranger, whatever it claims
        who = flow.destination, flow.host, claimed if self._hears(flow, None) else None
        if len(self._met) >= MOST and who not in self._met:
            self._met.clear()
        self._met[who] += 1
        if self._met[who] <= SHOWN:
            return False
        self.dropped += 1
        return True


def _claimed(data: bytes) -> int | None:
    """The IDCODE of what claims to be one whole frame."""
    is_frame = len(data) >= MIN_FRAME_SIZE and data[0] == _SYNC and data[2] << 8 | data[3] == len(data)
    return data[4] << 8 | data[5] if is_frame else None
