"""From a sliding window to captured packets: what both file grammars share.

A grammar runs over sound records at full speed, and is asked to judge only what stopped it: a record that reaches out
of view, the end of the file, or damage. Every byte of the file is a packet's, overhead, skipped or cut.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from pmutools.formats.capture.tally import Tally
from pmutools.formats.capture.window import BLOCK, Window

Ints = npt.NDArray[np.int64]

MAX_PACKET = 1 << 20
"""A longer packet is taken for damage (libpcap's own limit is 262144; loopback with BIG TCP reaches 512 KiB)."""

LOOK = 4 * MAX_PACKET
"""Bytes that a judgement or the proof of a search result may look at."""

RUN = 4096
"""Records taken at a time: enough to make light of numpy's overhead, few enough to retrace after damage."""

NO_STAMP = -(1 << 63)
"""In :attr:`Records.arrival_ns`: the file has no stamp for this packet."""

_VIEW = LOOK + BLOCK


class Records(NamedTuple):
    """N captured packets, each ``data[start:stop]``."""

    data: bytes
    start: Ints
    stop: Ints
    wire_length: Ints
    arrival_ns: Ints
    linktype: Ints


class Verdict(NamedTuple):
    """On the record where a run stopped: it is good up to ``kept`` (where it starts, if it is none of ours), and
    reading goes on at ``resume``. ``cut``: the bytes between are the file's cut tail. ``need``: ask again with as
    many bytes in view. ``record``: the packet, if there is one up to ``kept``."""

    kept: int
    resume: int
    cut: bool = False
    need: int = 0
    record: Records | None = None


class Grammar(Protocol):
    """One file's record structure."""

    def run(self, data: bytes, pos: int) -> tuple[Records, int]:
        """The packets of sound records from ``pos`` on, :data:`RUN` at most, and where the next record starts."""

    def judge(self, data: bytes, pos: int, ended: bool) -> Verdict:
        """Decide on the record at ``pos``, with more than :data:`LOOK` bytes in view or the end of the file."""


def read_records(window: Window, tally: Tally, grammar: Grammar) -> Iterator[Records]:
    """The packets of the rest of a file, at most :data:`RUN` at a time."""
    pos = 0
    in_gap = False
    while True:
        data = window.data
        records, stop = grammar.run(data, pos)
        if stop > pos:
            tally.overhead_bytes += stop - pos - _captured(records)
            pos, in_gap = stop, False
            yield records
            continue
        left = len(data) - pos
        if left < _VIEW and not window.ended:
            window.advance(pos, BLOCK if left < BLOCK else _VIEW)
            pos = 0
            continue
        if not left:
            return
        verdict = grammar.judge(data, pos, window.ended)
        if verdict.need:
            window.advance(pos, verdict.need)
            pos = 0
            continue
        if verdict.record is not None:
            tally.overhead_bytes += verdict.kept - pos - _captured(verdict.record)
            in_gap = False
            yield verdict.record
        passed = verdict.resume - verdict.kept
        if verdict.cut:
            tally.cut_bytes += passed
        elif passed:
            tally.skipped_bytes += passed
            tally.gaps += not in_gap
            in_gap = True
        pos = verdict.resume


def _captured(records: Records) -> int:
    return int((records.stop - records.start).sum())


def gather(data: bytes, positions: Ints, layout: np.dtype[Any]) -> npt.NDArray[Any]:
    """The structures of ``layout`` that lie at ``positions`` of ``data``, aligned or not; shape (N,)."""
    if not len(positions):
        return np.empty(0, layout)
    places = len(data) - layout.itemsize + 1
    raw = np.ndarray((places,), np.dtype(("V", layout.itemsize)), data, 0, (1,))
    return raw[positions].view(layout)
