"""Chunks of any number of flows -> messages: frames together with the configuration they are to be read by.

Configurations are kept per flow and IDCODE, of streams that somebody wants. A data frame whose flow has shown none is
matched to another flow from the same host (commands over TCP with data over UDP) if exactly one fits by IDCODE and
size. Data that comes before its configuration is held, within :class:`Bounds`, and given out when a configuration of
the right frame size comes; what is still held at the end, or overflows, becomes ``Skipped(NO_CONFIG)``: of one stream
the oldest frames, of all streams the one that has waited longest. The frames come with that, in order, for who keeps
bytes.

A flow that never shows a good frame is not C37.118 traffic: its bytes are counted in ``ignored``, not skipped.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar

from pmutools.c37118.checksum import chk_array
from pmutools.c37118.config import (
    FIRST_FRAGMENT,
    LAST_FRAGMENT,
    StreamConfig,
    decode_config,
    decode_config_body,
    is_fragment,
)
from pmutools.c37118.config_kinds import abridges
from pmutools.c37118.constants import CHK_SIZE, PREFIX_SIZE, FrameType
from pmutools.c37118.framer import Frame, Framer, Skipped, SkipReason
from pmutools.c37118.prefix import decode_prefix
from pmutools.errors import WireError
from pmutools.flow import Chunk, Flow, Train, host_of

FLOWS = 1 << 16
_new = tuple.__new__  # what calling a NamedTuple comes to, for half the time
_DATA = FrameType.DATA  # looking a member up takes longer than most of what is done with it


class Bounds(NamedTuple):
    """What is kept at most, whatever comes."""

    flows: int = FLOWS
    """Remembered at once; when another comes (a flood of spoofed sources), one is ended that has long been silent."""
    held_bytes: int = 4 << 20
    """Of data frames of one stream that wait for its configuration."""
    all_held_bytes: int = 64 << 20
    longest_config: int = 1 << 20
    """Bytes; a longer one, in one frame or in several, is not decoded, as if it made no sense. To decode 8 KiB takes
    about a millisecond."""
    all_config_bytes: int = 64 << 20
    """Of all configurations, as they came; beyond it a flow is ended that has long been silent."""
    all_fragment_bytes: int = 16 << 20
    """Of CFG-3 in several frames that are not complete; beyond it those begun first are given up."""


class Message(NamedTuple):
    """A verified frame.

    ``config`` is the one in force for a data frame, the decoded one for a configuration frame (None if its content is
    no configuration), and for headers and commands that of their stream, where it is known. A CFG-2 that says no more
    than the CFG-3 in force leaves that in force, and counts as it. Of streams that nobody wants it is None.
    """

    frame: Frame
    flow: Flow
    config: StreamConfig | None


class DataRun(NamedTuple):
    """Verified data frames of one stream, one a datagram: many messages at little cost."""

    train: Train
    config: StreamConfig


class Loss(NamedTuple):
    """Bytes of ``flow`` that are in no message. ``undecoded``: a whole data frame, for which no configuration came."""

    skipped: Skipped
    flow: Flow
    undecoded: Frame | None = None


@dataclass
class Tally:
    """Where the input bytes went: ``fed == framed + skipped + ignored + pending``."""

    fed: int = 0
    framed: int = 0
    ignored: int = 0
    ignored_flows: int = 0
    frames: dict[FrameType, int] = field(default_factory=dict)
    skipped: dict[SkipReason, int] = field(default_factory=dict)
    """Bytes by reason."""

    @property
    def skipped_bytes(self) -> int:
        return sum(self.skipped.values())

    def count(self, kind: FrameType, frames: int, size: int) -> None:
        """Frames of ``size`` bytes each that came in as such, not found in bytes."""
        self.frames[kind] = self.frames.get(kind, 0) + frames
        self.framed += frames * size
        self.fed += frames * size


BOUNDS = Bounds()
_T = TypeVar("_T")
_Place = tuple[str, int]
"""A host and an IDCODE."""


def _forget(table: dict[_Place, dict[Flow, _T]], place: _Place, flow: Flow) -> None:
    """Take ``flow`` out, and with the last flow the place, so that a table is no larger than the flows there are."""
    flows = table.get(place, {})
    flows.pop(flow, None)
    if not flows:
        table.pop(place, None)


@dataclass
class _Held:
    frames: deque[Frame] = field(default_factory=deque)
    nbytes: int = 0


class _FlowState:
    def __init__(self, flow: Flow) -> None:
        self.flow = flow
        self.host = flow.host
        self.framer = Framer(streaming=flow.is_stream)
        self.configs: dict[int, StreamConfig] = {}
        self.config_bytes: dict[int, int] = {}
        """Of those that it has shown itself, as they came."""
        self.fitting: dict[bytes, StreamConfig] = {}
        """The same by the first six bytes of data frames that they fit (SYNC, FRAMESIZE, IDCODE): the short way."""
        self.heads: dict[int, list[bytes]] = {}
        """These first bytes, by IDCODE."""
        self.borrowed: set[int] = set()
        """IDCODEs whose configuration another flow has shown."""
        self.held: dict[int, _Held] = {}
        self.proven = False
        self.early: list[Skipped] = []
        self.early_bytes = 0
        self.fresh = False
        """Whether it was fed again since it was met, or since a flow to end was last looked for."""

    def fit(self, head: bytes, config: StreamConfig) -> None:
        """Frames that begin with ``head`` are read by ``config`` from now on."""
        self.fitting[head] = config
        self.heads.setdefault(config.idcode, []).append(head)

    def unfit(self, idcode: int) -> None:
        """The stream has another configuration now, or none."""
        for head in self.heads.pop(idcode, ()):
            del self.fitting[head]


def _all_good(train: Train) -> bool:
    """Whether every datagram begins as the first does, and every CHK holds."""
    import numpy as np

    datagrams = np.frombuffer(train.data, np.uint8).reshape(-1, train.size)
    return bool((datagrams[:, :6] == datagrams[0, :6]).all() and not chk_array(datagrams).any())


class Demux:
    """Feed chunks, get messages; see the module's text. Not thread-safe."""

    def __init__(
        self,
        configs: Iterable[StreamConfig] = (),
        *,
        bounds: Bounds = BOUNDS,
        wants: Callable[[Flow, int], bool] = lambda flow, idcode: True,
    ) -> None:
        """``configs`` are known beforehand, for streams that may never send theirs.

        ``wants(flow, idcode)``: whether anything is to be kept of a stream.
        """
        self.tally = Tally()
        self._bounds, self._wants = bounds, wants
        self._config_bytes = 0
        self._saved = {config.idcode: config for config in configs}
        self._flows: dict[Flow, _FlowState] = {}
        self._configs: dict[_Place, dict[Flow, StreamConfig]] = {}
        self._waiting: dict[_Place, dict[Flow, _FlowState]] = {}
        """Who holds data, the place that has waited longest first."""
        self._held_bytes = 0
        self.runs = 0
        """Runs of bytes in no frame so far, skipped or to be ignored; of a stream, a read may cut one in two."""
        self.held_frames = 0
        """Data frames that wait for a configuration now."""
        self.put_on_hold: list[int] = []
        """IDCODEs of the data frames that the last :meth:`feed` has put on hold."""
        self.too_long: list[int] = []
        """IDCODEs of the configurations that the last :meth:`feed` found too long to be decoded."""
        self._borrowers: dict[_Place, dict[Flow, _FlowState]] = {}
        self._fragments: dict[tuple[Flow, int], tuple[int, bytearray]] = {}
        """Of each CFG-3 that is not complete: the next CONT_IDX, and what there is; the longest untouched first."""
        self._fragment_bytes = 0

    def feed(self, chunk: Chunk) -> list[Message | Loss]:
        """Messages and losses that this chunk completes."""
        out: list[Message | Loss] = []
        data, arrival_ns, flow, stamp_source, lost_before = chunk
        state = self._flows.get(flow)
        if state is None:
            if len(self._flows) >= self._bounds.flows:
                out += self.end(self._silent_flow())
            state = self._flows[flow] = _FlowState(flow)
        else:
            state.fresh = True
        if self.put_on_hold:
            self.put_on_hold.clear()
        if self.too_long:
            self.too_long.clear()
        tally = self.tally
        tally.fed += len(data)
        for item in state.framer.feed(data, arrival_ns, stamp_source, lost_before):
            if isinstance(item, Frame) and (config := state.fitting.get(item.data[:6])) is not None:
                tally.framed += len(item.data)
                tally.frames[_DATA] += 1
                out.append(_new(Message, (item, flow, config)))
            else:
                self._take(state, item, out)
        return out

    def feed_train(self, train: Train) -> list[Message | Loss | DataRun]:
        """:meth:`feed` of all datagrams of a train; they stay together where they are good frames of one known kind."""
        config = self.fitting(train.flow, train.data[:6])
        if (
            config is not None
            and config.frame_size == train.size
            and not self.is_borrowed(train.flow, config.idcode)  # another flow may change it between two of these
            and _all_good(train)
            and self.take(run := DataRun(train, config))
        ):
            return [run]
        return [item for chunk in train.chunks() for item in self.feed(chunk)]

    def fitting(self, flow: Flow, head: bytes) -> StreamConfig | None:
        """The configuration that whole frames of ``flow`` would be read by, by their first six bytes.

        None: they would not, or not yet be data frames of a known kind; only :meth:`feed` can tell.
        """
        state = self._flows.get(flow)
        if state is None or (flow.is_stream and state.framer.pending):
            return None
        return state.fitting.get(head)

    def is_borrowed(self, flow: Flow, idcode: int) -> bool:
        """Whether the stream's configuration is one that another flow has shown, or a saved one."""
        state = self._flows.get(flow)
        return state is not None and idcode in state.borrowed

    def take(self, run: DataRun) -> bool:
        """Take whole, good frames, all with a head that :meth:`fitting` knows; false where that has changed meanwhile.

        Then they are to be fed one by one.
        """
        (data, size, arrivals_ns, flow, _), config = run
        state = self._flows.get(flow)
        if state is None or state.fitting.get(data[:6]) is not config:
            return False
        state.fresh = True
        state.framer.pass_over(len(data))
        self.tally.count(_DATA, len(arrivals_ns), size)
        return True

    def waits(self, flow: Flow, head: bytes) -> bool:
        """Whether whole frames of ``flow`` that begin with ``head`` would be put on hold, as others of theirs are.

        False: only :meth:`feed` can tell.
        """
        state = self._flows.get(flow)
        if state is None or (flow.is_stream and state.framer.pending):
            return False
        size, idcode = head[2] << 8 | head[3], head[4] << 8 | head[5]
        if idcode not in state.held:
            return False
        known = [*self._configs.get((state.host, idcode), {}).values(), *filter(None, (self._saved.get(idcode),))]
        return all(config.frame_size != size for config in known)

    def hold(self, train: Train) -> bool:
        """Put whole, good frames on hold, all with a head that :meth:`waits` knows; false where that is not so simple.

        Then they are to be fed one by one.
        """
        data, size, arrivals_ns, flow, source = train
        if not self.waits(flow, data[:6]):
            return False
        state = self._flows[flow]
        held = state.held[data[4] << 8 | data[5]]
        if held.nbytes + len(data) > self._bounds.held_bytes:
            return False
        if self._held_bytes + len(data) > self._bounds.all_held_bytes:
            return False
        offset = state.framer.offset
        places = range(0, len(data), size)
        held.frames += [
            _new(Frame, (data[at : at + size], arrival_ns, source, offset + at))
            for at, arrival_ns in zip(places, arrivals_ns, strict=True)
        ]
        held.nbytes += len(data)
        self._now_hold(len(arrivals_ns), len(data))
        self.tally.fed += len(data)
        state.fresh = True
        state.framer.pass_over(len(data))
        return True

    def end(self, flow: Flow) -> list[Message | Loss]:
        """A connection or file is over: frame or skip what is pending in it, and forget it."""
        out: list[Message | Loss] = []
        if state := self._flows.pop(flow, None):
            self._end(state, out)
        return out

    def close(self) -> list[Message | Loss]:
        """End of all input."""
        out: list[Message | Loss] = []
        for state in self._flows.values():
            self._end(state, out)
        self._flows.clear()
        return out

    @property
    def pending(self) -> int:
        """Bytes held back, waiting for more."""
        return sum(
            state.framer.pending + state.early_bytes + sum(held.nbytes for held in state.held.values())
            for state in self._flows.values()
        )

    def ignore(self, flow: Flow, idcode: int) -> None:
        """Give up what is held of a stream that nobody wants; its bytes count as ignored."""
        state = self._flows.get(flow)
        if state is not None and (held := state.held.pop(idcode, None)) is not None:
            _forget(self._waiting, (state.host, idcode), flow)
            self._now_hold(-len(held.frames), -held.nbytes)
            self.tally.ignored += held.nbytes

    def _silent_flow(self) -> Flow:
        """The first flow that was not fed since it was last looked at here; the others go to the end of the line."""
        flows = self._flows
        while True:
            flow, state = next(iter(flows.items()))
            if not state.fresh:
                return flow
            state.fresh = False
            flows[flow] = flows.pop(flow)

    def _end(self, state: _FlowState, out: list[Message | Loss]) -> None:
        for item in state.framer.close():
            self._take(state, item, out)
        for idcode in list(state.held):
            self._give_up(state, idcode, out)
        self._config_bytes -= sum(state.config_bytes.values())
        for idcode in state.configs:
            _forget(self._configs, (state.host, idcode), state.flow)
            _forget(self._borrowers, (state.host, idcode), state.flow)
        if not state.proven and state.early_bytes:
            self.tally.ignored += state.early_bytes
            self.tally.ignored_flows += 1

    def _take(self, state: _FlowState, item: Frame | Skipped, out: list[Message | Loss]) -> None:
        if isinstance(item, Skipped):
            self.runs += 1
            self._lose(state, item, out)
            return
        if not state.proven:
            state.proven = True
            early, state.early, state.early_bytes = state.early, [], 0
            for skipped in early:
                self._lose(state, skipped, out)
        kind = item.type
        if not self._wants(state.flow, item.idcode):
            self._emit(Message(item, state.flow, None), kind, out)
        elif kind is FrameType.DATA:
            config = state.configs.get(item.idcode)
            if config is None or config.frame_size != len(item.data):
                config = self._find_config(state, item)
                if config is None:
                    self._hold(state, item, out)
                    return
            else:
                state.fit(item.data[:6], config)
            self._emit(Message(item, state.flow, config), kind, out)
        elif kind.is_config:
            self._configure(state, item, kind, out)
        else:
            self._emit(Message(item, state.flow, self._context(state.flow, item)), kind, out)

    def _context(self, flow: Flow, frame: Frame) -> StreamConfig | None:
        """The configuration of the stream that a header comes from or a command goes to, for its TIME_BASE."""
        end = flow.destination if frame.type is FrameType.COMMAND else flow.source
        known = self._configs.get((host_of(end), frame.idcode), {})
        return next(iter(known.values()), None)

    def _emit(self, message: Message, kind: FrameType, out: list[Message | Loss]) -> None:
        tally = self.tally
        tally.framed += len(message.frame.data)
        tally.frames[kind] = tally.frames.get(kind, 0) + 1
        out.append(message)

    def _lose(self, state: _FlowState, skipped: Skipped, out: list[Message | Loss], frame: Frame | None = None) -> None:
        if not state.proven:
            if state.early and len(state.early) >= 1024:  # a busy unrelated flow: keep the sum, not the list
                last = state.early[-1]
                state.early[-1] = last._replace(nbytes=last.nbytes + skipped.nbytes)
            else:
                state.early.append(skipped)
            state.early_bytes += skipped.nbytes
            return
        self.tally.skipped[skipped.reason] = self.tally.skipped.get(skipped.reason, 0) + skipped.nbytes
        out.append(Loss(skipped, state.flow, frame))

    def _configure(self, state: _FlowState, frame: Frame, kind: FrameType, out: list[Message | Loss]) -> None:
        config: StreamConfig | None = None
        with suppress(WireError):  # a good frame whose content is not: it stays a message, with no configuration
            if is_fragment(frame.data):
                config = self._join(state, frame)
            elif len(frame.data) <= self._bounds.longest_config:
                config = decode_config(frame.data)[1]
            elif kind.rules_data:
                self.too_long.append(frame.idcode)
        current = state.configs.get(config.idcode) if config is not None else None
        if config is not None and current is not None and abridges(config, current):
            config = current
        self._emit(Message(frame, state.flow, config), kind, out)
        if config is None or not kind.rules_data:
            return
        place = (state.host, config.idcode)
        if current is None or current != config:
            state.configs[config.idcode] = config
            size = len(config.body)
            self._config_bytes += size - state.config_bytes.get(config.idcode, 0)
            state.config_bytes[config.idcode] = size
            state.unfit(config.idcode)
            state.borrowed.discard(config.idcode)
            for other in self._borrowers.pop(place, {}).values():  # they look again
                if config.idcode in other.borrowed:
                    del other.configs[config.idcode]
                    other.unfit(config.idcode)
                    other.borrowed.discard(config.idcode)
        self._configs.setdefault(place, {})[state.flow] = state.configs[config.idcode]
        for other in list(self._waiting.get(place, {}).values()):
            self._release(other, state.configs[config.idcode], out)
        while self._config_bytes > self._bounds.all_config_bytes and (flow := self._silent_flow()) != state.flow:
            out += self.end(flow)

    def _release(self, state: _FlowState, config: StreamConfig, out: list[Message | Loss]) -> None:
        held = state.held[config.idcode]
        fitting = [frame for frame in held.frames if len(frame.data) == config.frame_size]
        held.frames = deque(frame for frame in held.frames if len(frame.data) != config.frame_size)
        held.nbytes -= len(fitting) * config.frame_size
        self._now_hold(-len(fitting), -len(fitting) * config.frame_size)
        if not held.frames:
            self._give_up(state, config.idcode, out)
        for frame in fitting:
            self._emit(Message(frame, state.flow, config), FrameType.DATA, out)

    def _find_config(self, state: _FlowState, frame: Frame) -> StreamConfig | None:
        idcode, size = frame.idcode, len(frame.data)
        known = self._configs.get((state.host, idcode), {})
        fitting = {config for config in known.values() if config.frame_size == size}
        if not fitting and (saved := self._saved.get(idcode)) and saved.frame_size == size:
            fitting = {saved}
        if len(fitting) > 1:  # the same stream in two words, asked for here and sent unasked there
            fitting -= {short for short in fitting for full in fitting if abridges(short, full)}
        if len(fitting) != 1:
            return None
        config = fitting.pop()
        if idcode not in state.configs:
            state.configs[idcode] = config
            state.borrowed.add(idcode)
            self._borrowers.setdefault((state.host, idcode), {})[state.flow] = state
        return config

    def _hold(self, state: _FlowState, frame: Frame, out: list[Message | Loss]) -> None:
        size = len(frame.data)
        held = state.held.get(frame.idcode)
        while held is not None and held.frames and held.nbytes + size > self._bounds.held_bytes:
            oldest = held.frames.popleft()
            held.nbytes -= len(oldest.data)
            self._now_hold(-1, -len(oldest.data))
            self._drop(state, [oldest], out)
        while self._waiting and self._held_bytes + size > self._bounds.all_held_bytes:
            (_, idcode), flows = next(iter(self._waiting.items()))
            self._give_up(next(iter(flows.values())), idcode, out)
        held = state.held.setdefault(frame.idcode, _Held())
        held.frames.append(frame)
        held.nbytes += size
        self._now_hold(1, size)
        self.put_on_hold.append(frame.idcode)
        self._waiting.setdefault((state.host, frame.idcode), {})[state.flow] = state

    def _now_hold(self, frames: int, nbytes: int) -> None:
        """So many more are held, or fewer."""
        self.held_frames += frames
        self._held_bytes += nbytes

    def _give_up(self, state: _FlowState, idcode: int, out: list[Message | Loss]) -> None:
        """Hold nothing of this stream any longer."""
        held = state.held.pop(idcode)
        self._now_hold(-len(held.frames), -held.nbytes)
        _forget(self._waiting, (state.host, idcode), state.flow)
        self._drop(state, held.frames, out)

    def _drop(self, state: _FlowState, frames: Iterable[Frame], out: list[Message | Loss]) -> None:
        for frame in frames:
            skipped = Skipped(SkipReason.NO_CONFIG, frame.offset, len(frame.data), frame.idcode)
            self._lose(state, skipped, out, frame)

    def _join(self, state: _FlowState, frame: Frame) -> StreamConfig | None:
        """Collect CFG-3 fragments that each have their own CHK; the configuration once the last one is there.

        The standard does not say how a CFG-3 is cut; here the payloads behind CONT_IDX are laid end to end.
        """
        prefix = decode_prefix(frame.data)
        index = int.from_bytes(frame.data[PREFIX_SIZE : PREFIX_SIZE + 2], "big")
        part = frame.data[PREFIX_SIZE + 2 : -CHK_SIZE]
        key = state.flow, prefix.idcode
        expected, body = self._fragments.pop(key, (FIRST_FRAGMENT, bytearray()))
        self._fragment_bytes -= len(body)
        if index == FIRST_FRAGMENT:
            expected, body = FIRST_FRAGMENT, bytearray()
        last = index == LAST_FRAGMENT
        if index != expected and not (last and body):
            return None
        if len(body) + len(part) > self._bounds.longest_config:
            self.too_long.append(prefix.idcode)
            return None
        body += part
        if not last:
            self._fragments[key] = (index + 1, body)
            self._fragment_bytes += len(body)
            bounds = self._bounds
            while self._fragment_bytes > bounds.all_fragment_bytes or len(self._fragments) > bounds.flows:
                _, given_up = self._fragments.pop(next(iter(self._fragments)))
                self._fragment_bytes -= len(given_up)
            return None
        return decode_config_body(prefix, b"\0\0" + bytes(body))


def messages(chunks: Iterable[Chunk], demux: Demux) -> Iterator[Message | Loss]:
    """All of ``chunks`` through ``demux``, to the end."""
    for chunk in chunks:
        yield from demux.feed(chunk)
    yield from demux.close()
