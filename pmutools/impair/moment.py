"""Which frame a stage is looking at."""

from __future__ import annotations

from typing import NamedTuple

from pmutools.c37118.constants import FrameType

CONTROL_LANE = 1 << 16
"""Draw lane of frames that are not data: they have a count of their own. Lanes 0, 1, 2... are a data frame's copies."""


class Moment(NamedTuple):
    """A frame on its way through the pipeline: zero-based index among the stream's data frames (or, for other types,
    among its other frames), stream time in ns, frame type, draw lane."""

    index: int  # type: ignore[assignment]  # not tuple.index
    time_ns: int
    type: FrameType = FrameType.DATA
    lane: int = 0
