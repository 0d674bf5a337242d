"""The command as a datagram, to the watchdog and from it to a plant, a gateway or the output. 40 bytes, big-endian::

    4s magic "DCN1" | I sequence | q time_ns (UTC of the tick) | d command MW | d output V | I flags | I CRC-32

The MW are those really driven: 0 in open loop. A receiver must ignore what is not 40 bytes, has another magic, a
CRC that does not hold, or a sequence it has passed; and must go to 0 MW when datagrams stop coming.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from dcon.link.sealed import WRAP, Sealed

RELAYS: Final = 1
"""Flag: the controller asks for closed relays."""
CLOSED: Final = 2
"""Flag, set by the watchdog alone: the relays are closed."""
_DCN1 = Sealed(b"DCN1", "IqddI")
SIZE = _DCN1.size


class CommandOut(NamedTuple):
    """What one datagram says."""

    sequence: int
    time_ns: int
    command_mw: float
    output_v: float
    flags: int = 0


def encode(command: CommandOut) -> bytes:
    """The datagram of a command; the sequence wraps at 2**32."""
    return _DCN1.pack(command.sequence % WRAP, *command[1:4], command.flags % WRAP)


def decode(datagram: bytes) -> CommandOut | None:
    """The command in a datagram; None for anything else."""
    values = _DCN1.unpack(datagram)
    return None if values is None else CommandOut(*values)
