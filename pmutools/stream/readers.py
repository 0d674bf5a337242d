"""How frames and batches are made of a recording, and of live endpoints: portion by portion."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Collection, Generator, Iterable, Sequence
from itertools import pairwise

import numpy as np

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import FrameType
from pmutools.c37118.demux import Loss, Message
from pmutools.clock import Clock
from pmutools.errors import StreamTimeout
from pmutools.flow import Flow
from pmutools.formats.source import Block, Source
from pmutools.net.dialogue import LinkEvent
from pmutools.net.endpoint import Endpoint
from pmutools.sites import Site
from pmutools.stream.batches import StreamBatch
from pmutools.stream.frames import StreamFrame
from pmutools.timebase import NS
from pmutools.tools.live import LiveSource
from pmutools.tools.news import Reasons
from pmutools.tools.window import Window

PORTION = 256
"""So many frames of a recording are handed on at once."""
EVENTS = 1000
"""So many of the latest news are kept."""
STREAMS = 1 << 16
"""So many streams' sites are remembered."""


class Reader:
    """What both kinds have in common: the configurations seen, and the window of what is wanted."""

    lossy = False
    """Whether it goes on when it is not read: then a slow reader loses frames."""

    def __init__(self, source: Source, idcodes: Collection[int]) -> None:
        self.source = source
        self.configs: dict[int, StreamConfig] = {}
        self.events: deque[LinkEvent] = deque(maxlen=EVENTS)
        self._idcodes = frozenset(idcodes)

    def frames(self) -> Generator[list[StreamFrame], None, None]:
        """Portions of data frames, in the order they came; portions may be empty."""
        raise NotImplementedError

    def batches(self, seconds: float) -> Generator[list[StreamBatch], None, None]:
        """Portions of batches of about ``seconds`` each, a batch a stream."""
        raise NotImplementedError

    def stop(self) -> None:
        """Have what is being read end soon; may be called from any thread."""

    def close(self) -> None:
        """Let go of sockets and files."""

    def _wanted(self, idcode: int) -> bool:
        return not self._idcodes or idcode in self._idcodes

    def _frame(self, item: Message | Loss) -> StreamFrame | None:
        """The item as a frame; takes note of a configuration."""
        if isinstance(item, Loss) or item.config is None or not self._wanted(item.config.idcode):
            return None
        if item.frame.type is FrameType.DATA:
            if self.configs.get(item.config.idcode) is not item.config:
                self.configs[item.config.idcode] = item.config
            return StreamFrame(item, self._sites(item.flow, item.config.idcode))
        if item.frame.type.rules_data:
            self.configs[item.config.idcode] = item.config
        return None

    def _batch(self, item: Block | Message | Loss) -> StreamBatch | None:
        if not isinstance(item, Block):
            self._frame(item)
            return None
        config = item.batch.config
        if not self._wanted(config.idcode) or not len(item.batch):
            return None
        self.configs[config.idcode] = config
        return StreamBatch(item.flow, item.batch, self._sites(item.flow, config.idcode))

    def _sites(self, flow: Flow, idcode: int) -> tuple[Site, ...]:
        return ()


class RecordedReader(Reader):
    """A recording; ``duration_ns`` of stream time."""

    def __init__(self, source: Source, *, duration_ns: int | None = None, idcodes: Collection[int] = ()) -> None:
        super().__init__(source, idcodes)
        self._window = Window(duration_ns=duration_ns)
        self._stopped = threading.Event()

    def frames(self) -> Generator[list[StreamFrame], None, None]:
        portion: list[StreamFrame] = []
        for item in self._window.items(self.source.items()):
            if self._stopped.is_set():
                return
            if (frame := self._frame(item)) is not None:
                portion.append(frame)
                if len(portion) >= PORTION:
                    yield portion
                    portion = []
        yield portion

    def batches(self, seconds: float) -> Generator[list[StreamBatch], None, None]:
        """Cut where a stamp is in another interval of ``seconds`` than the one before it, counted from 1970."""
        for item in self._window.blocks(self.source.blocks()):
            if self._stopped.is_set():
                return
            if (batch := self._batch(item)) is not None:
                yield _cut(batch, round(seconds * NS))

    def stop(self) -> None:
        self._stopped.set()


def _cut(whole: StreamBatch, step_ns: int) -> list[StreamBatch]:
    steps = np.flatnonzero(np.diff(whole.time_ns // step_ns)) + 1
    rows = [0, *steps.tolist(), len(whole)]
    return [StreamBatch(whole.flow, whole.batch[first:end], whole.sites) for first, end in pairwise(rows)]


class LiveReader(Reader):
    """Endpoints, each with the sites that it stands for; ``timeout_ns`` without a data frame is an error."""

    lossy = True

    def __init__(
        self,
        endpoints: Sequence[tuple[Endpoint, tuple[Site, ...]]],
        *,
        duration_ns: int | None = None,
        timeout_ns: int | None = None,
        idcodes: Collection[int] = (),
        configs: Iterable[StreamConfig] = (),
        tell: Callable[[LinkEvent], None] | None = None,
        clock: Clock | None = None,
    ) -> None:
        self._reasons = Reasons()
        self._tell = tell
        self._stopped = threading.Event()
        live = LiveSource(
            [endpoint for endpoint, _ in endpoints],
            duration_ns=duration_ns,
            configs=configs,
            tell=self._hear,
            stop=self._stopped.is_set,
            clock=clock,
        )
        super().__init__(live, idcodes)
        self.live = live
        self._endpoints = endpoints
        self._timeout_ns = timeout_ns
        self._heard_ns = live.clock.monotonic_ns()
        self._by_stream: dict[tuple[Flow, int], tuple[Site, ...]] = {}

    def frames(self) -> Generator[list[StreamFrame], None, None]:
        for found in self.live.polls():
            frames = [frame for item in found if (frame := self._frame(item)) is not None]
            self._watch(bool(frames))
            yield frames

    def batches(self, seconds: float) -> Generator[list[StreamBatch], None, None]:
        for found in self.live.rounds(round(seconds * NS)):
            batches = [batch for item in found if (batch := self._batch(item)) is not None]
            self._watch(bool(batches))
            yield batches

    def _watch(self, heard: bool) -> None:
        """Raise StreamTimeout where nothing has been heard for too long."""
        now_ns = self.live.clock.monotonic_ns()
        if heard:
            self._heard_ns = now_ns
        elif self._timeout_ns is not None and now_ns - self._heard_ns >= self._timeout_ns:
            whys = {f"{endpoint}: {self._reasons.why(at)}": None for at, (endpoint, _) in enumerate(self._endpoints)}
            raise StreamTimeout(f"no data for {(now_ns - self._heard_ns) / NS:.3g} s; {'; '.join(list(whys)[:4])}")

    def _hear(self, event: LinkEvent) -> None:
        self._reasons.hear(event)
        self.events.append(event)
        if self._tell is not None:
            self._tell(event)

    def _sites(self, flow: Flow, idcode: int) -> tuple[Site, ...]:
        key = (flow, idcode)
        sites = self._by_stream.get(key)
        if sites is None:
            owners = self.live.receivers.owners(flow, idcode)
            sites = tuple(site for place in owners for site in self._endpoints[place][1])
            if len(self._by_stream) < STREAMS:
                self._by_stream[key] = sites
        return sites

    def stop(self) -> None:
        self._stopped.set()

    def close(self) -> None:
        self.live.receivers.close()
