"""What the pipeline makes of a frame, and the ledger's row about it."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

from pmutools.c37118.config import StreamConfig
from pmutools.flow import Segmentation


class Fate(StrEnum):
    """What became of a copy of a frame."""

    SENT = "sent"
    LOST = "lost"
    """By a loss model, or by a full queue of the rate stage."""
    DROPPED = "dropped"
    """By ``drop``."""
    DISABLED = "disabled"
    SKIPPED = "skipped"
    """Due, but no client wanted it."""
    FAILED = "failed"
    """The operating system refused it, or a fault cut its connection."""


class Outgoing(NamedTuple):
    """One copy of a frame after the pipeline. ``offset_ns`` counts from the start of play, all delays included.

    ``copy`` is 0 for the frame itself, 1, 2... for duplicates; ``delay_ns`` is what the delay stage added.
    ``config`` is the configuration that ``data`` follows (None: the source's own) and ``notice`` whether one that
    differs from the frame's before is sent unasked. ``write`` is for byte streams: how the frame is written (None:
    whole, at once).
    """

    index: int  # type: ignore[assignment]  # not tuple.index
    copy: int
    data: bytes
    offset_ns: int
    fate: Fate = Fate.SENT
    delay_ns: int = 0
    marks: tuple[str, ...] = ()
    config: StreamConfig | None = None
    notice: bool = True
    write: Segmentation | None = None
    tag: object = None
    """Whatever came with the frame."""

    @property
    def faults(self) -> str:
        """The ledger's comma list, e.g. ``delay:12.3ms,corrupt:1bit``."""
        delay = (f"delay:{self.delay_ns / 1e6:.6g}ms",) if self.delay_ns else ()
        return ",".join(delay + self.marks)


class LedgerRow(NamedTuple):
    """One copy of one frame, as planned and as done; times in ns of POSIX UTC, None where it never happened."""

    stream: str
    index: int  # type: ignore[assignment]  # not tuple.index
    copy: int
    source_time_ns: int
    """Stamp as recorded."""
    time_ns: int
    """Stamp as sent."""
    offset_ns: int
    """When it was to leave, from the start of play."""
    scheduled_ns: int
    sent_ns: int | None
    tx_stamp_ns: int | None
    fate: str
    faults: str
    nbytes: int


UNREPEATABLE = frozenset(("time_ns", "scheduled_ns", "sent_ns", "tx_stamp_ns"))
"""The columns that depend on when a run took place; one source, profile and seed repeat all others."""
