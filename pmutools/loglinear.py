"""Log-linear bins of whole numbers: one bin a number at first, then equally many in every octave.

With ``bits`` fraction bits, numbers below 2**(bits + 1) have a bin each, and a bin beyond is at most 2**-bits of its
numbers wide. So 5 bits hold any number to 3.2 %, 10 bits to 0.1 % (three digits), at a cost that does not depend on
how many numbers there are: the bin is read from the exponent and the first bits of a float.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

_MANTISSA_BITS, _BIAS = 52, 1023


def bins(values: npt.NDArray[np.int64], bits: int) -> npt.NDArray[np.int64]:
    """The bins of numbers (N,) that are not negative."""
    found = values.astype(np.float64).view(np.int64)
    found >>= _MANTISSA_BITS - bits
    found -= (_BIAS + bits - 1) << bits
    return np.where(values < 1 << bits, values, found)


def bin_of(value: int, bits: int) -> int:
    """The bin of one number that is not negative."""
    shift = max(0, value.bit_length() - bits - 1)
    return (shift << bits) + (value >> shift)


def low(index: int, bits: int) -> int:
    """The smallest number of a bin."""
    if index < 2 << bits:
        return index
    shift = (index >> bits) - 1
    return index - (shift << bits) << shift


def lows(indices: npt.NDArray[np.int64], bits: int) -> npt.NDArray[np.int64]:
    """:func:`low` of bins (N,)."""
    shift = np.maximum((indices >> bits) - 1, 0)
    found: npt.NDArray[np.int64] = indices - (shift << bits) << shift
    return found


def high(index: int, bits: int) -> int:
    """The largest number of a bin."""
    return low(index + 1, bits) - 1
