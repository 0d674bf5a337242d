"""What a player is doing, as a value: for displays, ``stats`` and ``pmu ctl``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from enum import StrEnum
from typing import Any


class PlayState(StrEnum):
    WAITING = "waiting"
    """For the first start command, or for the time to begin."""
    PLAYING = "playing"
    PAUSED = "paused"
    ENDED = "ended"


@dataclass(frozen=True, slots=True)
class PacingStatus:
    """How far from their deadlines frames left, in µs; ``misses`` are later than half a reporting interval."""

    p50_us: float
    p99_us: float
    max_us: float
    misses: int


@dataclass(frozen=True, slots=True)
class StreamStatus:
    """One stream: whether the operator lets it speak, who gets it, what became of its frames, its faults in force."""

    name: str
    idcode: int
    enabled: bool
    clients: int
    fates: dict[str, int]
    pacing: PacingStatus
    faults: dict[str, str]
    """By option, as they can be written again."""


@dataclass(frozen=True, slots=True)
class PlayerStatus:
    """The whole player at one moment; ``position_s`` counts from the first frame of the source, ``loop`` from 0."""

    state: PlayState
    position_s: float
    length_s: float
    loop: int
    speed: float
    between: tuple[float, float] | None
    """The A-B loop in force, seconds into the source."""
    elapsed_s: float
    frames_per_s: float
    sent: int
    pacing: PacingStatus
    streams: Sequence[StreamStatus]
    """Each worked out when it is looked at: there may be thousands."""

    def to_json(self) -> dict[str, Any]:
        head = {item.name: getattr(self, item.name) for item in fields(self) if item.name != "streams"}
        return head | {"pacing": asdict(self.pacing), "streams": [asdict(stream) for stream in self.streams]}
