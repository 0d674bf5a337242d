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

NEAR = Fraction(1, 10)
"""Recorded stamps are rounded: one this share of a period after a reporting instant is taken for on it."""


class StampPolicy(StrEnum):
    SHIFT = "shift"
    KEEP = "keep"
    NOW_GRID = "now-grid"
    NOW = "now"


@dataclass(frozen=True)
class Timeline:
    """When each cue is sent and what stamp it gets.

    ``start_utc_ns`` is the UTC time of offset 0; ``shift_ns``, whole seconds, takes recorded stamps there. ``speed``,
    ``interval_ns`` (send spacing of each stream's frames) and ``fps`` (new stamps and DATA_RATE) are the options'.
    """

    script: Script
    policy: StampPolicy
    start_utc_ns: int
    shift_ns: int
    speed: Fraction = Fraction(1)
    interval_ns: int | None = None
    fps: int | None = None

    @property
    def by_index(self) -> bool:
        """Whether frames are due by their number in the stream, not by their stamp."""
        return self.interval_ns is not None or self.fps is not None

    def stream_ns(self, cue: Cue, loop: int) -> int:
        """Stream time at which a cue of the ``loop``-th round is due: ns from the start, at speed 1."""
        stream = self.script.streams[cue.stream]
        if self.interval_ns is not None:
            first_ns = stream.first_due_ns - self.script.first_due_ns
            return first_ns + (cue.place + loop * stream.frames) * self.interval_ns
        if self.fps is not None:
            return self._resampled_ns(cue, loop, self.fps) - self.start_utc_ns + cue.latency_ns
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
        if self.policy is StampPolicy.SHIFT and self.fps is not None:
            stamp_ns = self._resampled_ns(cue, loop, self.fps)
        else:
            stamp_ns = self.start_utc_ns + offset_ns
            rate = self.config(config).rate
            if self.policy is StampPolicy.NOW_GRID and rate:
                stamp_ns = timebase.slot_time_ns(timebase.slot(stamp_ns, rate), rate)
        soc, fracsec = timebase.from_ns(stamp_ns, config.time_base)
        return restamp(data, soc & 0xFFFFFFFF, fracsec), stamp_ns

    def config(self, config: StreamConfig) -> StreamConfig:
        """The configuration that is announced: with another DATA_RATE if the rate is changed."""
        return config if self.fps is None else replace(config, data_rate=self.fps)

    def _resampled_ns(self, cue: Cue, loop: int, fps: int) -> int:
        """New stamps: a stream's frames at consecutive reporting instants, from the first one it may have."""
        stream, rate = self.script.streams[cue.stream], Fraction(fps)
        later = timebase.slot(stream.first_ns - self.script.first_ns, rate)
        first = timebase.slot(self.start_utc_ns, rate) + later
        return timebase.slot_time_ns(first + cue.place + loop * stream.frames, rate)


def timeline(
    script: Script,
    policy: StampPolicy,
    now_ns: int,
    *,
    speed: Fraction = Fraction(1),
    interval_ns: int | None = None,
    fps: int | None = None,
) -> Timeline:
    """A timeline that begins at ``now_ns`` (POSIX UTC), with ``shift`` at most a second later.

    With ``shift`` the first frame is due at its own new stamp (plus its recorded latency), so latency at the receiver
    is what it was in the recording. ``now-grid`` and new stamps of another rate begin at a reporting instant.
    """
    shift_ns = -(-(now_ns - script.first_due_ns) // timebase.NS) * timebase.NS
    start_ns, rate, slack_ns = now_ns, Fraction(fps or 0), 0
    if policy is StampPolicy.SHIFT:
        start_ns = shift_ns + (script.first_ns if rate else script.first_due_ns)
        slack_ns = round(NEAR * timebase.NS / rate) if rate else 0
    elif policy is StampPolicy.NOW_GRID:
        rate = rate or script.streams[0].config.rate
    if rate:
        index = -(-(start_ns - slack_ns) * rate.numerator // (rate.denominator * timebase.NS))
        start_ns = timebase.slot_time_ns(index, rate)
    return Timeline(script, policy, start_ns, shift_ns, speed, interval_ns, fps)
