"""What was received in bulk, parted: runs of data frames that can be taken together, and the rest one by one.

A group of rows becomes a run if its frames are good data frames that the configuration in force fits, of a stream that
announces no change, and nothing else of the same round may bear on how they are read: another frame of the same stream,
anything unusual on the same connection, or, where the configuration is one that another flow of the host has shown,
a configuration of that IDCODE from that host. Frames that wait for a configuration, as others of their stream do, stay
together likewise. All other rows become chunks, in the order in which they came.
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
    idcode: int
    config: StreamConfig | None
    """None: they wait for one."""
    route: Route | None
    """None: nobody wants them."""


class Harvest(NamedTuple):
    """What is to be fed first, one by one; runs, with their routes; and frames that are to wait."""

    chunks: list[Chunk]
    runs: list[tuple[DataRun, Route | None]]
    waiting: list[Train]


def harvest(intake: Intake, demux: Demux, routes: Routes) -> Harvest:
    """All that is in the intake's columns."""
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
    found = Harvest(chunks, [], [])
    for each in candidates:
        train = frames.train(each)
        if each.config is not None:
            found.runs.append((DataRun(train, each.config), each.route))
        else:
            found.waiting.append(train)
    return found


def _known(intake: Intake, demux: Demux, routes: Routes, rows: Rows, groups: Groups) -> Iterator[Candidate]:
    """The groups whose flow and head are those of data frames that a configuration fits, or that wait for one."""
    firsts = groups.order[groups.starts[:-1]]
    senders, heads = rows.senders[firsts].tobytes(), groups.heads.astype("<u8").tobytes()
    size = rows.senders.shape[1]
    for number, source in enumerate(rows.sources[firsts].tolist()):
        flow = intake.flow(source, senders[number * size : (number + 1) * size])
        head = heads[number * 8 : number * 8 + HEAD_BYTES]
        config = demux.fitting(flow, head)
        if config is not None or demux.waits(flow, head):
            idcode = head[4] << 8 | head[5]
            yield Candidate(number, flow, idcode, config, routes.find(flow, idcode))


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
        routed = ((each.number, each.route) for each in candidates if each.config is not None)
        told[[number for number, route in routed if route is not None and route.role.announced]] = True
        wrong |= announcing != np.where(told, np.diff(self._groups.starts), 0)
        wrongs = wrong.tolist()
        return [each for each in candidates if not wrongs[each.number]]

    def _announcing(self, candidates: Sequence[Candidate]) -> NDArray[np.bool_]:
        """Frames of candidates, among all frames in order, that announce a change."""
        alike: dict[tuple[int, tuple[int, ...]], list[int]] = {}
        for each in candidates:
            if each.config is not None:
                alike.setdefault((self._size[each.number], each.config.stat_offsets), []).append(each.number)
        found = np.zeros(len(self._groups.order), np.bool_)
        for (place, offsets), numbers in alike.items():
            first, last, octets = self._octets[place]
            mine = np.zeros(last - first, np.bool_)
            mine[np.array(numbers) - first] = True
            rows = np.flatnonzero(np.repeat(mine, np.diff(self._groups.starts[first : last + 1])))
            found[rows + self._starts[first]] = sorting.announcing(octets, offsets)[rows]
        return found

    def train(self, candidate: Candidate) -> Train:
        """The frames of a candidate."""
        number = candidate.number
        first, last = self._starts[number], self._starts[number + 1]
        first_group, _, octets = self._octets[self._size[number]]
        base = self._starts[first_group]
        data = octets[first - base : last - base].tobytes()
        return Train(data, octets.shape[1], self._arrivals_ns[first:last], candidate.flow, SOURCES[self._codes[first]])


@dataclass
class _Touched:
    """What the odd ones may bear on."""

    streams: set[tuple[Flow, int]] = field(default_factory=set)
    connections: set[Flow] = field(default_factory=set)
    configured: set[tuple[str, int | None]] = field(default_factory=set)
    """Hosts and IDCODEs of which a configuration has come; None: perhaps of any."""

    def concerns(self, candidate: Candidate, demux: Demux) -> bool:
        flow, idcode = candidate.flow, candidate.idcode
        if flow in self.connections or (flow, idcode) in self.streams:
            return True
        if not self.configured or not _takes_others(candidate, demux):
            return False
        host = flow.host
        return (host, idcode) in self.configured or (host, None) in self.configured


def _touched(chunks: Sequence[Chunk], candidates: Sequence[Candidate], demux: Demux) -> _Touched:
    """Which streams the frames in ``chunks`` belong to, as far as candidates need to know."""
    touched = _Touched()
    flows = {each.flow for each in candidates}
    hosts = {each.flow.host for each in candidates if _takes_others(each, demux)}
    framer = Framer(streaming=False)
    for chunk in chunks:
        flow, host = chunk.flow, chunk.flow.host
        if flow.is_stream:
            touched.connections.add(flow)
            touched.configured.add((host, None))
        elif flow in flows or host in hosts:
            for frame in framer.feed(chunk.data):
                if isinstance(frame, Frame):
                    touched.streams.add((flow, frame.idcode))
                    if frame.type.is_config:
                        touched.configured.add((host, frame.idcode))
    return touched


def _takes_others(candidate: Candidate, demux: Demux) -> bool:
    """Whether its frames may be read by a configuration that another flow shows."""
    return candidate.config is None or demux.is_borrowed(candidate.flow, candidate.idcode)
