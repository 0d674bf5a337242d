"""Modbus TCP by pymodbus: numbers in holding registers, and a device that is asked for a bounded time.

Everything that may go wrong on the wire is :class:`BusError`, with a reason for people. Whoever uses this does so in a
thread of their own: each question may take the time-out twice (to connect, and for the answer).
"""

from __future__ import annotations

import logging
import math
import struct
from collections.abc import Sequence
from typing import Any

from dcon.places import INT16_MAX, WORDS
from pmutools.errors import SettingsError
from pmutools.net.endpoint import join_host

EXCEPTIONS = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "device failure",
    5: "acknowledge: still at it",
    6: "device busy",
    8: "memory parity error",
    10: "gateway has no path",
    11: "gateway's target does not answer",
}
"""Codes of an exception response (Modbus application protocol 1.1b3, section 7)."""


class BusError(Exception):
    """A question that got no answer, or not the one asked for."""


def to_registers(kind: str, value: float) -> list[int]:
    """``value`` as ``int16`` (rounded, two's complement) or ``float32`` (big-endian, high word first).

    Raises ValueError for what does not fit.
    """
    if not math.isfinite(value) or (kind == "int16" and not -INT16_MAX - 1 <= round(value) <= INT16_MAX):
        raise ValueError(f"{value:g} is no {kind}")
    if kind == "int16":
        return [round(value) & 0xFFFF]
    try:
        return list(struct.unpack(">HH", struct.pack(">f", value)))
    except OverflowError:
        raise ValueError(f"{value:g} is no {kind}") from None


def from_registers(kind: str, words: Sequence[int]) -> float:
    """The inverse of :func:`to_registers`; may be NaN or infinite."""
    data = struct.pack(f">{len(words)}H", *words)
    return float(struct.unpack(">h" if kind == "int16" else ">f", data)[0])


class Bus:
    """One unit of one device. Connects when it is first asked, and anew after every failure."""

    def __init__(self, host: str, port: int, unit: int, timeout_s: float) -> None:
        """Raises SettingsError where pymodbus is not installed."""
        try:
            from pymodbus.client import ModbusTcpClient
        except ImportError:
            raise SettingsError(
                "modbus:// needs pymodbus; install it with: pip install '.[modbus]' in a checkout"
            ) from None
        logging.getLogger("pymodbus").setLevel(logging.CRITICAL)  # what fails is told here, once
        self._where, self._unit = join_host(host, port), unit
        self._client: Any = ModbusTcpClient(host, port=port, timeout=timeout_s, retries=0)

    def read(self, address: int, kind: str) -> float:
        """A number in holding registers (function 3). Raises BusError."""
        words = self.words(address, WORDS[kind])
        return from_registers(kind, words)

    def words(self, address: int, count: int) -> list[int]:
        """So many holding registers (function 3). Raises BusError."""
        answer = self._ask("read_holding_registers", address, count=count)
        if len(answer.registers) != count:
            raise self._failure(f"{len(answer.registers)} registers came, not {count}")
        return list(answer.registers)

    def write(self, address: int, words: list[int]) -> None:
        """Write holding registers (function 16). Raises BusError."""
        self._ask("write_registers", address, values=words)

    def close(self) -> None:
        self._client.close()

    def _ask(self, method: str, address: int, **what: Any) -> Any:
        try:
            if not self._client.connect():
                raise self._failure("no connection; is the device on, and address and port right?")
            answer = getattr(self._client, method)(address, device_id=self._unit, **what)
        except BusError:
            raise
        except Exception as error:  # pymodbus decodes what anybody may have sent: no list of its errors is complete
            raise self._failure(_reason(error)) from None
        if answer.isError():
            code = getattr(answer, "exception_code", 0)
            raise self._failure(f"register {address}: exception {code}, {EXCEPTIONS.get(code, 'of an unknown kind')}")
        return answer

    def _failure(self, reason: str) -> BusError:
        """A late answer must not be taken for one to the next question: the connection goes."""
        self._client.close()
        return BusError(f"{self._where}: {reason}")


def told(error: Exception) -> str:
    """An error for people; one that nobody expected has its name."""
    return str(error) if isinstance(error, BusError) else f"{type(error).__name__}: {error}"


def _reason(error: Exception) -> str:
    text = str(error)
    if "No response" in text or "not responding" in text:
        return "no answer in time"
    return "the device closed the connection" if "closed" in text else text or type(error).__name__
