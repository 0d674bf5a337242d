"""What frames say of themselves: STAT, time quality, values that are there; and what happened around them.

The attributes are those that NASPI's PARTF report names (NASPI-2016-TR-002); it gives no formulas, these are ours:

============ ==================================================================================================
availability received unique slots / expected slots
completeness frames that can be used / expected slots: CHK right, data valid by STAT at every station,
             synchronised (MSG_TQ locked, STAT in sync), no number absent
time quality share of frames by MSG_TQ, unlocked-time and PMU_TQ code, and how often they change
============ ==================================================================================================
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from pmutools.c37118.batch import NO_TIME, STAMP_SOURCES
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import (
    DataError,
    LeapFlag,
    Stat,
    stat_data_error,
    stat_pmu_tq,
    stat_trigger_reason,
    stat_unlocked_time,
)
from pmutools.flow import StampSource
from pmutools.measure.columns import Frames, Gist
from pmutools.measure.counts import LARGEST, Counts

_FLAGS = (Stat.NOT_SYNCHRONISED, Stat.SORTED_BY_ARRIVAL, Stat.TRIGGER, Stat.CONFIG_CHANGE, Stat.DATA_MODIFIED)


@dataclass
class QualityCounts(Counts):
    """Frames by what they say; copies count too."""

    frames: int = 0
    usable: int = 0
    """Valid, synchronised and whole."""
    invalid: int = 0
    """STAT says at some station that its data are bad, or all its values are absent."""
    absent: int = 0
    """Some phasor or frequency is NaN."""
    time_quality: dict[int, int] = field(default_factory=dict)
    """Frames by the whole time quality byte."""
    stat: dict[tuple[int, int], int] = field(default_factory=dict)
    """Frames by (station's number, STAT)."""
    source: dict[int, int] = field(default_factory=dict)
    """Frames that somebody saw come, by index into STAMP_SOURCES."""
    time_quality_changes: int = 0
    sync_changes: int = 0
    config_changes: int = 0
    """Another configuration came into force."""
    cfgcnt_changes: int = 0
    """... that counts its changes otherwise than the one before."""

    def share(self, found: int) -> float | None:
        return found / self.frames if self.frames else None

    def by_code(self, shift: int, mask: int) -> dict[int, int]:
        """Stations' frames by a field of STAT."""
        found: dict[int, int] = {}
        for (_, word), count in self.stat.items():
            code = word >> shift & mask
            found[code] = found.get(code, 0) + count
        return found

    @property
    def tq_codes(self) -> dict[int, int]:
        """Frames by MSG_TQ."""
        found: dict[int, int] = {}
        for octet, count in self.time_quality.items():
            found[octet & 0xF] = found.get(octet & 0xF, 0) + count
        return found

    @property
    def leap_flagged(self) -> int:
        """Frames with a leap second occurred or pending."""
        return sum(n for octet, n in self.time_quality.items() if octet & (LeapFlag.OCCURRED | LeapFlag.PENDING))

    def source_share(self, source: StampSource) -> float:
        """Share of frames whose arrival ``source`` took."""
        return self.source.get(STAMP_SOURCES.index(source), 0) / self.frames if self.frames else 0.0

    def flag_share(self, flag: Stat) -> float | None:
        """Share of the stations' frames that set a flag."""
        total = sum(self.stat.values())
        return sum(n for (_, word), n in self.stat.items() if word & flag) / total if total else None

    def to_json(self, expected: int, received: int, stations: Iterable[str] = ()) -> dict[str, Any]:
        total = sum(self.stat.values())
        names = list(stations)

        def shares(codes: dict[int, int], of: int) -> dict[str, float]:
            return {f"{code:X}": count / of for code, count in sorted(codes.items())} if of else {}

        return {
            "availability": received / expected if expected else None,
            "completeness": min(1.0, self.usable / expected) if expected else None,
            "usable": self.share(self.usable),
            "invalid": self.share(self.invalid),
            "absent": self.share(self.absent),
            "time_quality": shares(self.tq_codes, self.frames),
            "time_quality_changes": self.time_quality_changes,
            "sync_changes": self.sync_changes,
            "leap": self.share(self.leap_flagged),
            "data_error": {
                DataError(code).name.lower(): share / total for code, share in sorted(self.by_code(14, 3).items())
            },
            **{flag.name.lower(): self.flag_share(flag) for flag in _FLAGS if flag.name},
            "pmu_tq": shares(self.by_code(6, 7), total),
            "unlocked_time": shares(self.by_code(4, 3), total),
            "trigger_reason": shares(self._reasons(), total),
            "stamp_source": {
                str(STAMP_SOURCES[index]): count / self.frames for index, count in sorted(self.source.items())
            },
            "config_changes": self.config_changes,
            "cfgcnt_changes": self.cfgcnt_changes,
            "stations": [
                {
                    "name": names[number] if number < len(names) else str(number),
                    "stat": {f"0x{word:04X}": n for (at, word), n in sorted(self.stat.items()) if at == number},
                }
                for number in sorted({number for number, _ in self.stat})
            ],
        }

    def _reasons(self) -> dict[int, int]:
        found: dict[int, int] = {}
        for (_, word), count in self.stat.items():
            if word & Stat.TRIGGER:
                reason = stat_trigger_reason(word)
                found[reason] = found.get(reason, 0) + count
        return found

    def worst_stat(self) -> tuple[int, int, int]:
        """The worst (data error, PMU_TQ, unlocked time) codes seen."""
        words = [word for _, word in self.stat]
        return (
            max((int(stat_data_error(word)) for word in words), default=0),
            max((stat_pmu_tq(word) for word in words), default=0),
            max((stat_unlocked_time(word) for word in words), default=0),
        )


class QualityMeter:
    """Counts what frames say, from frames in order of arrival."""

    def __init__(self) -> None:
        self.counts = QualityCounts()
        self.config: StreamConfig | None = None
        self._last: tuple[int, bool] | None = None

    def add(self, gist: Gist, frames: Frames) -> None:
        """Count frames, which are the same in both forms."""
        counts = self.counts
        counts.frames += gist.frames
        usable = frames.synchronised
        if not gist.valid.all():
            counts.invalid += int(np.count_nonzero(~gist.valid))
            usable = usable & gist.valid
        if gist.absent is not None:
            counts.absent += int(np.count_nonzero(gist.absent))
            usable = usable & ~gist.absent
        counts.usable += int(np.count_nonzero(usable))
        _count(counts.time_quality, gist.time_quality)
        unknown = gist.arrival_ns == NO_TIME
        _count(counts.source, gist.stamp_source[~unknown] if unknown.any() else gist.stamp_source)
        first = gist.stat[0]
        alike = bool((gist.stat == first).all())
        for number, word in enumerate(first.tolist()):
            found = {word: gist.frames} if alike else {}
            if not alike:
                _count(found, gist.stat[:, number])
            for seen, count in found.items():
                counts.stat[number, seen] = counts.stat.get((number, seen), 0) + count
        code = gist.time_quality & 0xF
        sync = frames.stat & np.uint16(Stat.NOT_SYNCHRONISED) == 0
        counts.time_quality_changes += int(np.count_nonzero(code[1:] != code[:-1]))
        counts.sync_changes += int(np.count_nonzero(sync[1:] != sync[:-1]))
        if self._last is not None:
            counts.time_quality_changes += self._last[0] != int(code[0])
            counts.sync_changes += self._last[1] != bool(sync[0])
        self._last = int(code[-1]), bool(sync[-1])

    def configured(self, config: StreamConfig) -> None:
        """What comes next is ruled by ``config``."""
        if self.config is config:
            return
        if self.config is not None and config != self.config:
            self.counts.config_changes += 1
            counted = ([station.cfgcnt for station in each.stations] for each in (self.config, config))
            self.counts.cfgcnt_changes += next(counted) != next(counted)
        self.config = config


def _count(found: dict[int, int], codes: npt.NDArray[np.unsignedinteger[Any]]) -> None:
    if not codes.size:
        return
    first = codes[0]
    if (codes == first).all():
        found[int(first)] = found.get(int(first), 0) + len(codes)
        return
    for code, count in zip(*np.unique(codes, return_counts=True), strict=True):
        found[int(code)] = found.get(int(code), 0) + int(count)


@dataclass
class Events(Counts):
    """What happened around the frames, as told by who received them."""

    corrupt: int = 0
    """Frames whose CHK is wrong: lost frames too (RFC 7680)."""
    bad_size: int = 0
    """Frames whose FRAMESIZE does not fit their configuration."""
    skipped_bytes: int = 0
    """Bytes that are part of no frame."""
    before_config: int = 0
    """Data frames whose IDCODE had no configuration that fits, or none yet."""
    own_drops: int = 0
    """Datagrams that this host's socket buffer had no room for: no loss of the network's."""
    connects: int = 0
    """Connections made; over UDP and in recordings, sockets or connections that it came by."""
    disconnects: int = 0
    """Connections lost, or followed by another."""
    senders: int = field(default=0, metadata=LARGEST)
    """Most senders heard at once; 2 are one too many."""
    retransmits: int = 0
    """Segments that this end of TCP sent again, as its kernel counts them."""
    out_of_order: int = 0
    """Segments of TCP that came while an earlier one was missing: it was lost, or overtaken."""
    stalls: int = 0
    """Times that the measuring host stood still for more than 50 ms."""
    longest_stall_ms: float = field(default=0.0, metadata=LARGEST)
    """The longest of them."""
    first_config_ms: float = field(default=0.0, metadata=LARGEST)
    """From the start to the first configuration."""
    first_data_ms: float = field(default=0.0, metadata=LARGEST)
    """From the start to the first data frame."""

    def to_json(self) -> dict[str, Any]:
        return dict(vars(self))
