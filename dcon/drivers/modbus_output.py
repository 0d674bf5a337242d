"""The command into a holding register of a Modbus TCP device, from a thread of its own.

The thread writes the newest command, reads the output back, and begins again; commands that came meanwhile are
overtaken, never queued. When the bus is dead there is no readback any more, and :attr:`ModbusDriver.trouble` says why.
"""

from __future__ import annotations

import threading

from dcon.drivers.driver import Readback, bounded_v
from dcon.drivers.modbus import Bus, to_registers, told
from dcon.places import ModbusPlace

RETRY_S = 0.1
"""From a failure to the next try."""
POLL_NS = 2_000_000
LAST_TRIES = 2
"""To leave 0 V."""


class ModbusDriver:
    """One register that is written, one that is read back."""

    def __init__(self, place: ModbusPlace) -> None:
        """Nothing is asked of the device yet. Raises SettingsError where pymodbus is not installed."""
        keys = place.keys
        self._place, self._keys = place, keys
        self._bus = Bus(place.host, place.port, keys.unit, keys.timeout_ms / 1e3)
        self.driven = self.failed = 0
        self.overtaken = 0
        """Commands that a newer one replaced before they were written: the bus is slower than the ticks."""
        self.reads_back, self.settle_ns = True, POLL_NS
        self.trouble = ""
        self._readback: Readback | None = None
        self._wanted: tuple[int, float] | None = None
        self._closing = False
        self._news = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="modbus-output", daemon=True)
        self._thread.start()

    def drive(self, time_ns: int, output_v: float, flags: int = 0, /) -> None:
        with self._news:
            self.overtaken += self._wanted is not None
            self.driven += 1
            self._wanted = self.driven, bounded_v(output_v)
            self._news.notify()

    def readback(self) -> Readback | None:
        return self._readback

    def close(self) -> None:
        """Waits until 0 V are written, or two tries of it have failed."""
        self.drive(0, 0.0)
        with self._news:
            self._closing = True
            self._news.notify()
        self._thread.join(LAST_TRIES * (4 * self._keys.timeout_ms / 1e3 + RETRY_S))
        self._bus.close()

    def _run(self) -> None:
        tries = LAST_TRIES
        while tries:
            with self._news:
                self._news.wait_for(lambda: self._wanted is not None or self._closing)
                if self._wanted is None:
                    return
                (number, output_v), self._wanted = self._wanted, None
            try:
                self._readback = Readback(number, self._carry_out(output_v))
                self.trouble = ""
            except Exception as error:  # the edge of the thread, which must not end unseen
                self.failed += 1
                self.trouble, self._readback = told(error), None
                with self._news:
                    if self._wanted is None:
                        self._wanted = number, output_v
                    tries -= self._closing
                    self._news.wait_for(lambda: self._closing, RETRY_S)

    def _carry_out(self, output_v: float) -> float:
        """Write volts, and read them back."""
        keys = self._keys
        self._bus.write(keys.register, to_registers(keys.type, output_v * keys.counts_per_v))
        where = keys.register if keys.readback is None else keys.readback
        return self._bus.read(where, keys.type) / keys.counts_per_v
