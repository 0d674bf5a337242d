"""Recordings, opened: one interface for files of bytes (captures, raw frames) and files of numbers (tables).

A source gives the same content in two forms: :meth:`Source.items`, frame by frame in the order recorded, and
:meth:`Source.blocks`, data frames gathered into column batches. Both hold a bounded part of the file in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import NamedTuple, Protocol

from pmutools.c37118.batch import NO_TIME, STAMP_SOURCES, Batch, decode_batch, encode_batch
from pmutools.c37118.config import StreamConfig, encode_config, frames_in
from pmutools.c37118.constants import FrameType
from pmutools.c37118.demux import DataRun, Demux, Loss, Message, Tally
from pmutools.c37118.framer import Frame
from pmutools.c37118.layout import Layout, layout_of
from pmutools.flow import Chunk, Flow, StampSource, Train
from pmutools.timebase import from_ns

BLOCK_FRAMES = 8192
GATHERED_FRAMES = 1 << 17
"""Of all streams together, waiting to become blocks."""


class Block(NamedTuple):
    """Consecutive data frames of one stream: one flow, one IDCODE, one configuration."""

    flow: Flow
    batch: Batch


class Source(Protocol):
    """A recording that can be read once."""

    path: Path
    kind: str
    """The format found, as in ``pcap`` or ``csv``."""
    tally: Tally

    def items(self) -> Iterator[Message | Loss]:
        """Every frame, and every loss, in the order recorded."""

    def blocks(self) -> Iterator[Block | Message | Loss]:
        """Data frames as blocks; other frames and losses as in :meth:`items`."""

    def defects(self) -> dict[str, int]:
        """What the container itself had wrong or unread, by name; only counts above 0."""


class ByteSource:
    """A recording of bytes: chunks in flow order, demultiplexed."""

    def __init__(
        self,
        path: Path,
        kind: str,
        chunks: Iterable[Chunk],
        defects: Callable[[], dict[str, int]] = dict,
        configs: Iterable[StreamConfig] = (),
        trains: Iterable[Chunk | Train] | None = None,
    ) -> None:
        """``trains`` gives the same as ``chunks``, datagrams of one flow and size together."""
        self.path, self.kind, self.defects = path, kind, defects
        self._chunks = chunks
        self._trains = chunks if trains is None else trains
        self._demux = Demux(configs)
        self.tally = self._demux.tally

    def items(self) -> Iterator[Message | Loss]:
        for chunk in self._chunks:
            yield from self._demux.feed(chunk)
        yield from self._demux.close()

    def blocks(self) -> Iterator[Block | Message | Loss]:
        return gather(self._runs())

    def _runs(self) -> Iterator[Message | Loss | DataRun]:
        demux = self._demux
        for piece in self._trains:
            yield from demux.feed_train(piece) if isinstance(piece, Train) else demux.feed(piece)
        yield from demux.close()


class MessageSource:
    """A recording made as it is read (by a simulation): messages in order."""

    def __init__(self, path: Path, kind: str, messages: Iterable[Message]) -> None:
        self.path, self.kind, self.tally = path, kind, Tally()
        self._messages = messages

    def defects(self) -> dict[str, int]:
        return {}

    def items(self) -> Iterator[Message | Loss]:
        for message in self._messages:
            self.tally.count(message.frame.type, 1, len(message.frame.data))
            yield message

    def blocks(self) -> Iterator[Block | Message | Loss]:
        return gather(self.items())


class TableSource:
    """A recording of numbers: blocks whose frames are encoded when frames are asked for."""

    def __init__(
        self, path: Path, kind: str, blocks: Iterable[Block], defects: Callable[[], dict[str, int]] = dict
    ) -> None:
        self.path, self.kind, self.defects = path, kind, defects
        self._blocks = blocks
        self.tally = Tally()

    def blocks(self) -> Iterator[Block | Message | Loss]:
        for block in self._blocks:
            self.tally.count(FrameType.DATA, len(block.batch), block.batch.config.frame_size)
            yield block

    def items(self) -> Iterator[Message | Loss]:
        shown: dict[tuple[Flow, int], StreamConfig] = {}
        for block in self._blocks:
            for message in frames_of(block, shown):
                self.tally.count(message.frame.type, 1, len(message.frame.data))
                yield message


def frames_of(block: Block, shown: dict[tuple[Flow, int], StreamConfig]) -> Iterator[Message]:
    """The block's frames as messages, its configuration first where ``shown`` lacks it; ``shown`` is updated."""
    flow, batch = block
    config = batch.config
    if not len(batch):
        return
    octets = batch.wire if batch.wire is not None else encode_batch(batch)[0]
    raw, size = octets.tobytes(), config.frame_size
    arrivals = [None if arrival == NO_TIME else arrival for arrival in batch.arrival_ns.tolist()]
    sources = batch.stamp_source.tolist()
    if shown.get((flow, config.idcode)) != config:
        shown[flow, config.idcode] = config
        soc, fracsec = from_ns(int(batch.time_ns[0]), config.time_base)
        frames = frames_in(encode_config(config, soc=soc, fracsec=fracsec))
        for number, data in enumerate(frames, 1):
            frame = Frame(data, arrivals[0], STAMP_SOURCES[sources[0]], 0)
            yield Message(frame, flow, config if number == len(frames) else None)
    for row, arrival in enumerate(arrivals):
        data = raw[row * size : (row + 1) * size]
        yield Message(Frame(data, arrival, STAMP_SOURCES[sources[row]], row * size), flow, config)


class _Run:
    """Data frames of one stream, waiting to become a block."""

    __slots__ = ("arrivals", "config", "frames", "sources")

    def __init__(self, config: StreamConfig) -> None:
        self.config = config
        self.frames: list[bytes] = []
        self.arrivals: list[int] = []
        self.sources: list[StampSource] = []

    def stamps(self) -> list[int]:
        """Indices into STAMP_SOURCES."""
        first = self.sources[0]
        if self.sources.count(first) == len(self.sources):
            return [_CODES[first]] * len(self.sources)
        return [_CODES[source] for source in self.sources]


_CODES = {source: code for code, source in enumerate(STAMP_SOURCES)}
_Place = tuple[Flow, int]
"""A stream: its flow and IDCODE."""


class Gatherer:
    """Gathers data messages into blocks, stream by stream; live tools flush it when they like."""

    def __init__(self, frames: int = BLOCK_FRAMES) -> None:
        self.frames = frames
        self.waiting = 0
        """Frames that are in no block yet."""
        self._runs: dict[_Place, _Run] = {}

    def add(self, message: Message) -> Block | None:
        """Take a data message; a block comes back when one was full or the stream's configuration changed."""
        (data, arrival_ns, source, _), flow, config = message
        assert config is not None
        run, block = self._run(flow, config, 1)
        run.frames.append(data)
        run.arrivals.append(NO_TIME if arrival_ns is None else arrival_ns)
        run.sources.append(source)
        return block

    def add_run(self, frames: DataRun) -> Block | None:
        """:meth:`add` for data frames that came together; they stay in one block."""
        (data, _, arrivals_ns, flow, source), config = frames
        run, block = self._run(flow, config, len(arrivals_ns))
        run.frames.append(data)
        run.arrivals += [NO_TIME if at_ns is None else at_ns for at_ns in arrivals_ns]
        run.sources += [source] * len(arrivals_ns)
        return block

    def _run(self, flow: Flow, config: StreamConfig, count: int) -> tuple[_Run, Block | None]:
        """Where ``count`` more frames go, and what is complete without them."""
        key = (flow, config.idcode)
        run = self._runs.get(key)
        self.waiting += count
        if (
            run is not None
            and len(run.arrivals) + count <= self.frames
            and (run.config is config or run.config == config)
        ):
            return run, None
        block = None
        if run is not None:
            self.waiting -= len(run.arrivals)
            (block,) = _blocks([(key, run)])
        run = self._runs[key] = _Run(config)
        return run, block

    def flush(self, idcode: int | None = None) -> Iterator[Block]:
        """All that is waiting, of the streams of ``idcode`` or of all."""
        if idcode is None:
            runs, self._runs = self._runs, {}
        else:
            runs = {key: run for key, run in self._runs.items() if key[1] == idcode}
            for key in runs:
                del self._runs[key]
        self.waiting -= sum(len(run.arrivals) for run in runs.values())
        yield from _blocks(runs.items())


def _blocks(runs: Iterable[tuple[_Place, _Run]]) -> Iterator[Block]:
    """The blocks of runs; of short ones that are laid out alike many are decoded at once."""
    alike: dict[Layout, list[tuple[_Place, _Run]]] = {}
    waiting = 0
    for key, run in runs:
        alike.setdefault(layout_of(run.config), []).append((key, run))
        waiting += len(run.arrivals)
        if waiting >= BLOCK_FRAMES:
            yield from chain.from_iterable(map(_decoded, alike.values()))
            alike.clear()
            waiting = 0
    yield from chain.from_iterable(map(_decoded, alike.values()))


def _decoded(runs: list[tuple[_Place, _Run]]) -> Iterator[Block]:
    """Blocks of runs that are laid out alike, decoded at once: a call of numpy costs what a hundred frames cost."""
    frames = [b"".join(run.frames) for _, run in runs]
    arrivals = list(chain.from_iterable(run.arrivals for _, run in runs))
    stamps = list(chain.from_iterable(run.stamps() for _, run in runs))
    whole = decode_batch(b"".join(frames), runs[0][1].config, arrivals, stamps, check=False)
    if len(runs) == 1:
        yield Block(runs[0][0][0], whole)
        return
    first = 0
    for ((flow, _), run), data in zip(runs, frames, strict=True):
        last = first + len(run.arrivals)
        yield Block(flow, whole.cut(slice(first, last), run.config, data))
        first = last


def gather(
    items: Iterable[Block | Message | Loss | DataRun], frames: int = BLOCK_FRAMES
) -> Iterator[Block | Message | Loss]:
    """Data messages gathered into blocks of up to ``frames``; everything else passes through.

    When one stream's block is whole, or :data:`GATHERED_FRAMES` wait, those of all streams come: so memory is bounded,
    and streams stay within a block of each other.
    """
    gatherer = Gatherer(frames)
    data = FrameType.DATA
    waiting: dict[_Place, int] = {}
    for item in items:
        if isinstance(item, Message) and item.frame.type is data:
            block, key, count = gatherer.add(item), (item.flow, item.frame.idcode), 1
        elif isinstance(item, DataRun):
            train, config = item
            block, key, count = gatherer.add_run(item), (train.flow, config.idcode), len(train.arrivals_ns)
        else:
            yield item
            continue
        if block is not None:
            yield block
        waiting[key] = waiting.get(key, 0) + count
        if waiting[key] >= frames or gatherer.waiting >= GATHERED_FRAMES:
            yield from gatherer.flush()
            waiting = {}
    yield from gatherer.flush()
