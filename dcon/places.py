"""Where a command goes and where the line's status comes from, as URLs: ``udp://``, ``iio://``, ``modbus://``.

::

    iio:///sys/bus/iio/devices/iio:device0?channel=0&readback=0
    modbus://HOST:PORT?unit=1&register=0&type=int16&scale=1000&readback=10
    modbus://HOST:PORT?unit=1&power=0&scheduled=2&status=4&type=float32

The fields of the classes below are the keys that may follow the ``?``. Everything here is text to values; the files and
the bus are looked at by who opens them (:mod:`dcon.drivers`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import TypeVar
from urllib.parse import parse_qsl, urlsplit

from pmutools.net.endpoint import Endpoint, Scheme, join_host
from pmutools.parsers import Call, bind, choice, integer, number, parsed_by
from pmutools.sites import endpoint

T = TypeVar("T")
MODBUS_PORT = 502
FULL_SCALE_V = 10.0
"""±10 V are ±125 MW."""
WORDS = {"int16": 1, "float32": 2}
"""Registers of a number, by its type."""
INT16_MAX = 32767
_address = integer(0, 65535)


def _path(text: str) -> str:
    if not text.startswith("/"):
        raise ValueError(f"{text!r} is no absolute path; write it as in /sys/bus/iio/devices/iio:device1")
    return text


@dataclass(frozen=True, slots=True)
class IioKeys:
    """Keys of ``iio://``."""

    channel: int = field(default=0, metadata=parsed_by(integer(0, 255)))
    """Of the DAC: N of its file ``out_voltageN_raw``."""
    readback: int | None = field(default=None, metadata=parsed_by(integer(0, 255)))
    """Channel of the ADC that sees the output: N of ``in_voltageN_raw``; nothing is read back without it."""
    adc: str | None = field(default=None, metadata=parsed_by(_path))
    """Folder of the ADC, where that is another device than the DAC."""
    bits: int | None = field(default=None, metadata=parsed_by(integer(8, 32)))
    """Of the DAC: counts are 0 to 2^bits - 1. Only for a DAC that has no file ``out_voltageN_raw_available``."""
    settle_ms: float = field(default=2.0, metadata=parsed_by(number(0, 10)))
    """From the write to the reading back."""


@dataclass(frozen=True, slots=True)
class IioPlace:
    """A DAC of Linux's Industrial I/O subsystem."""

    folder: str
    keys: IioKeys = IioKeys()

    def __str__(self) -> str:
        return f"iio://{self.folder}?{_query(self.keys)}"


@dataclass(frozen=True, slots=True)
class OutputRegisters:
    """Keys of ``modbus://`` in ``[output]``. Addresses are those on the wire: the first holding register is 0."""

    unit: int = field(default=1, metadata=parsed_by(integer(0, 255)))
    """Modbus unit (slave) number."""
    register: int = field(default=0, metadata=parsed_by(_address))
    """Holding register that the output is written to (function 16)."""
    type: str = field(default="int16", metadata=parsed_by(choice(*WORDS)))
    """``int16``: one register, two's complement. ``float32``: IEEE 754 in two registers, high word first."""
    scale: float | None = field(default=None, metadata=parsed_by(number(1e-6, 1e6)))
    """Counts per volt; 1000 for int16 and 1 for float32 unless given."""
    readback: int | None = field(default=None, metadata=parsed_by(_address))
    """Holding register (function 3) that holds the output as measured, of the same type and scale; without it the
    register written to is read, which shows that the device took the number, not what it puts out."""
    timeout_ms: float = field(default=200.0, metadata=parsed_by(number(10, 900)))
    """How long the device is waited for: to connect, and for an answer."""

    @property
    def counts_per_v(self) -> float:
        return self.scale if self.scale is not None else 1000.0 if self.type == "int16" else 1.0


@dataclass(frozen=True, slots=True)
class StatusRegisters:
    """Keys of ``modbus://`` in ``[pdci]``. Addresses are those on the wire: the first holding register is 0."""

    unit: int = field(default=1, metadata=parsed_by(integer(0, 255)))
    """Modbus unit (slave) number."""
    power: int = field(default=0, metadata=parsed_by(_address))
    """Holding register of the power, MW times ``scale``, north to south."""
    scheduled: int | None = field(default=None, metadata=parsed_by(_address))
    """That of the scheduled power; not known without it."""
    status: int = field(default=4, metadata=parsed_by(_address))
    """That of the status word: bit 0 in service, bit 1 modulation enabled."""
    counter: int | None = field(default=None, metadata=parsed_by(_address))
    """One that the device changes with each of its own updates: what it serves while this stands still is no news."""
    type: str = field(default="float32", metadata=parsed_by(choice(*WORDS)))
    """Of the powers, as in ``[output]``."""
    scale: float = field(default=1.0, metadata=parsed_by(number(1e-6, 1e6)))
    """Counts per MW."""
    period_ms: float = field(default=500.0, metadata=parsed_by(number(20, 10_000)))
    """How often it is asked."""
    timeout_ms: float = field(default=500.0, metadata=parsed_by(number(10, 900)))
    """How long it is waited for."""


Keys = TypeVar("Keys", OutputRegisters, StatusRegisters)


@dataclass(frozen=True, slots=True)
class ModbusPlace:
    """A device on Modbus TCP that the command goes to."""

    host: str
    port: int
    keys: OutputRegisters = OutputRegisters()

    def __str__(self) -> str:
        return f"modbus://{join_host(self.host, self.port)}?{_query(self.keys)}"


@dataclass(frozen=True, slots=True)
class ModbusLine:
    """A device on Modbus TCP that tells the line's status."""

    host: str
    port: int
    keys: StatusRegisters = StatusRegisters()

    def __str__(self) -> str:
        return f"modbus://{join_host(self.host, self.port)}?{_query(self.keys)}"


Destination = Endpoint | IioPlace | ModbusPlace
"""Where the command goes."""
LineSource = Endpoint | ModbusLine
"""Where the line's status comes from."""


def destination(text: str) -> Destination:
    """The URL of ``[output]``. Raises ValueError."""
    match text.strip().partition("://")[0]:
        case "iio":
            return _iio(text.strip())
        case "modbus":
            host, port, keys = _modbus(text.strip(), OutputRegisters)
            if keys.type == "int16" and keys.counts_per_v * FULL_SCALE_V > INT16_MAX:
                raise ValueError(f"{text}: scale={keys.counts_per_v:g} takes 10 V beyond {INT16_MAX}; 3276 is the most")
            return ModbusPlace(host, port, keys)
    return _datagrams(text, "commands leave as udp://HOST:PORT, iio://FOLDER or modbus://HOST:PORT")


def line_source(text: str) -> LineSource:
    """The URL of ``[pdci]``. Raises ValueError."""
    if text.strip().startswith("modbus://"):
        return ModbusLine(*_modbus(text.strip(), StatusRegisters))
    return _datagrams(text, "the line's status comes by udp://HOST:PORT (an address of this machine) or modbus://")


def _datagrams(text: str, places: str) -> Endpoint:
    """``udp://HOST:PORT``; ``places`` says what else may be written."""
    try:
        parts = urlsplit(text.strip())
        has_port = parts.scheme == Scheme.UDP and bool(parts.port)
    except ValueError:
        has_port = False
    if not has_port:
        raise ValueError(f"{text}: {places}")
    return endpoint(text)


def _iio(text: str) -> IioPlace:
    folder, _, query = text.removeprefix("iio://").partition("?")
    if not folder.startswith("/"):
        raise ValueError(f"{text}: write three slashes and the device's folder: iio:///sys/bus/iio/devices/iio:device0")
    return IioPlace(folder.rstrip("/") or "/", _keys(IioKeys, text, query))


def _modbus(text: str, keys: type[Keys]) -> tuple[str, int, Keys]:
    try:
        parts = urlsplit(text)
        port = parts.port or MODBUS_PORT
    except ValueError as error:
        raise ValueError(f"{text}: {str(error).lower()}") from None
    if not parts.hostname or parts.username is not None or parts.path not in ("", "/") or parts.fragment:
        raise ValueError(f"{text}: only modbus://HOST:PORT?key=value is understood")
    try:
        parts.hostname.encode("idna")
    except UnicodeError:
        raise ValueError(f"{text}: {parts.hostname!r} can be no host's name; write one, or an address") from None
    return parts.hostname, port, _keys(keys, text, parts.query)


def _query(keys: IioKeys | OutputRegisters | StatusRegisters) -> str:
    """All keys in force."""
    values = ((item.name, getattr(keys, item.name)) for item in fields(keys))
    shown = ((name, f"{value:g}" if isinstance(value, float) else value) for name, value in values)
    return "&".join(f"{name}={value}" for name, value in shown if value is not None)


def _keys(cls: type[T], url: str, query: str) -> T:
    pairs = parse_qsl(query, keep_blank_values=True)
    named = dict(pairs)
    if len(named) != len(pairs):
        raise ValueError(f"{url}: a key is given twice")
    return bind(cls, Call(f"{url.partition('?')[0]}?", (), named))
