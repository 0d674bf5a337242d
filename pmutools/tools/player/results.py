"""What became of a run, stream by stream: fates counted, and how far from its deadline each frame left."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pmutools.c37118.config import StreamConfig
from pmutools.pacing import Lateness, LatenessSummary
from pmutools.timebase import NS
from pmutools.tools.player.reel import I64
from pmutools.tools.player.sheet import FATES, SENT
from pmutools.tools.player.status import PacingStatus

_AT_ONCE = 4096


@dataclass(frozen=True, slots=True)
class StreamResult:
    """One stream's frames: how many of each fate, and how late those sent left."""

    name: str
    idcode: int
    fates: dict[str, int]
    late: LatenessSummary

    def to_json(self) -> dict[str, Any]:
        pacing = PacingStatus.of(self.late)
        late_us = {"p50": pacing.p50_us, "p99": pacing.p99_us, "max": pacing.max_us}
        counts = {"name": self.name, "idcode": self.idcode, "fates": self.fates}
        return counts | {"late_us": late_us, "misses": pacing.misses}


class Results:
    """Up to date whenever it is read; counting is put off until then, or until there is much to count."""

    def __init__(self, names: Sequence[str], configs: Sequence[StreamConfig]) -> None:
        self._names, self._idcodes = names, [config.idcode for config in configs]
        self._lateness = Lateness([_half_period(config) for config in configs])
        self._fates = np.zeros((len(names), len(FATES)), np.int64)
        self._put_off: list[tuple[npt.NDArray[np.int32], npt.NDArray[np.uint8], I64]] = []
        self._waiting = 0

    def add(self, part: npt.NDArray[np.int32], fate: npt.NDArray[np.uint8], late_ns: I64) -> None:
        """Take note of copies (N,); ``late_ns`` counts for those sent."""
        self._put_off.append((part, fate, late_ns))
        self._waiting += len(part)
        if self._waiting >= _AT_ONCE:
            self._count()

    def _count(self) -> None:
        if not self._put_off:
            return
        part, fate, late_ns = (np.concatenate(columns) for columns in zip(*self._put_off, strict=True))
        self._put_off.clear()
        self._waiting = 0
        fates = np.bincount(part * np.int64(len(FATES)) + fate, minlength=self._fates.size)
        self._fates += fates.reshape(self._fates.shape)
        sent = fate == SENT
        self._lateness.add(part[sent], late_ns[sent])

    @property
    def lateness(self) -> Lateness:
        self._count()
        return self._lateness

    @property
    def sent(self) -> int:
        self._count()
        return int(self._fates[:, SENT].sum())

    def fates(self, stream: int | None = None) -> dict[str, int]:
        """Of one stream, or of all together."""
        self._count()
        counts = self._fates.sum(axis=0) if stream is None else self._fates[stream]
        return {str(fate): int(count) for fate, count in zip(FATES, counts, strict=True) if count}

    def __iter__(self) -> Iterator[StreamResult]:
        return (self[stream] for stream in range(len(self)))

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, stream: int) -> StreamResult:
        return StreamResult(
            self._names[stream], self._idcodes[stream], self.fates(stream), self.lateness.summary(stream)
        )


def _half_period(config: StreamConfig) -> int:
    return round(NS / config.rate / 2) if config.rate else NS // 2
