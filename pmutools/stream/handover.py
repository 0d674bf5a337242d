"""Items for ``for`` and ``async for``; from a thread that waits for sockets to an event loop that must not."""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable, Generator, Iterator
from itertools import chain
from typing import Generic, TypeVar

T = TypeVar("T")
LOOK_S = 1.0
"""How often a thread that waits for its loop looks whether that is still there."""


class Handover(Generic[T]):
    """Runs ``portions`` in a thread of its own and gives their items to the loop it is made in.

    What waits to be taken weighs at most ``limit`` (``weigh`` says what each weighs), or is one item. Beyond that,
    ``lossy``, the oldest are dropped and counted in ``dropped``; else the thread waits.
    """

    def __init__(
        self,
        portions: Generator[list[T], None, None],
        *,
        limit: int,
        lossy: bool,
        weigh: Callable[[T], int] = lambda item: 1,
    ) -> None:
        self.dropped = 0
        """What the dropped ones weighed."""
        self._portions, self._limit, self._lossy, self._weigh = portions, limit, lossy, weigh
        self._loop = asyncio.get_running_loop()
        self._awake, self._gone = asyncio.Event(), asyncio.Event()
        self._changed = threading.Condition()
        self._items: deque[T] = deque()
        self._weight = 0
        self._ended = self._closed = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="pmutools-stream", daemon=True)
        self._thread.start()

    async def take(self) -> T:
        """The next item. Raises StopAsyncIteration at the end, or what the thread ended with."""
        while True:
            with self._changed:
                if self._items:
                    item = self._items.popleft()
                    self._weight -= self._weigh(item)
                    self._changed.notify()
                    return item
                if self._ended:
                    if self._error is not None:
                        raise self._error
                    raise StopAsyncIteration
                self._awake.clear()
            await self._awake.wait()

    async def close(self) -> None:
        """Take no more; returns when the thread has ended. Its ``portions`` must be told to end beforehand."""
        with self._changed:
            self._closed = True
            self._items.clear()
            self._weight = 0
            self._changed.notify()
        await self._gone.wait()

    # --- in the thread

    def _run(self) -> None:
        try:
            for portion in self._portions:
                if not self._give(portion):
                    break
        except BaseException as error:
            self._error = error
        try:
            self._portions.close()
        finally:
            with self._changed:
                self._ended = True
            self._wake(self._awake)
            self._wake(self._gone)

    def _give(self, portion: list[T]) -> bool:
        """Put items into the queue; whether more are wanted."""
        with self._changed:
            for item in portion:
                weight = self._weigh(item)
                while not self._closed and self._items and self._weight + weight > self._limit:
                    if self._lossy:
                        lost = self._weigh(self._items.popleft())
                        self._weight -= lost
                        self.dropped += lost
                    else:
                        self._wake(self._awake)  # which notices a loop that has gone without a word
                        self._changed.wait(LOOK_S)
                if self._closed:
                    return False
                self._items.append(item)
                self._weight += weight
        if portion:
            self._wake(self._awake)
        return not self._closed

    def _wake(self, event: asyncio.Event) -> None:
        try:
            self._loop.call_soon_threadsafe(event.set)
        except RuntimeError:  # the loop is closed: nobody takes anything any more
            self._closed = True


class Items(Generic[T]):
    """Frames or batches, to be iterated with ``for`` or ``async for``; iterating again goes on where it was left."""

    def __init__(
        self,
        portions: Generator[list[T], None, None],
        *,
        limit: int,
        lossy: bool,
        weigh: Callable[[T], int],
        stop: Callable[[], None],
    ) -> None:
        """``stop`` makes ``portions`` end soon; the others are those of :class:`Handover`."""
        self._portions, self._stop = portions, stop
        self._limit, self._lossy, self._weigh = limit, lossy, weigh
        self._items: Iterator[T] | None = None
        self._handover: Handover[T] | None = None

    def __iter__(self) -> Iterator[T]:
        if self._handover is not None:
            raise RuntimeError("this stream is read by an event loop")
        if self._items is None:
            self._items = chain.from_iterable(self._portions)
        return self._items

    def __aiter__(self) -> AsyncIterator[T]:
        if self._items is not None:
            raise RuntimeError("this stream is read without an event loop")
        return self

    async def __anext__(self) -> T:
        if self._handover is None:
            self._handover = Handover(self._portions, limit=self._limit, lossy=self._lossy, weigh=self._weigh)
        return await self._handover.take()

    @property
    def threaded(self) -> bool:
        """Whether a thread reads them, which closes what it reads from."""
        return self._handover is not None

    @property
    def overflow(self) -> int:
        """Frames that were dropped because the event loop did not take them."""
        return 0 if self._handover is None else self._handover.dropped

    def close(self) -> None:
        """End; what an event loop reads ends soon after."""
        self._stop()
        if self._handover is None:
            self._portions.close()

    async def aclose(self) -> None:
        """End, and wait for it."""
        self._stop()
        if self._handover is None:
            self._portions.close()
        else:
            await self._handover.close()
