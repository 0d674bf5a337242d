"""What a source of bytes hands on: chunks of one flow, each with the time it arrived."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import StrEnum
from typing import NamedTuple


class StampSource(StrEnum):
    """Who took an arrival time, best first."""

    HARDWARE = "hardware"
    KERNEL = "kernel"
    KERNEL_BATCHED = "kernel-batched"
    """One stamp for several frames of a TCP read: an upper bound for all but the last."""
    USER = "user"
    CAPTURE = "capture"


def host_of(address: str) -> str:
    """``host`` of ``host:port`` or ``[host]:port``; all of it where there is no port."""
    return address.rpartition(":")[0].strip("[]") or address


class Flow(NamedTuple):
    """One direction of one conversation. ``transport`` is ``udp``, ``tcp`` or ``file``.

    ``source`` and ``destination`` are ``host:port`` (``[host]:port`` for IPv6), or a file's name. ``connection``
    counts the TCP connections seen between the same two endpoints, from 0.
    """

    transport: str
    source: str
    destination: str = ""
    connection: int = 0

    @property
    def ends(self) -> Flow:
        """All connections between the same two endpoints, as one."""
        return self if not self.connection else self._replace(connection=0)

    @property
    def host(self) -> str:
        """The source without its port, IPv6 without brackets; a file's name as it is."""
        return host_of(self.source)

    @property
    def is_stream(self) -> bool:
        """Whether a frame may continue in the flow's next chunk (a datagram holds whole frames)."""
        return self.transport != "udp"


class Chunk(NamedTuple):
    """Bytes of one flow, in order: a datagram, a TCP segment's new bytes, or a piece of a file."""

    data: bytes
    arrival_ns: int | None
    flow: Flow
    stamp_source: StampSource = StampSource.CAPTURE
    lost_before: int = 0
    """Bytes of the flow known to be missing just before ``data`` (a hole in a capture)."""


class Train(NamedTuple):
    """Datagrams of one flow and one size, in order, end to end in ``data``: many chunks at little cost."""

    data: bytes
    size: int
    arrivals_ns: Sequence[int | None]
    flow: Flow
    stamp_source: StampSource = StampSource.CAPTURE

    def chunks(self) -> Iterator[Chunk]:
        """The datagrams one by one."""
        for at, arrival_ns in zip(range(0, len(self.data), self.size), self.arrivals_ns, strict=True):
            yield Chunk(self.data[at : at + self.size], arrival_ns, self.flow, self.stamp_source)


class Hangup(StrEnum):
    """What TCP clients see of a stream that falls silent."""

    SILENCE = "silence"
    """An open connection without data."""
    FIN = "fin"
    RST = "rst"
    REFUSE = "refuse"
    """RST, and no new connection until the stream comes back."""


class Cut(StrEnum):
    """How the bytes of a frame are handed to a TCP connection, where not whole and at once."""

    SPLIT = "split"
    COALESCE = "coalesce"
    STALL = "stall"
    RESET = "reset"


class Segmentation(NamedTuple):
    """How a frame is written to a byte stream; datagrams are always whole.

    ``split``: in ``count`` pieces, ``gap_ns`` apart. ``coalesce``: kept until ``count`` frames are there, then in one
    write. ``stall``: the connection writes nothing for ``gap_ns``, then this frame and what came after. ``reset``:
    the first ``count`` bytes (0: half of them), then RST.
    """

    cut: Cut
    count: int = 0  # type: ignore[assignment]  # not tuple.count
    gap_ns: int = 0
