"""Datagrams of the simulated network, as the live front end takes them: by the same demultiplexer.

A whole data frame of the configuration it began with, its CHK right, is what nearly all are: that much is seen here,
and what is anything else is the demultiplexer's to judge, with all after it.
"""

from __future__ import annotations

from collections import Counter

from pmutools.c37118 import Demux, Frame, Loss, StreamConfig
from pmutools.c37118.checksum import chk
from pmutools.c37118.constants import FrameType
from pmutools.flow import Chunk, Flow, StampSource


class Wire:
    """The controller's end of one PMU's stream."""

    def __init__(self, name: str, config: StreamConfig) -> None:
        """``config`` is known beforehand: a running session."""
        self.name = name
        self.skipped: Counter[str] = Counter()
        """Datagrams that are no frame of this stream, by reason."""
        self._idcode, self._size = config.idcode, config.frame_size
        self._head = FrameType.DATA.sync.to_bytes(2, "big") + self._size.to_bytes(2, "big")
        self._head += self._idcode.to_bytes(2, "big")
        self._flow = Flow("udp", name)
        self._demux: Demux | None = None
        self._config = config

    def is_plain(self, data: bytes) -> bool:
        """Whether it is one data frame as all were so far."""
        return data[:6] == self._head and not chk(data) and len(data) == self._size and self._demux is None

    def frames(self, data: bytes, arrival_ns: int) -> list[tuple[Frame, StreamConfig | None]]:
        """Data frames in a datagram, and configuration frames with what they say."""
        if self._demux is None:
            self._demux = Demux([self._config])
        found: list[tuple[Frame, StreamConfig | None]] = []
        for part in self._demux.feed(Chunk(data, arrival_ns, self._flow, StampSource.CAPTURE)):
            if isinstance(part, Loss):
                self.skipped[str(part.skipped.reason)] += 1
            elif part.frame.idcode != self._idcode:
                self.skipped["idcode"] += 1
            elif part.frame.type is FrameType.DATA:
                found.append((part.frame, None))
            elif part.config is not None and part.frame.type.rules_data:
                found.append((part.frame, part.config))
        return found
