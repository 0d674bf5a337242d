"""Where tshark is known to be wrong, and how a value it is wrong about is marked."""

from __future__ import annotations

from typing import NamedTuple

FAULTS = {
    "cfg3-float-scaling": "PHSCALE and ANSCALE of a CFG-3 are applied to integers only; floats are shown as sent",
    "freq-filler": "an integer FREQ of -32768 is shown as nominal - 32.768 Hz, not as absent",
    "rocof-filler": "an integer DFREQ of -32768 is shown as -327.68 Hz/s, not as absent",
    "half-filler": "one part of an integer rectangular phasor being -32768 makes the whole phasor absent",
    "command-time": "commands and headers have no TIME_BASE; FRACSEC is shown under that of the conversation",
    "no-config": "without a configuration in the same conversation a data frame is not dissected",
}
"""Known faults of the oracle: what :class:`Masked` values refer to.

Faults that need no mask, for the bytes are read: the label of the leap direction bit is inverted, names are shown as
ASCII, ``fracsec_ms`` and scaled analogs of a CFG-3 are single precision. And some that are not to be fed: frames of 16
bytes are not seen, a PHSCALE type above 15 reads past a table, any PHUNIT type but 0 is called a current, fragments of
a CFG-3 are refused, and data is decoded by CFG-2 and CFG-3 only, found by conversation and not by IDCODE.
"""


class OracleError(AssertionError):
    """tshark failed, or what it prints contradicts the bytes it gives the field."""


class Masked(NamedTuple):
    """A value not to be compared; ``fault`` is a key of :data:`FAULTS`."""

    fault: str
