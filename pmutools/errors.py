"""Every error that pmutools raises on purpose.

::

    PmuError
    ├── WireError       (ValueError)   bytes that are not what they claim; raised by one-shot ``decode_*`` only
    │   ├── ChecksumError              CHK differs
    │   ├── LengthError                FRAMESIZE, or the bytes at hand, do not fit the layout
    │   └── ConfigError                a configuration that cannot describe a stream, or none for this IDCODE
    ├── EncodeError     (ValueError)   our caller asked for a frame that the standard cannot carry
    ├── SourceError     (OSError)      a file or endpoint that cannot be read or written
    │   └── StreamTimeout  (TimeoutError)  no data came for as long as the caller wanted to wait
    └── SettingsError   (ValueError)   a user's option, key or value

Each also inherits the standard library's type, so that callers who do not know us can catch it.
Stream input never raises: bad bytes become counted :class:`~pmutools.c37118.framer.Skipped` records.
"""

from __future__ import annotations


class PmuError(Exception):
    """Base of all; ``str()`` of it is one line that a user can act on."""


class WireError(PmuError, ValueError):
    """Bytes that do not decode. ``idcode`` and ``offset`` (bytes from the frame's start) are None where unknown."""

    def __init__(self, message: str, *, idcode: int | None = None, offset: int | None = None) -> None:
        super().__init__(message)
        self.idcode = idcode
        self.offset = offset


class ChecksumError(WireError):
    """CHK in the frame (``actual``) is not the one computed from its bytes (``expected``)."""

    def __init__(self, expected: int, actual: int, *, idcode: int | None = None) -> None:
        super().__init__(f"CHK is {actual:#06x}, computed {expected:#06x}", idcode=idcode)
        self.expected = expected
        self.actual = actual


class LengthError(WireError):
    """A frame of ``actual`` bytes where ``expected`` are needed."""

    def __init__(self, what: str, expected: int, actual: int, *, idcode: int | None = None) -> None:
        super().__init__(f"{what}: {actual} bytes where {expected} are needed", idcode=idcode)
        self.expected = expected
        self.actual = actual


class ConfigError(WireError):
    """A configuration that cannot describe a stream."""


class EncodeError(PmuError, ValueError):
    """A value that the frame asked for cannot carry."""


class SourceError(PmuError, OSError):
    """A file or an endpoint that cannot be read or written; the message names it."""


class StreamTimeout(SourceError, TimeoutError):
    """No data came for as long as the caller wanted to wait; the message says why, as far as that is known."""


class SettingsError(PmuError, ValueError):
    """A user's mistake in an option, file, section, key or value; the message names all it knows of these."""
