"""What time a frame carries when it is sent again: the policies of ``--stamp``.

====================  ==========================================================================================
``shift`` (default)   recorded stamp plus whole seconds, so that the first frame is due now; FRACSEC is kept
``keep``              as recorded
``now-grid``          the reporting instant nearest to the time of sending
``now``               the time of sending (off the reporting grid: a fault)
====================  ==========================================================================================
"""

from __future__ import annotations

from enum import StrEnum
from fractions import Fraction

import numpy as np
import numpy.typing as npt

from pmutools import timebase
from pmutools.timebase import NS
from pmutools.tools.player.reel import I64, Reel, slot_times

SOC, FRACSEC, IDCODE = slice(6, 10), slice(11, 14), slice(4, 6)


class StampPolicy(StrEnum):
    SHIFT = "shift"
    KEEP = "keep"
    NOW_GRID = "now-grid"
    NOW = "now"


def shifted(stamps_ns: I64, reel: Reel, loop: int, shift_ns: int) -> I64:
    """Stamps (N,) of the reel's rows moved by whole seconds, and on by ``loop`` rounds."""
    if reel.fps is None:
        return stamps_ns + (shift_ns + loop * reel.round_stamp_ns)
    slots = timebase.slots_array(stamps_ns, Fraction(reel.fps)) + loop * reel.round_slots
    return slot_times(slots, reel.fps) + shift_ns


def on_grid(times_ns: I64, rate: Fraction) -> I64:
    """The reporting instants (N,) nearest to times (N,), POSIX UTC ns."""
    slots = timebase.slots_array(times_ns, rate)
    return slot_times(slots, rate.numerator) if rate.denominator == 1 else slots * rate.denominator * NS


def gathered(wire: npt.NDArray[np.uint8], at: I64, size: int) -> npt.NDArray[np.uint8]:
    """The frames of ``size`` bytes that begin at ``at`` (N,), as a matrix (N, size) of their own."""
    view = np.ndarray((len(wire) - size + 1,), f"V{size}", buffer=wire, strides=(1,))
    return view[at].view(np.uint8).reshape(len(at), size)


def write_stamps(frames: npt.NDArray[np.uint8], soc: I64, fracsec: I64 | None) -> None:
    """SOC and, if given, FRACSEC of frames (N, size); CHK is left as it was."""
    frames[:, SOC] = soc.astype(">u4")[:, None].view(np.uint8)
    if fracsec is not None:
        frames[:, FRACSEC] = fracsec.astype(">u4")[:, None].view(np.uint8)[:, 1:]


def write_idcodes(frames: npt.NDArray[np.uint8], idcodes: npt.NDArray[np.uint16]) -> None:
    """IDCODE of frames (N, size)."""
    frames[:, IDCODE] = idcodes.astype(">u2")[:, None].view(np.uint8)
