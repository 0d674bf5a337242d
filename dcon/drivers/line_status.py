"""Status of the DC line: as a UDP datagram from whoever knows, or read from a Modbus TCP device. 48 bytes, big-endian::

    4s magic "DCP1" | I sequence | q time_ns (UTC of the values) | d power MW | d scheduled MW (NaN: not known) |
    d reserved, 0 | I flags (bit 0 in service, bit 1 modulation enabled) | I CRC-32

Power counts north to south. Datagrams are not signed: they are taken from the configured address only, and the network
that they cross must be trusted.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

from dcon.core.values import Pdci
from dcon.drivers.modbus import Bus, BusError, told
from dcon.link.sealed import WRAP, Sealed, follows
from dcon.places import ModbusLine
from pmutools.timebase import NS

_DCP1 = Sealed(b"DCP1", "IqdddI")
SIZE = _DCP1.size
IN_SERVICE, DCON_ENABLED = 1, 2
"""Flags of the datagram, and bits of the status word of a device."""
SILENCE_NS = 2 * NS
"""After so long without a status, who tells the next may begin its sequence anew."""
FUTURE_NS = NS
"""A status from further ahead is a mistake of somebody's clock, and would never grow old."""


class Status(NamedTuple):
    """What one datagram says."""

    sequence: int
    line: Pdci


def encode(sequence: int, line: Pdci) -> bytes:
    """The datagram of a status; the sequence wraps at 2**32."""
    flags = line.in_service * IN_SERVICE | line.dcon_enabled * DCON_ENABLED
    return _DCP1.pack(sequence % WRAP, line.time_ns, line.power_mw, line.scheduled_mw, 0.0, flags)


def decode(datagram: bytes) -> Status | None:
    """The status in a datagram; None for anything else."""
    values = _DCP1.unpack(datagram)
    if values is None:
        return None
    sequence, time_ns, power_mw, scheduled_mw, _, flags = values
    return Status(sequence, _line(time_ns, power_mw, scheduled_mw, flags))


def _line(time_ns: int, power_mw: float, scheduled_mw: float, flags: int) -> Pdci:
    return Pdci(time_ns, power_mw, bool(flags & IN_SERVICE), bool(flags & DCON_ENABLED), scheduled_mw)


def _plausible(line: Pdci, now_ns: int) -> str:
    """Why a status is not to be believed; "" where it is."""
    if not math.isfinite(line.power_mw) or math.isinf(line.scheduled_mw):
        return "not a number"
    return "from the future" if line.time_ns > now_ns + FUTURE_NS else ""


class StatusInbox:
    """Takes datagrams and keeps what counts: the newest status that is whole, newer, and believable."""

    def __init__(self) -> None:
        self.taken = 0
        self.refused: Counter[str] = Counter()
        """By reason: ``malformed``, ``old``, ``not a number``, ``from the future``."""
        self._sequence: int | None = None
        self._heard_ns = 0

    def take(self, datagrams: Iterable[bytes], now_ns: int, utc_ns: int) -> Pdci | None:
        """The newest status among ``datagrams``; ``now_ns`` is of a clock without steps."""
        newest = None
        if now_ns - self._heard_ns > SILENCE_NS:
            self._sequence = None
        for datagram in datagrams:
            status = decode(datagram)
            if status is None:
                why = "malformed"
            elif self._sequence is not None and not follows(status.sequence, self._sequence):
                why = "old"
            elif not (why := _plausible(status.line, utc_ns)):
                self.taken += 1
                self._sequence, self._heard_ns, newest = status.sequence, now_ns, status.line
                continue
            self.refused[why] += 1
        return newest


class LineOnModbus:
    """Asks a device again and again, in a thread of its own; nobody waits for it."""

    def __init__(self, place: ModbusLine) -> None:
        """Nothing is asked yet. Raises SettingsError where pymodbus is not installed."""
        self._keys = place.keys
        self._bus = Bus(place.host, place.port, place.keys.unit, place.keys.timeout_ms / 1e3)
        self.newest: Pdci | None = None
        """The last status; its time is when it was asked for."""
        self.failed = 0
        self.trouble = ""
        self._counter: int | None = None
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pdci-modbus", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stopped.set()
        self._thread.join(2 * self._keys.timeout_ms / 1e3)
        self._bus.close()

    def _run(self) -> None:
        while not self._stopped.is_set():
            try:
                line = self.ask(time.time_ns())
                self.newest, self.trouble = line or self.newest, "" if line else "the device's counter stands still"
            except Exception as error:  # the edge of the thread, which must not end unseen
                self.failed += 1
                self.trouble = told(error)
            self._stopped.wait(self._keys.period_ms / 1e3)

    def ask(self, utc_ns: int) -> Pdci | None:
        """The status now; None where the device's counter has not moved since. Raises BusError."""
        keys, bus = self._keys, self._bus
        if keys.counter is not None:
            counter = bus.words(keys.counter, 1)[0]
            if counter == self._counter:
                return None
            self._counter = counter
        power_mw = bus.read(keys.power, keys.type) / keys.scale
        scheduled_mw = math.nan
        if keys.scheduled is not None:
            scheduled_mw = bus.read(keys.scheduled, keys.type) / keys.scale
        line = _line(utc_ns, power_mw, scheduled_mw, bus.words(keys.status, 1)[0])
        if why := _plausible(line, utc_ns):
            raise BusError(f"register {keys.power}: {power_mw:g} MW is {why}")
        return line
