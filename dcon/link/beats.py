"""What passes between the watchdog and everybody else, but for the command: beats, readbacks, words, its status.

Big-endian, CRC-32 (zlib) of all before it at the end::

    DCB1 beat      32 bytes  4s magic | 8s loop | I counter | q monotonic_ns | B state | 3x
    DCR1 readback  28 bytes  4s magic | I sequence answered | q monotonic_ns | d V
    DCO1 word      44 bytes  4s magic | B verb | 3x | 32s who
    DCW1 status    44 bytes  4s magic | I counter | q monotonic_ns | B relays | B estop | B state | B healthy | I causes
                             | 8 H age of each loop's last beat in ms (65,534: that or more; 65,535: none came)

The watchdog has a codec of its own for the same datagrams, and the tests hold the two together.
"""

from __future__ import annotations

from enum import IntEnum, StrEnum
from typing import Final, NamedTuple

from dcon.link.sealed import WRAP, Sealed


class LoopName(StrEnum):
    """Who beats."""

    CONTROL = "control"
    UDP = "udp"
    PARSE = "parse"
    GPS = "gps"
    GUI = "gui"
    PDCI = "pdci"
    SERVER = "server"
    OUTPUT = "output"


class LoopState(IntEnum):
    """What a loop says of itself."""

    STARTING = 0
    RUNNING = 1
    ENDING = 2
    FAILED = 3


class Verb(IntEnum):
    """What an operator says to the watchdog."""

    ESTOP = 1
    ESTOP_RELEASE = 2
    RESET = 3


class WatchdogState(IntEnum):
    """OPEN and TRIPPED: the relays are open; TRIPPED is left by a reset only."""

    OPEN = 0
    CLOSED = 1
    TRIPPED = 2


CAUSES: Final = (
    *LoopName,
    *("command_silent", "malformed", "range", "mismatch", "sequence", "stamp", "unasked"),
    *("readback_silent", "readback", "estop_software", "estop_a", "estop_b", "estop_discrepancy"),
    *("relay_open", "relay_welded", "drive", "late", "latch_unreadable"),
)
"""Names of the bits of ``causes``, lowest first."""
_DCB1 = Sealed(b"DCB1", "8sIqB3x")
_DCR1 = Sealed(b"DCR1", "Iqd")
_DCO1 = Sealed(b"DCO1", "B3x32s")
_DCW1 = Sealed(b"DCW1", "IqBBBBI8H")
WHO_BYTES: Final = 32
UNHEARD: Final = 0xFFFF
"""Age in a status of a beat that never came."""


class Readback(NamedTuple):
    """What the output drives, in answer to the command of that ``sequence``."""

    sequence: int
    monotonic_ns: int
    volts: float


class WatchdogStatus(NamedTuple):
    """What the watchdog tells each 20 ms, and when something changes."""

    counter: int
    monotonic_ns: int
    relay_a: bool
    """Closed."""
    relay_b: bool
    estop_software: bool
    """Released."""
    estop_a: bool
    estop_b: bool
    state: WatchdogState
    healthy: bool
    """Every beat and input is good: the relays would close if they were asked to, or may stay closed."""
    causes: tuple[str, ...]
    """What is up, or was latched by a trip; ``server`` only warns."""
    beats_ms: tuple[tuple[str, float], ...] = ()
    """(loop, age of its last beat), of those that have beaten."""

    @property
    def closed(self) -> bool:
        """The command passes."""
        return self.relay_a and self.relay_b

    @property
    def estop_released(self) -> bool:
        """By everybody who can press it."""
        return self.estop_software and self.estop_a and self.estop_b


def encode_beat(loop: LoopName, counter: int, monotonic_ns: int, state: LoopState = LoopState.RUNNING) -> bytes:
    """A sign of life; ``counter`` advances with each round of the loop, and wraps at 2**32."""
    return _DCB1.pack(loop.encode(), counter % WRAP, monotonic_ns, state)


def encode_readback(readback: Readback) -> bytes:
    """To the watchdog, and to the controller."""
    return _DCR1.pack(readback.sequence % WRAP, readback.monotonic_ns, readback.volts)


def decode_readback(datagram: bytes) -> Readback | None:
    """None for anything else."""
    values = _DCR1.unpack(datagram)
    return None if values is None else Readback(*values)


def encode_word(verb: Verb, who: str) -> bytes:
    """An operator's word; of a longer name as many whole characters as find room in 32 bytes."""
    name = who.encode()[:WHO_BYTES].decode(errors="ignore").encode()
    return _DCO1.pack(verb, name)


def decode_status(datagram: bytes) -> WatchdogStatus | None:
    """None for anything else, and for a state that there is not."""
    values = _DCW1.unpack(datagram)
    if values is None or values[4] not in tuple(WatchdogState):
        return None
    counter, monotonic_ns, relays, estop, state, healthy, causes, *ages = values
    return WatchdogStatus(
        counter,
        monotonic_ns,
        bool(relays & 1),
        bool(relays & 2),
        bool(estop & 1),
        bool(estop & 2),
        bool(estop & 4),
        WatchdogState(state),
        bool(healthy),
        tuple(name for bit, name in enumerate(CAUSES) if causes >> bit & 1),
        tuple((str(loop), float(age_ms)) for loop, age_ms in zip(LoopName, ages, strict=True) if age_ms != UNHEARD),
    )
