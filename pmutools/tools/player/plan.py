"""What leaves when: a script on its timeline, loop after loop, through the fault pipelines. No clock, no socket."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import count
from typing import NamedTuple

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.demux import Loss, Message
from pmutools.impair.outgoing import Fate, Outgoing
from pmutools.impair.pipeline import Pipeline
from pmutools.tools.player.script import Cue, Script, cues
from pmutools.tools.player.stamps import Timeline

Items = Callable[[], Iterable[Message | Loss]]
"""Opens the source anew."""

SKEW_FRAMES = 1 << 18
"""Frames read ahead at most to bring streams of different rates together, where frames are due by their number."""


class Due(NamedTuple):
    """A copy of a frame on its way; ``stamp_ns`` (POSIX UTC) is what it carries, ``source_ns`` what was recorded."""

    offset_ns: int
    order: int
    stream: int
    out: Outgoing
    source_ns: int
    stamp_ns: int
    config: StreamConfig


class _Staged(NamedTuple):
    """A cue of the ``loop``-th round with the stream time at which it is due."""

    stream_ns: int
    order: int
    cue: Cue
    loop: int


class _Origin(NamedTuple):
    """What a ledger wants to know of a frame that a pipeline may hold back."""

    source_ns: int
    stamp_ns: int
    config: StreamConfig


def plan(script: Script, items: Items, line: Timeline, pipelines: Sequence[Pipeline], loops: int = 1) -> Iterator[Due]:
    """All copies of all frames, also of those that will not be sent, in the order in which they are to leave.

    Equal offsets leave in the order of the source. ``loops`` 0: for ever.
    """
    route = _Route(script, line, pipelines)
    waiting: list[Due] = []
    staged = _staged(script, items, line, loops)
    for frame in _in_order(staged, script, loops) if line.by_index else staged:
        offset_ns = line.offset_ns(frame.stream_ns)
        while waiting and waiting[0].offset_ns < offset_ns:
            yield heapq.heappop(waiting)
        for due in route.through(frame, offset_ns):
            heapq.heappush(waiting, due)
    for due in route.end():
        heapq.heappush(waiting, due)
    while waiting:
        yield heapq.heappop(waiting)


def _staged(script: Script, items: Items, line: Timeline, loops: int) -> Iterator[_Staged]:
    order = count()
    for loop in range(loops) if loops else count():
        for cue in cues(script, items()):
            yield _Staged(line.stream_ns(cue, loop), next(order), cue, loop)


def _in_order(staged: Iterable[_Staged], script: Script, loops: int) -> Iterator[_Staged]:
    """Streams that run through the source at different paces, merged: each stream's own frames come in order."""
    left = [stream.frames * loops or -1 for stream in script.streams]
    here = [0] * len(left)
    missing = len(left)
    waiting: list[_Staged] = []
    for frame in staged:
        stream = frame.cue.stream
        left[stream] -= 1
        missing -= here[stream] == 0
        here[stream] += 1
        heapq.heappush(waiting, frame)
        while waiting and (not missing or len(waiting) > SKEW_FRAMES):
            first = heapq.heappop(waiting)
            here[first.cue.stream] -= 1
            missing += here[first.cue.stream] == 0 and left[first.cue.stream] != 0
            yield first
    while waiting:
        yield heapq.heappop(waiting)


class _Route:
    """Every stream's way through its pipeline; what is held back there keeps its origin here."""

    def __init__(self, script: Script, line: Timeline, pipelines: Sequence[Pipeline]) -> None:
        self._script, self._line, self._pipelines = script, line, pipelines
        self._order = count()
        self._origins: list[dict[int, _Origin]] = [{} for _ in pipelines]
        self._configs = [stream.config for stream in script.streams]

    def through(self, staged: _Staged, offset_ns: int) -> Iterator[Due]:
        cue, loop = staged.cue, staged.loop
        stream = cue.stream
        pipeline, origins = self._pipelines[stream], self._origins[stream]
        if cue.config is not self._configs[stream]:
            if cue.config != self._configs[stream]:
                pipeline.configure(self._line.config(cue.config))
            self._configs[stream] = cue.config
        data, stamp_ns = self._line.stamped(cue, loop, offset_ns)
        index = cue.number + loop * self._script.streams[stream].total
        origins[index] = _Origin(cue.stamp_ns, stamp_ns, cue.config)
        yield from self._dues(stream, pipeline.apply(index, data, offset_ns, staged.stream_ns))
        if not pipeline.holding:
            origins.clear()

    def end(self) -> Iterator[Due]:
        for stream, pipeline in enumerate(self._pipelines):
            yield from self._dues(stream, pipeline.close())

    def _dues(self, stream: int, rows: Iterable[Outgoing]) -> Iterator[Due]:
        origins = self._origins[stream]
        for out in rows:
            yield Due(out.offset_ns, next(self._order), stream, out, *origins[out.index])
            if out.fate is Fate.DISABLED:  # it was held at most once, and will not come again
                del origins[out.index]
