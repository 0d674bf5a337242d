"""What time a frame carries when it is sent again, and when it is due: the policies of ``--stamp``, ``--fps``, ...

====================  ==========================================================================================
``shift`` (default)   recorded stamp plus whole seconds, so that the first frame is due now; FRACSEC is kept
``keep``              as recorded
``now-grid``          the reporting instant nearest to the time of sending
``now``               the time of sending (off the reporting grid: a fault)
====================  ==========================================================================================
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from fractions import Fraction

from pmutools import timebase
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.frames import restamp
from pmutools.tools.player.script import Cue, Script


class StampPolicy(StrEnum):
    SHIFT = "shift"
    KEEP = "keep"
    NOW_GRID = "now-grid"
    NOW = "now"


@dataclass(frozen=True)
class Timeline:
    """When each cue is sent and what stamp it gets.

    ``start_utc_ns`` is the UTC time of offset 0; ``shift_ns``, whole seconds, takes recorded stamps there. ``speed``,
    ``interval_ns`` (send spacing of each stream's frames) and ``fps`` (new stamps and DATA_RATE) are the
    options'.
    """

    script: Script
    policy: StampPolicy
    start_utc_ns: int
    shift_ns: int
    speed: Fraction = Fraction(1)
    interval_ns: int | None = None
    fps: int | None = None

    def stream_ns(self, cue: Cue, loop: int) -> int:
        """Stream time at which a cue of the ``loop``-th round is due: ns from the start, at speed 1."""
        if self.interval_ns is not None:
            return self._index(cue, loop) * self.interval_ns
        if self.fps is not None:
            return self._resampled_ns(cue, loop)
        return cue.due_ns + loop * self.script.loop_ns

    def offset_ns(self, stream_ns: int) -> int:
        """Wall time from the start of play."""
        return stream_ns * self.speed.denominator // self.speed.numerator

    def stamped(self, cue: Cue, loop: int, offset_ns: int) -> tuple[bytes, int]:
        """The frame with its new stamp, and that stamp in POSIX UTC ns."""
        config, data = cue.config, cue.data
        if self.policy is StampPolicy.KEEP:
            return data, cue.stamp_ns
        if self.policy is StampPolicy.SHIFT and self.fps is None:
            shift_ns = self.shift_ns + loop * self.script.loop_ns
            soc = int.from_bytes(data[6:10], "big") + shift_ns // timebase.NS
            fracsec = int.from_bytes(data[11:14], "big")
            return restamp(data, soc & 0xFFFFFFFF, fracsec), cue.stamp_ns + shift_ns
        if self.policy is StampPolicy.SHIFT:
            stamp_ns = self.script.first_stamp_ns + self.shift_ns + self._resampled_ns(cue, loop)
        else:
            stamp_ns = self.start_utc_ns + offset_ns
            rate = Fraction(self.fps) if self.fps is not None else config.rate
            if self.policy is StampPolicy.NOW_GRID and rate:
                stamp_ns = timebase.slot_time_ns(timebase.slot(stamp_ns, rate), rate)
        return restamp(data, *timebase.from_ns(stamp_ns, config.time_base)), stamp_ns

    def config(self, config: StreamConfig) -> StreamConfig:
        """The configuration that is announced: with another DATA_RATE if the rate is changed."""
        return config if self.fps is None else replace(config, data_rate=self.fps)

    def _index(self, cue: Cue, loop: int) -> int:
        return cue.number + loop * self.script.streams[cue.stream].frames

    def _resampled_ns(self, cue: Cue, loop: int) -> int:
        assert self.fps is not None
        return self._index(cue, loop) * timebase.NS // self.fps


def timeline(
    script: Script,
    policy: StampPolicy,
    now_ns: int,
    *,
    speed: Fraction = Fraction(1),
    interval_ns: int | None = None,
    fps: int | None = None,
) -> Timeline:
    """A timeline that begins at ``now_ns`` (POSIX UTC), or with ``shift`` at most a second later.

    With ``shift`` the first frame is due at its own new stamp (plus its recorded latency), so latency at the receiver
    is what it was in the recording.
    """
    shift_ns = -(-(now_ns - script.first_due_ns) // timebase.NS) * timebase.NS
    start_ns = script.first_due_ns + shift_ns if policy is StampPolicy.SHIFT else now_ns
    return Timeline(script, policy, start_ns, shift_ns, speed, interval_ns, fps)
