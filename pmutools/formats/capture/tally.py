"""What became of every packet and every byte of a capture file."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum


class Fate(StrEnum):
    """What became of one captured packet; each packet has exactly one."""

    UDP = "udp"
    """Part or whole of a UDP datagram that was delivered."""
    TCP = "tcp"
    """A TCP segment with bytes not seen before."""
    TCP_EMPTY = "tcp-empty"
    """A TCP segment without payload: handshake, acknowledgement, FIN, RST, keep-alive."""
    TCP_REPEATED = "tcp-repeated"
    """A TCP segment all of whose bytes had been seen before."""
    TCP_STRAY = "tcp-stray"
    """A TCP sequence number far outside its connection; delivered only if the next stray segment follows on from it."""
    OTHER_IP = "other-ip"
    """IP, but neither UDP nor TCP."""
    NOT_IP = "not-ip"
    UNSUPPORTED_LINK = "unsupported-link"
    """A link layer that is not read here (numbers in :attr:`Tally.unsupported_links`)."""
    TRUNCATED = "truncated"
    """Cut by the capture's snapshot length; its payload is not delivered."""
    FRAGMENT_LOST = "fragment-lost"
    """An IP fragment of a datagram that never became whole."""
    DAMAGED = "damaged"
    """Headers that contradict themselves or the packet's length."""

    __hash__ = str.__hash__  # Enum's own is a Python function, and every packet is counted


_LOSSES = (Fate.TRUNCATED, Fate.FRAGMENT_LOST, Fate.DAMAGED, Fate.TCP_STRAY)


def _zeros() -> dict[Fate, int]:
    return dict.fromkeys(Fate, 0)


@dataclass(slots=True)
class Tally:
    """The account of one pass over a capture file.

    ``file_bytes == overhead_bytes + sum(nbytes.values()) + skipped_bytes + cut_bytes`` once the pass is over;
    while it runs the figures may be ahead of what was delivered by up to a block of the file.
    """

    packets: dict[Fate, int] = field(default_factory=_zeros)
    nbytes: dict[Fate, int] = field(default_factory=_zeros)
    """Captured bytes, link header included, by fate."""
    unsupported_links: dict[int, int] = field(default_factory=dict)
    """LINKTYPE number -> packets."""
    file_bytes: int = 0
    """Bytes read, after decompression."""
    overhead_bytes: int = 0
    """File, record and block headers, options, padding, and blocks that hold no packet."""
    skipped_bytes: int = 0
    """Bytes passed over to find the next plausible record."""
    gaps: int = 0
    """Stretches that make up ``skipped_bytes``."""
    cut_bytes: int = 0
    """A last record that the file does not hold to its end."""
    decompression_failed: bool = False
    """The .gz or .zst layer was damaged or cut; nothing after that point was read."""
    unknown_blocks: int = 0
    """pcapng blocks of a type not known here; their bytes are overhead."""
    fragments: int = 0
    """Packets that were IP fragments, whatever their fate."""
    chunks: int = 0
    payload_bytes: int = 0
    """Bytes delivered in ``chunks``."""
    repeated_bytes: int = 0
    """TCP payload dropped because the same sequence numbers had been seen."""
    lost_bytes: int = 0
    """TCP sequence numbers given up as missing from the file."""

    @property
    def total_packets(self) -> int:
        return sum(self.packets.values())

    @property
    def is_clean(self) -> bool:
        """Whether every byte of the file was understood and no payload is known to be missing."""
        damaged = self.skipped_bytes or self.cut_bytes or self.decompression_failed or self.lost_bytes
        return not damaged and not any(self.packets[fate] for fate in _LOSSES)

    def count(self, fate: Fate, nbytes: int, packets: int = 1) -> None:
        """Enter ``packets`` packets of together ``nbytes`` captured bytes."""
        self.packets[fate] += packets
        self.nbytes[fate] += nbytes
