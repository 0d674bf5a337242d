"""The datagrams that the watchdog reads and writes. Big-endian, CRC-32 (zlib) of all before it at the end::

    DCN1 command   40 bytes  4s magic | I sequence | q time_ns (UTC) | d MW | d V | I flags (1 RELAYS, 2 CLOSED)
    DCB1 beat      32 bytes  4s magic | 8s loop | I counter | q monotonic_ns | B state | 3x
    DCR1 readback  28 bytes  4s magic | I sequence answered | q monotonic_ns | d V
    DCO1 word      44 bytes  4s magic | B verb | 3x | 32s who
    DCW1 status    44 bytes  4s magic | I counter | q monotonic_ns | B relays | B estop | B state | B healthy | I causes
                             | 8 H age of each loop's last beat in ms (65,534: that or more; 65,535: none came)

Written apart from what the controller has for the same datagrams; the tests hold the two together.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Sequence
from typing import Final, NamedTuple

RELAYS: Final = 1
"""Flag of a command: the controller asks for closed relays."""
CLOSED: Final = 2
"""Flag of a command, set by the watchdog alone: the relays are closed."""
FAILED: Final = 3
"""State of a beat: the loop has failed. 0 is starting, 1 running, 2 ending."""
RUNNING: Final = 1
WRAP: Final = 1 << 32

LOOPS: Final = ("control", "udp", "parse", "gps", "gui", "pdci", "server", "output")
"""Who may beat; a beat of anybody else is malformed."""
UNHEARD: Final = 0xFFFF
"""Age in a status of a beat that never came."""
VERBS: Final = {1: "estop", 2: "estop_release", 3: "reset"}

_COMMAND: Final = struct.Struct(">4sIqddI")
_BEAT: Final = struct.Struct(">4s8sIqB3x")
_READBACK: Final = struct.Struct(">4sIqd")
_WORD: Final = struct.Struct(">4sB3x32s")
_STATUS: Final = struct.Struct(">4sIqBBBBI8H")
_CRC: Final = struct.Struct(">I")
LONGEST: Final = 64
"""No datagram is longer; of one that is so many bytes are read, and it is malformed."""


class Command(NamedTuple):
    """What the controller wants driven."""

    sequence: int
    time_ns: int
    """UTC of the tick."""
    mw: float
    volts: float
    relays: bool
    """It asks for closed relays."""
    age_ms: float = 0.0
    """Since ``time_ns``, by the watchdog's own UTC, when it was read."""


class Beat(NamedTuple):
    """A sign of life."""

    loop: int
    """Place in :data:`LOOPS`."""
    counter: int
    state: int


class Readback(NamedTuple):
    """What the output says it drives, in answer to the watchdog's own ``sequence``."""

    sequence: int
    volts: float


class Word(NamedTuple):
    """An operator's word: one of :data:`VERBS`."""

    verb: str
    who: str


class Malformed(NamedTuple):
    """A datagram that is none of these: its ``size``, ``magic``, ``crc`` or ``value`` is wrong."""

    reason: str


def _command(body: bytes, utc_ns: int) -> Command | None:
    _, sequence, time_ns, mw, volts, flags = _COMMAND.unpack(body)
    if not (math.isfinite(mw) and math.isfinite(volts)):
        return None
    return Command(sequence, time_ns, mw, volts, bool(flags & RELAYS), (utc_ns - time_ns) / 1e6)


def _beat(body: bytes, _utc_ns: int) -> Beat | None:
    _, name, counter, _monotonic_ns, state = _BEAT.unpack(body)
    loop = name.rstrip(b"\0").decode("latin-1")
    return Beat(LOOPS.index(loop), counter, state) if loop in LOOPS and state <= FAILED else None


def _readback(body: bytes, _utc_ns: int) -> Readback | None:
    _, sequence, _monotonic_ns, volts = _READBACK.unpack(body)
    return Readback(sequence, volts) if math.isfinite(volts) else None


def _word(body: bytes, _utc_ns: int) -> Word | None:
    _, verb, who = _WORD.unpack(body)
    return Word(VERBS[verb], who.rstrip(b"\0").decode(errors="replace")) if verb in VERBS else None


_KINDS: Final = {
    b"DCN1": (_COMMAND.size, _command),
    b"DCB1": (_BEAT.size, _beat),
    b"DCR1": (_READBACK.size, _readback),
    b"DCO1": (_WORD.size, _word),
}


def decode(datagram: bytes, utc_ns: int) -> Command | Beat | Readback | Word | Malformed:
    """What a datagram says that was read at ``utc_ns`` by the watchdog's clock; never raises."""
    kind = _KINDS.get(datagram[:4])
    if kind is None:
        return Malformed("magic")
    size, read = kind
    if len(datagram) != size + 4:
        return Malformed("size")
    body = datagram[:size]
    if zlib.crc32(body) != _CRC.unpack(datagram[size:])[0]:
        return Malformed("crc")
    said = read(body, utc_ns)
    return Malformed("value") if said is None else said


def _sealed(body: bytes) -> bytes:
    return body + _CRC.pack(zlib.crc32(body))


def encode_command(sequence: int, time_ns: int, mw: float, volts: float, flags: int) -> bytes:
    """The command that leaves, with the watchdog's own ``sequence`` (wraps at 2**32)."""
    return _sealed(_COMMAND.pack(b"DCN1", sequence % WRAP, time_ns, mw, volts, flags))


def encode_status(
    counter: int,
    monotonic_ns: int,
    relays: int,
    estop: int,
    state: int,
    healthy: bool,
    causes: int,
    ages_ms: Sequence[int] = (UNHEARD,) * len(LOOPS),
) -> bytes:
    """What the watchdog tells. ``relays``: bit 0 a, bit 1 b, closed; ``estop``: bits 0 software, 1 line a, 2 line b,
    released; ``state``: 0 OPEN, 1 CLOSED, 2 TRIPPED; ``causes``: bits as in :data:`dcon.watchdog.rules.CAUSES`;
    ``ages_ms``: of the beats, in the order of :data:`LOOPS`.
    """
    told = (counter % WRAP, monotonic_ns, relays, estop, state, healthy, causes)
    return _sealed(_STATUS.pack(b"DCW1", *told, *ages_ms))
