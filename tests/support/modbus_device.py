"""A Modbus TCP device: pymodbus's own server, in a thread."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from support.live import free_ports
from support.requires import requires_module

SIZE = 100
"""Holding registers that there are."""


@dataclass
class Device:
    """What the device holds, and how it behaves."""

    port: int
    registers: list[int] = field(default_factory=lambda: [0] * SIZE)
    writes: list[tuple[int, list[int]]] = field(default_factory=list)
    """(address, values) in order."""
    slow_s: float = 0.0
    """It takes so long over every answer."""
    refuse: Any = None
    """The exception that it answers everything with."""
    unit: int = 1
    _server: Any = None
    _loop: asyncio.AbstractEventLoop | None = None
    _thread: threading.Thread | None = None

    async def _act(
        self, function: int, start: int, address: int, count: int, current: list[int], values: list[int] | None
    ) -> Any:
        if self.slow_s:
            await asyncio.sleep(self.slow_s)
        if self.refuse is not None:
            return self.refuse
        if values is not None:
            self.writes.append((address, list(values)))
            self.registers[address : address + len(values)] = values
        current[:] = self.registers[start : start + len(current)]
        return None

    def start(self) -> None:
        """Serve, from now on."""
        simulator, server = requires_module("pymodbus.simulator"), requires_module("pymodbus.server")
        ready = threading.Event()

        async def serve() -> None:
            block = simulator.SimData(0, values=[0] * SIZE, datatype=simulator.DataType.REGISTERS)
            device = simulator.SimDevice(self.unit, [block], action=self._act)
            self._server = server.ModbusTcpServer(device, address=("127.0.0.1", self.port))
            await self._server.serve_forever(background=True)
            ready.set()
            await self._server.serving

        def run() -> None:
            self._loop = asyncio.new_event_loop()
            try:
                self._loop.run_until_complete(serve())
            finally:
                for task in asyncio.all_tasks(self._loop):
                    task.cancel()
                self._loop.run_until_complete(asyncio.sleep(0))
                self._loop.close()

        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()
        assert ready.wait(10)

    def stop(self) -> None:
        """Serve no more; connections are cut."""
        if self._loop is not None and self._thread is not None and self._thread.is_alive():
            asyncio.run_coroutine_threadsafe(self._server.shutdown(), self._loop)
            self._thread.join(10)
            assert not self._thread.is_alive()


@contextmanager
def modbus_device(**how: Any) -> Iterator[Device]:
    """A device that serves, until the end of the block."""
    device = Device(free_ports(1)[0], **how)
    device.start()
    try:
        yield device
    finally:
        device.stop()


def wait_for(condition: Callable[[], object], seconds: float = 10.0) -> None:
    """Until ``condition`` holds; fails where that takes too long."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "never came true"
        time.sleep(0.002)
