"""Live streams and recordings from Python: frames or batches, blocking or with asyncio.

::

    with pmutools.open_stream("udp://0.0.0.0:4713", timeout_s=10) as stream:
        for frame in stream:
            print(frame.time, frame.stations)

    async with pmutools.open_stream("tcp://192.0.2.1:4712?idcode=7") as stream:
        async for batch in stream.batches(seconds=0.5):
            ...

The same code reads a recording: ``pmutools.open_stream("capture.pcapng")``.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TypeVar

from pmutools.c37118.config import StreamConfig
from pmutools.clock import Clock
from pmutools.errors import SettingsError
from pmutools.net.dialogue import LinkEvent
from pmutools.net.endpoint import Endpoint, parse_endpoint
from pmutools.sites import Site, StreamSites, load_sites, streams_of
from pmutools.stream.batches import StreamBatch
from pmutools.stream.frames import StationValues, StreamFrame
from pmutools.stream.handover import Items
from pmutools.stream.readers import LiveReader, Reader, RecordedReader
from pmutools.timebase import NS
from pmutools.tools.recordings import losses, open_recordings, saved_configs

__all__ = ["Items", "StationValues", "Stream", "StreamBatch", "StreamFrame", "Target", "open_stream"]

Target = str | os.PathLike[str] | Endpoint | Site | StreamSites
"""A URL, a recording's path, an initialisation file's (``.ini``), or what these are parsed to."""
T = TypeVar("T")
WAITING_FRAMES = 20_000
"""So many frames wait for an event loop that does not take them; beyond, a live stream loses the oldest."""


class Stream:
    """Frames of one or several streams, in the order they came. Made by :func:`open_stream`; close it, or use ``with``.

    Iterating gives a :class:`StreamFrame` a data frame, :meth:`batches` gives columns; a stream is read as one or the
    other. It ends with the recording, after ``duration_s``, or after :meth:`stop`. Leaving the ``with`` closes all
    sockets, servers being told to stop.

    A stream belongs to the thread, or the event loop, that iterates it; only :meth:`stop` may be called from elsewhere.
    With ``async for``, a thread of its own waits for the sockets, so the loop never does; frames that the loop does not
    take in time are dropped, the oldest first, beyond 20,000, and counted in :attr:`overflow`. Of a recording none are.
    """

    def __init__(self, reader: Reader) -> None:
        self._reader = reader
        self._frames: Items[StreamFrame] | None = None
        self._batches: Items[StreamBatch] | None = None
        self._seconds = 0.0

    # --- reading

    def __iter__(self) -> Iterator[StreamFrame]:
        return iter(self._as_frames())

    def __aiter__(self) -> AsyncIterator[StreamFrame]:
        return aiter(self._as_frames())

    def batches(self, seconds: float = 1.0) -> Items[StreamBatch]:
        """Batches of ``seconds`` each, one a stream, for ``for`` or ``async for``.

        Live, what came within so much wall time. Of a recording, what is stamped within so much stream time; batches of
        different streams are then not in order of time. Raises ValueError for no time at all, RuntimeError where the
        stream is read otherwise already.
        """
        if not seconds > 0:
            raise ValueError(f"batches of {seconds} s; give more than 0")
        if self._frames is not None or (self._batches is not None and seconds != self._seconds):
            raise RuntimeError("this stream is read as frames, or as batches of another length, already")
        if self._batches is None:
            self._seconds = seconds
            self._batches = self._items(self._reader.batches(seconds), len)
        return self._batches

    def _as_frames(self) -> Items[StreamFrame]:
        if self._batches is not None:
            raise RuntimeError("this stream is read as batches already")
        if self._frames is None:
            self._frames = self._items(self._reader.frames(), lambda _: 1)
        return self._frames

    def _items(self, portions: Generator[list[T], None, None], weigh: Callable[[T], int]) -> Items[T]:
        def closing() -> Generator[list[T], None, None]:
            try:
                yield from portions
            finally:
                self._reader.close()

        return Items(closing(), limit=WAITING_FRAMES, lossy=self._reader.lossy, weigh=weigh, stop=self.stop)

    # --- what is known

    @property
    def configs(self) -> Mapping[int, StreamConfig]:
        """The latest configuration of each IDCODE that has been seen."""
        return self._reader.configs

    @property
    def events(self) -> Sequence[LinkEvent]:
        """The news of connections, the latest 1000, oldest first."""
        return tuple(self._reader.events)

    @property
    def losses(self) -> dict[str, int]:
        """What came and could not be read, by name: bytes skipped, defects of the file, datagrams lost here."""
        return losses(self._reader.source)

    @property
    def overflow(self) -> int:
        """Frames dropped because the event loop did not take them in time."""
        return sum(items.overflow for items in (self._frames, self._batches) if items is not None)

    # --- ending

    def stop(self) -> None:
        """Have the iteration end, within 0.1 s; may be called from any thread and from a signal's handler."""
        self._reader.stop()

    def close(self) -> None:
        """End, and close sockets and files; may be called again.

        Where an event loop reads, its thread closes them soon after.
        """
        items = self._frames or self._batches
        if items is not None:
            items.close()
        if items is None or not items.threaded:
            self._reader.close()

    async def aclose(self) -> None:
        """:meth:`close` for an event loop: waits until the sockets are closed."""
        items = self._frames or self._batches
        if items is not None:
            await items.aclose()
        if items is None or not items.threaded:
            self._reader.close()

    def __enter__(self) -> Stream:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    async def __aenter__(self) -> Stream:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.aclose()


def open_stream(
    *targets: Target | Iterable[Target],
    duration_s: float | None = None,
    timeout_s: float | None = None,
    idcodes: Collection[int] = (),
    configs: Iterable[StreamConfig] = (),
    on_event: Callable[[LinkEvent], None] | None = None,
    clock: Clock | None = None,
) -> Stream:
    """Open live endpoints, or recordings, for reading.

    Sockets are bound and connections begun when this returns; a device that cannot be reached now is news
    (:attr:`Stream.events`), and tried again. Names of hosts are looked up, which may take its time.

    Parameters
    ----------
    targets
        URLs (``udp://0.0.0.0:4713``), paths of recordings, or an initialisation file (``.ini``) for the PMUs in it.
        Endpoints and recordings do not mix.
    duration_s
        End after so many seconds: wall time of endpoints, stream time of recordings.
    timeout_s
        Raise StreamTimeout where no data frame has come for so long (of endpoints; looked at every 0.1 s).
    idcodes
        Only these streams.
    configs
        Saved configurations, for streams that may never send theirs.
    on_event
        Is given the news of connections: by the thread that iterates, or by the event loop.
    clock
        Another clock than the machine's, for tests.

    Raises
    ------
    SettingsError
        A target that is none; endpoints and recordings together; nothing at all.
    SourceError
        A port that is taken, an unknown host, a file that cannot be read.
    """
    live, paths = _sorted_out(targets)
    if not live and not paths:
        raise SettingsError("open_stream: nothing to open; give URLs, or paths of recordings")
    if live and paths:
        raise SettingsError(f"open_stream: {paths[0]} is a recording, {live[0].endpoint} is not; open one or the other")
    duration_ns = None if duration_s is None else round(duration_s * NS)
    if paths:
        source = open_recordings(paths, configs=configs)
        return Stream(RecordedReader(source, duration_ns=duration_ns, idcodes=idcodes))
    return Stream(
        LiveReader(
            [(stream.endpoint, stream.sites) for stream in live],
            duration_ns=duration_ns,
            timeout_ns=None if timeout_s is None else round(timeout_s * NS),
            idcodes=idcodes,
            configs=(*configs, *saved_configs(site for stream in live for site in stream.sites)),
            tell=None if on_event is None else _in_loop(on_event),
            clock=clock,
        )
    )


def _sorted_out(targets: Iterable[Target | Iterable[Target]]) -> tuple[list[StreamSites], list[Path]]:
    """Endpoints with their sites, and recordings."""
    live: list[StreamSites] = []
    sites: list[Site] = []
    paths: list[Path] = []
    for target in targets:
        match target:
            case StreamSites():
                live.append(target)
            case Site():
                sites.append(target)
            case Endpoint():
                live.append(StreamSites(target, ()))
            case str() if "://" in target:
                live.append(StreamSites(parse_endpoint(target), ()))
            case str() | os.PathLike():
                path = Path(target)
                if path.suffix.lower() == ".ini":
                    sites += load_sites(path)
                else:
                    paths.append(path)
            case _:
                more_live, more_paths = _sorted_out(target)
                live += more_live
                paths += more_paths
    return [*live, *streams_of(sites)], paths


def _in_loop(tell: Callable[[LinkEvent], None]) -> Callable[[LinkEvent], None]:
    """``tell``, called by the event loop that opens the stream, if one does."""
    try:
        loop = asyncio.get_running_loop()
    except RuntimeError:
        return tell

    def tell_later(event: LinkEvent) -> None:
        if not loop.is_closed():
            loop.call_soon_threadsafe(tell, event)

    return tell_later
