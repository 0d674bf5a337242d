"""What was measured in some hundred bins, as text of the impairment grammar: what is exported where no fit is like it.

Bins of equal count alone would hold the last hundredth of the frames in one, spread evenly as far as the largest, and
p99.9 would be where nothing was measured. So bins grow finer towards both ends: the edge before a share s of the values
is counted by 80 s + 4 ln(s/(1 - s)).
"""

from __future__ import annotations

import numpy as np

from pmutools.measure.histogram import NS_PER_MS, Histogram

EVEN_BINS, TAIL_BINS, GAPS = 80, 4, 60
"""Bins of equal count; more to each factor e of what lies beyond; empty stretches."""


def histogram_text(measured: Histogram) -> str:
    """What was measured, as ``histogram(low, high, count, ...)`` in ms.

    A bin holds about an 80th of all and a quarter of what lies beyond it at most, down to single values, unless one bin
    of the measured holds more. The least and the largest are edges; the widest 60 stretches where nothing was measured
    lie between bins. So n values have up to 80 + 8 ln(2 n) + 60 bins.
    """
    bins = measured.bins()
    low = np.maximum(bins.low_ns, measured.min_ns or 0)
    high = np.minimum(bins.high_ns, measured.max_ns or 0)
    rank = (np.cumsum(bins.count) - bins.count / 2) / measured.count
    groups = np.floor(EVEN_BINS * rank + TAIL_BINS * np.log(rank / (1 - rank)))
    empty = low[1:] - high[:-1]
    widest = np.argsort(empty, kind="stable")[-GAPS:]
    after_gap = np.isin(np.arange(1, len(low)), widest[empty[widest] > 0] + 1)
    starts = np.concatenate(([0], np.flatnonzero((np.diff(groups) != 0) | after_gap) + 1))
    rows = []
    for first, end in zip(starts, [*starts[1:], len(low)], strict=True):
        rows.append(f"{low[first] / NS_PER_MS:.9g}, {high[end - 1] / NS_PER_MS:.9g}, {bins.count[first:end].sum()}")
    return f"histogram({',  '.join(rows)})"
