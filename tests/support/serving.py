"""A device on loopback in a thread of its own: serves streams over TCP, or sends them, at their rate."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from types import TracebackType

from support.live import data_frame

from pmutools.c37118 import StreamConfig
from pmutools.c37118.session import served
from pmutools.clock import SystemClock, utc_offset
from pmutools.net.endpoint import parse_endpoint
from pmutools.net.outlet import ServerEvent
from pmutools.net.server import Senders
from pmutools.timebase import NS

AGE_NS = 20_000_000
"""Of a frame when it leaves."""


class Device(threading.Thread):
    """Sends frames of now until closed; ``make`` gives the frame of a stream for a stamp."""

    def __init__(
        self,
        configs: Sequence[StreamConfig],
        *,
        to: str | None = None,
        make: Callable[[StreamConfig, int], bytes] = data_frame,
    ) -> None:
        super().__init__(daemon=True)
        self._senders = Senders(SystemClock(), cfg_period_ns=None)
        self._configs, self._make = configs, make
        self._handles = [self._senders.add(served(config)) for config in configs]
        self.events: list[ServerEvent] = []
        self.port = 0
        if to is None:
            outlet = self._senders.listen(parse_endpoint("tcp://127.0.0.1:0"), self._handles)
            local = self._senders.local(outlet)
            assert local is not None
            self.port = local.port
        else:
            self._senders.send_to(parse_endpoint(to), self._handles)
        self._over = threading.Event()

    def run(self) -> None:
        offset, rate = utc_offset(SystemClock()), self._configs[0].data_rate
        slot = (offset.realtime_ns(SystemClock().monotonic_ns()) - AGE_NS) * rate // NS
        while not self._over.is_set():
            slot += 1
            stamp_ns = slot * NS // rate
            self.events += self._senders.serve_until(offset.monotonic_ns(stamp_ns + AGE_NS))
            if slot % rate == 0:
                self._senders.announce()
            made = [self._make(config, stamp_ns) for config in self._configs]
            self._senders.publish(list(zip(self._handles, made, strict=True)))
        self._senders.close()

    def close(self) -> None:
        self._over.set()
        self.join()

    def __enter__(self) -> Device:
        self._senders.announce()
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
