"""Many frames, a column each, on their way to whoever is to have them: loaded together, sent a run at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.flow import Segmentation
from pmutools.net.audience import Audience, Sink
from pmutools.net.outbox import Addresses, Outbox, UdpSink

I64 = npt.NDArray[np.int64]

_NONE = np.zeros(0, np.int64)


@dataclass(frozen=True, slots=True)
class Frames:
    """N frames of streams (handles): ``nbytes`` from ``at`` on in ``wire``. Those not ``wanted`` are not sent.

    ``marks`` is what their departures are known by; ``writes`` how each goes into a byte stream, where any does not go
    whole and at once.
    """

    stream: I64
    at: I64
    nbytes: I64
    wire: npt.NDArray[np.uint8]
    wanted: npt.NDArray[np.bool_]
    marks: I64
    writes: Sequence[Segmentation | None] | None = None

    def __len__(self) -> int:
        return len(self.stream)

    def frame(self, row: int) -> bytes:
        at = int(self.at[row])
        return self.wire[at : at + int(self.nbytes[row])].tobytes()


class Table:
    """Who gets which stream, as columns; made anew when that changes."""

    def __init__(self, audience: Audience) -> None:
        self.version = audience.version
        self.counts = np.array([len(own) for own in audience.sinks], np.int64)
        """(S,) destinations of each stream."""
        udp = [[sink for sink in own if isinstance(sink, UdpSink)] for own in audience.sinks]
        self.others: dict[int, list[Sink]] = {
            stream: [sink for sink in own if not isinstance(sink, UdpSink)]
            for stream, own in enumerate(audience.sinks)
            if len(own) > len(udp[stream])
        }
        """Destinations that are no datagrams, by stream."""
        self.has_others = np.array([stream in self.others for stream in range(len(udp))], np.bool_)
        self.udp_counts = np.array([len(own) for own in udp], np.int64)
        self.udp_firsts = np.cumsum(self.udp_counts) - self.udp_counts
        sinks = [sink for own in udp for sink in own]
        self.boxes = list(dict.fromkeys(sink.outbox for sink in sinks))
        numbers = {box: number for number, box in enumerate(self.boxes)}
        self.single = len(self.boxes) == 1 and not self.others and bool((self.udp_counts == 1).all())
        """Whether every stream has one destination, and all leave by one socket."""
        self.box = np.array([numbers[sink.outbox] for sink in sinks], np.int64)
        """Of each datagram destination, its place in ``boxes``; those of a stream follow each other."""
        self.addresses = Addresses.of([sink.where for sink in sinks])


class _Load(NamedTuple):
    """What one socket has of a cargo: its datagram k is frame ``rows[k]``."""

    outbox: Outbox
    rows: I64
    marks: I64


class Cargo:
    """Frames (N,) with their destinations, as a table has them. One at a time: loading another unloads this one."""

    def __init__(self, frames: Frames, table: Table) -> None:
        self.frames, self.version = frames, table.version
        self.counts: I64 = np.where(frames.wanted, table.counts[frames.stream], 0)
        """(N,) destinations of each frame; 0 for those not wanted."""
        self._table = table
        self._loads: list[_Load] = []
        self.direct: Callable[[int, int], list[int]] | None = None
        """Sends frames by their places at the least cost, where that is all there is to do."""
        if table.single and frames.wanted.all():
            self._others, outbox = _NONE, table.boxes[0]
            outbox.load(frames.wire, frames.at, frames.nbytes, table.addresses.take(frames.stream))
            self._loads.append(_Load(outbox, np.arange(len(frames)), frames.marks))
            self.direct = outbox.direct
            return
        wanted = np.flatnonzero(frames.wanted)
        streams = frames.stream[wanted]
        self._others = wanted[table.has_others[streams]]
        counts = table.udp_counts[streams]
        rows = np.repeat(wanted, counts)
        within = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
        sinks = np.repeat(table.udp_firsts[streams], counts) + within
        for number, outbox in enumerate(table.boxes):
            own = np.flatnonzero(table.box[sinks] == number) if len(table.boxes) > 1 else slice(None)
            chosen, addresses = rows[own], table.addresses.take(sinks[own])
            if len(chosen):
                outbox.load(frames.wire, frames.at[chosen], frames.nbytes[chosen], addresses)
                self._loads.append(_Load(outbox, chosen, frames.marks[chosen]))

    def send(self, first: int, last: int, now_ns: int) -> list[int]:
        """Send frames ``first`` to ``last - 1``; the rows that a destination did not take, once for each that did not.

        ``now_ns`` is monotonic.
        """
        failed: list[int] = []
        for outbox, rows, marks in self._loads:
            low, high = np.searchsorted(rows, (first, last)).tolist()
            if low < high:
                failed += rows[outbox.send(low, high, marks)].tolist()
        if len(self._others):
            low, high = np.searchsorted(self._others, (first, last)).tolist()
            for row in self._others[low:high].tolist():
                frame = self.frames.frame(row)
                write = self.frames.writes[row] if self.frames.writes is not None else None
                for sink in self._table.others[int(self.frames.stream[row])]:
                    if not sink.put(frame, row, now_ns, write):
                        failed.append(row)
        return failed
