"""What was received in bulk, parted: runs of data frames that can be taken together, and the rest one by one.

A group of rows becomes a run if its frames are good data frames that the configuration in force fits, of a stream that
announces no change, and nothing else of the same round may bear on how they are read: another frame of the same stream,
anything unusual on the same connection, or, where the configuration is one that another flow of the host has shown,
any configuration from that host. All other rows become chunks, in the order in which they came.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.demux import DataRun, Demux
from pmutools.c37118.framer import Frame, Framer
from pmutools.flow import Chunk, Flow, Train
from pmutools.linux_receive import SOURCES, Rows
from pmutools.net import sorting
from pmutools.net.intake import Intake
from pmutools.net.routes import Route, Routes
from pmutools.net.sorting import HEAD_BYTES, Groups


class Candidate(NamedTuple):
    """A group whose frames are of a known kind, and whose stream's they are."""

    number: int
    flow: Flow
    config: StreamConfig
    route: Route | None
    """None: nobody wants it."""


def harvest(intake: Intake, demux: Demux, routes: Routes) -> tuple[list[Chunk], list[tuple[DataRun, Route | None]]]:
    """The chunks, to be fed first, and the runs."""
    rows = intake.columns.look()
    groups = sorting.group(rows)
    frames = _Frames(rows, groups)
    candidates = frames.judged(list(_known(intake, demux, routes, rows, groups)))
    chunks = _chunks(intake, rows, _odd(rows, groups, candidates))
    if chunks and candidates:
        touched = _touched(chunks, candidates, demux)
        kept = [each for each in candidates if not touched.concerns(each, demux)]
        if len(kept) < len(candidates):
            candidates = kept
            chunks = _chunks(intake, rows, _odd(rows, groups, kept))
    return chunks, [(frames.run(each), each.route) for each in candidates]


def _known(intake: Intake, demux: Demux, routes: Routes, rows: Rows, groups: Groups) -> Iterator[Candidate]:
    """The groups whose flow and head are those of data frames that a configuration fits."""
    firsts = groups.order[groups.starts[:-1]]
    senders, heads = rows.senders[firsts].tobytes(), groups.heads.astype("<u8").tobytes()
    size = rows.senders.shape[1]
    for number, source in enumerate(rows.sources[firsts].tolist()):
        flow = intake.flow(source, senders[number * size : (number + 1) * size])
        config = demux.fitting(flow, heads[number * 8 : number * 8 + HEAD_BYTES])
        if config is not None:
            yield Candidate(number, flow, config, routes.find(flow, config.idcode))


def _odd(rows: Rows, groups: Groups, candidates: Sequence[Candidate]) -> NDArray[np.bool_]:
    """(N,) the rows that are none of the candidates'."""
    chosen = np.zeros(len(groups.heads), np.bool_)
    chosen[[each.number for each in candidates]] = True
    odd = np.ones(len(rows.sizes), np.bool_)
    odd[groups.order[np.repeat(chosen, np.diff(groups.starts))]] = False
    return odd


def _chunks(intake: Intake, rows: Rows, odd: NDArray[np.bool_]) -> list[Chunk]:
    """Some rows, one by one."""
    columns = intake.columns
    numbers = np.flatnonzero(odd)
    stamps = zip(rows.arrivals_ns[numbers].tolist(), rows.stamp_sources[numbers].tolist(), strict=True)
    sources = rows.sources[numbers].tolist()
    return [
        Chunk(columns.datagram(row), arrival_ns, intake.flow(source, rows.senders[row].tobytes()), SOURCES[code])
        for row, source, (arrival_ns, code) in zip(numbers.tolist(), sources, stamps, strict=True)
    ]


class _Frames:
    """The frames of all groups, by FRAMESIZE, and what they show."""

    def __init__(self, rows: Rows, groups: Groups) -> None:
        self._groups = groups
        self._starts: list[int] = groups.starts.tolist()
        self._octets = sorting.octets_by_size(rows, groups)
        self._size = [place for place, (first, last, _) in enumerate(self._octets) for _ in range(first, last)]
        """By group: which of the FRAMESIZEs it has."""
        self._arrivals_ns: list[int] = rows.arrivals_ns[groups.order].tolist()
        self._codes = rows.stamp_sources[groups.order]

    def judged(self, candidates: Sequence[Candidate]) -> list[Candidate]:
        """The candidates whose frames are good, stamped alike, and announce nothing that is not known."""
        if not candidates:
            return []
        begins = self._groups.starts[:-1]
        bad = np.concatenate([sorting.bad_chks(octets) for _, _, octets in self._octets])
        wrong = self._groups.mixed | np.logical_or.reduceat(bad, begins)
        wrong |= np.minimum.reduceat(self._codes, begins) != np.maximum.reduceat(self._codes, begins)
        announcing = np.add.reduceat(self._announcing(candidates), begins, dtype=np.int64)
        told = np.zeros(len(begins), np.bool_)
        told[[each.number for each in candidates if each.route is not None and each.route.role.announced]] = True
        wrong |= announcing != np.where(told, np.diff(self._groups.starts), 0)
        wrongs = wrong.tolist()
        return [each for each in candidates if not wrongs[each.number]]

    def _announcing(self, candidates: Sequence[Candidate]) -> NDArray[np.bool_]:
        """Frames of candidates, among all frames in order, that announce a change."""
        alike: dict[tuple[int, tuple[int, ...]], list[int]] = {}
        for each in candidates:
            alike.setdefault((self._size[each.number], each.config.stat_offsets), []).append(each.number)
        found = np.zeros(len(self._groups.order), np.bool_)
        for (place, offsets), numbers in alike.items():
            first, last, octets = self._octets[place]
            mine = np.zeros(last - first, np.bool_)
            mine[np.array(numbers) - first] = True
            rows = np.flatnonzero(np.repeat(mine, np.diff(self._groups.starts[first : last + 1])))
            found[rows + self._starts[first]] = sorting.announcing(octets, offsets)[rows]
        return found

    def run(self, candidate: Candidate) -> DataRun:
        """The frames of a candidate."""
        number, flow, config, _ = candidate
        first, last = self._starts[number], self._starts[number + 1]
        first_group, _, octets = self._octets[self._size[number]]
        base = self._starts[first_group]
        data = octets[first - base : last - base].tobytes()
        source = SOURCES[self._codes[first]]
        return DataRun(Train(data, config.frame_size, self._arrivals_ns[first:last], flow, source), config)


@dataclass
class _Touched:
    """What the odd ones may bear on."""

    streams: set[tuple[Flow, int]] = field(default_factory=set)
    connections: set[Flow] = field(default_factory=set)
    hosts: set[str] = field(default_factory=set)
    """From which a configuration may have come."""

    def concerns(self, candidate: Candidate, demux: Demux) -> bool:
        flow, idcode = candidate.flow, candidate.config.idcode
        if flow in self.connections or (flow, idcode) in self.streams:
            return True
        return bool(self.hosts) and _host(flow) in self.hosts and demux.is_borrowed(flow, idcode)


def _touched(chunks: Sequence[Chunk], candidates: Sequence[Candidate], demux: Demux) -> _Touched:
    """Which streams the frames in ``chunks`` belong to, as far as candidates need to know."""
    touched = _Touched()
    flows = {each.flow for each in candidates}
    hosts = {_host(each.flow) for each in candidates if demux.is_borrowed(each.flow, each.config.idcode)}
    framer = Framer(streaming=False)
    for chunk in chunks:
        flow, host = chunk.flow, _host(chunk.flow)
        if flow.is_stream:
            touched.connections.add(flow)
            touched.hosts.add(host)
        elif flow in flows or host in hosts:
            for frame in framer.feed(chunk.data):
                if isinstance(frame, Frame):
                    touched.streams.add((flow, frame.idcode))
                    if frame.type.is_config:
                        touched.hosts.add(host)
    return touched


def _host(flow: Flow) -> str:
    return flow.source.rpartition(":")[0]
