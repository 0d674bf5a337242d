"""Which frame a stage is looking at."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import PREFIX_SIZE, FrameType
from pmutools.c37118.frames import Data
from pmutools.c37118.layout import layout_of
from pmutools.timebase import to_ns

CONTROL_LANE = 1 << 16
"""Draw lane of frames that are not data: they have a count of their own. Lanes 0, 1, 2... are a data frame's copies."""


class Original:
    """A frame as it came to the pipeline, before any fault. What it says is read when first asked for.

    ``stamp_ns`` is the recorded stamp, where that differs from the one the frame carries (POSIX UTC).
    """

    __slots__ = ("_data", "_stamp_ns", "config", "frame")

    def __init__(self, frame: bytes = b"", config: StreamConfig | None = None, stamp_ns: int | None = None) -> None:
        self.frame = frame
        self.config = config
        self._stamp_ns = stamp_ns
        self._data: Data | None = None

    @property
    def stamp_ns(self) -> int | None:
        """The recorded stamp in ns of POSIX UTC; None where it is not given and cannot be read."""
        if self._stamp_ns is None and self.config is not None and len(self.frame) >= PREFIX_SIZE:
            soc, fracsec = int.from_bytes(self.frame[6:10], "big"), int.from_bytes(self.frame[11:14], "big")
            self._stamp_ns = to_ns(soc, fracsec, self.config.time_base)
        return self._stamp_ns

    @property
    def data(self) -> Data | None:
        """The decoded data frame; None for frames of another size than the configuration's."""
        if self._data is None and self.config is not None and len(self.frame) == self.config.frame_size:
            self._data = Data(self.config, layout_of(self.config).unpacker.unpack(self.frame))
        return self._data


NOTHING = Original()


class Moment(NamedTuple):
    """A frame on its way through the pipeline.

    ``index`` is zero-based among the stream's data frames (or, for other types, among its other frames), ``time_ns``
    stream time, ``offset_ns`` scheduled time from the start of play. ``fresh``: the first data frame of the run, or
    after a configuration.
    """

    index: int  # type: ignore[assignment]  # not tuple.index
    time_ns: int
    type: FrameType = FrameType.DATA
    lane: int = 0
    offset_ns: int = 0
    fresh: bool = False
    original: Original = NOTHING

    @property
    def stamp_ns(self) -> int | None:
        """The recorded stamp in ns of POSIX UTC, where it is known."""
        return self.original.stamp_ns


Test = Callable[[Moment], bool]
"""Whether something concerns a frame."""
