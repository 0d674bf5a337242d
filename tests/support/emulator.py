"""Emulated PMUs on loopback, sending in real time from a thread of their own, and a listener for the command."""

from __future__ import annotations

import socket
import threading
from collections.abc import Mapping, Sequence
from types import TracebackType

from support.swing import MS, Streams

from dcon.link.command import CommandOut, decode
from pmutools.c37118.session import served
from pmutools.clock import SystemClock, utc_offset
from pmutools.net.endpoint import parse_endpoint
from pmutools.net.server import Senders

AGE_MS = 40
"""Of a frame when it leaves."""


class Emulator(threading.Thread):
    """Sends each PMU's frames to all of its ports until closed; configurations once a second."""

    def __init__(self, ports: Mapping[str, Sequence[int]], *, rate: int = 60) -> None:
        super().__init__(daemon=True)
        self.streams = Streams(tuple(ports), rate)
        self.senders = Senders(SystemClock(), cfg_period_ns=None)
        self.handles = {name: self.senders.add(served(config)) for name, config in self.streams.configs.items()}
        for name, numbers in ports.items():
            for port in numbers:
                self.senders.send_to(parse_endpoint(f"udp://127.0.0.1:{port}"), [self.handles[name]])
        self._slimmed: list[str] = []
        self._over = threading.Event()

    def slim(self, name: str) -> None:
        """From the next frame on, ``name`` sends its voltages only, under a new configuration."""
        self._slimmed.append(name)

    def run(self) -> None:
        clock = SystemClock()
        offset = utc_offset(clock)
        rate = self.streams.rate
        slot = offset.realtime_ns(clock.monotonic_ns()) * rate // 10**9
        announced = 0
        while not self._over.is_set():
            slot += 1
            stamp_ns = self.streams.stamp_ns(slot, 0)
            self.senders.serve_until(offset.monotonic_ns(stamp_ns + AGE_MS * MS))
            while self._slimmed:
                name = self._slimmed.pop()
                self.senders.replace(self.handles[name], served(self.streams.slim(name)))
                announced = 0
            if slot > announced + rate:
                self.senders.announce()
                announced = slot
            self.senders.publish([(h, self.streams.data(name, stamp_ns)) for name, h in self.handles.items()])
        self.senders.close()

    def close(self) -> None:
        self._over.set()
        self.join()

    def __enter__(self) -> Emulator:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Gateway(threading.Thread):
    """Takes commands from one UDP port until closed."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.bind(("127.0.0.1", 0))
        self._sock.settimeout(0.1)
        self.port = int(self._sock.getsockname()[1])
        self.commands: list[CommandOut] = []
        self._over = threading.Event()

    def run(self) -> None:
        while True:
            try:
                command = decode(self._sock.recv(100))
            except TimeoutError:
                if self._over.is_set():
                    return
                continue
            assert command is not None
            self.commands.append(command)

    def close(self) -> list[CommandOut]:
        """Everything that has come."""
        self._over.set()
        self.join()
        self._sock.close()
        return self.commands
