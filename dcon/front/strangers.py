"""Datagrams that no PMU of the settings sends, by sender and first six bytes: a flood of them costs next to nothing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from pmutools.c37118.constants import MIN_FRAME_SIZE
from pmutools.flow import Chunk
from pmutools.net.endpoint import Endpoint, Scheme

SHOWN = 8
"""The first of each sender and IDCODE are looked at like any other, so that people are told of them."""
MOST = 4096
"""Senders and IDCODEs that are remembered; when another comes they are met again as new."""
_SYNC = 0xAA


class Strangers:
    """Who may send what to which port, as far as a datagram's head can tell."""

    def __init__(self, endpoints: Iterable[Endpoint]) -> None:
        self._asked: dict[str, list[tuple[str | None, int | None]]] = {}
        """By port: senders and IDCODEs that are asked for; None is any. Ports of commanded streams are not here."""
        self._met = Counter[tuple[str, str, int | None]]()
        self.dropped = 0
        """Datagrams that were not looked at."""
        endpoints = tuple(endpoints)
        commanded = {str(each.data_port or each.port) for each in endpoints if each.scheme is not Scheme.UDP}
        for each in endpoints:
            if each.scheme is Scheme.UDP and each.port and str(each.port) not in commanded:
                self._asked.setdefault(str(each.port), []).append((each.source, each.idcode))

    def drop(self, chunk: Chunk) -> bool:
        """Whether ``chunk`` is one more of a stranger's; then it is counted."""
        flow = chunk.flow
        port = flow.destination.rpartition(":")[2]
        asked = None if flow.is_stream else self._asked.get(port)
        if asked is None:
            return False
        host = flow.host
        here = [idcode for source, idcode in asked if source in (None, host)]
        claimed = _claimed(chunk.data)
        if None in here or (here and (claimed is None or claimed in here)):
            return False
        who = port, host, claimed
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
