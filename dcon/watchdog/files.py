"""Lines that are files: inputs that are read, and outputs that drive the relays. GPIO value files are such.

Every access opens the file anew, without waiting: a file may be replaced, and a pipe in its place holds nothing up.
"""

from __future__ import annotations

import os
from typing import Final, NamedTuple

from dcon.watchdog.memory import Contact, Driven, Inputs

LONGEST: Final = 4
"""A file that holds more says nothing."""


def read_line(path: str) -> bytes:
    """What a file holds, without the end of its line; nothing where it cannot be read."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            return os.read(handle, LONGEST).removesuffix(b"\n")
        finally:
            os.close(handle)
    except OSError:
        return b""


def write_line(path: str, level: bool) -> bool:
    """Drive a file that is there to 1 or 0; whether that was done."""
    try:
        handle = os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            return os.write(handle, b"1\n" if level else b"0\n") == 2
        finally:
            os.close(handle)
    except OSError:
        return False


def released(path: str) -> bool | None:
    """A line of the emergency stop: released is exactly ``1``; None where none is fitted."""
    return read_line(path) == b"1" if path else None


def contact(path: str) -> Contact | None:
    """The contact of a relay: ``1`` closed, ``0`` open; None where none is fitted."""
    if not path:
        return None
    return {b"0": Contact.OPEN, b"1": Contact.CLOSED}.get(read_line(path), Contact.UNKNOWN)


class Lines(NamedTuple):
    """Paths; "" is not fitted."""

    estop_a: str = ""
    estop_b: str = ""
    contact_a: str = ""
    contact_b: str = ""
    relay_a: str = ""
    relay_b: str = ""
    pulse: bool = False
    """A closed relay is driven by a level that turns each tick, so that a monostable drops out when that stops."""

    def read(self) -> Inputs:
        """All inputs."""
        return Inputs(released(self.estop_a), released(self.estop_b), contact(self.contact_a), contact(self.contact_b))

    def drive(self, closed_a: bool, closed_b: bool, tick: int) -> Driven:
        """Drive both relays; open is 0, closed is 1, or with ``pulse`` 1 in every other tick."""
        high = not self.pulse or tick % 2 == 1
        done = [
            write_line(path, closed and high)
            for path, closed in ((self.relay_a, closed_a), (self.relay_b, closed_b))
            if path
        ]
        return Driven(all(done))
