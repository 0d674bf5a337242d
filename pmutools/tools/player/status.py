"""What a player is doing, as a value: for displays, ``stats`` and ``pmu ctl``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Any

from pmutools.errors import SourceError
from pmutools.pacing import LatenessSummary


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

    @classmethod
    def of(cls, late: LatenessSummary) -> PacingStatus:
        return cls(late.p50_ns / 1e3, late.p99_ns / 1e3, late.max_ns / 1e3, late.misses)

    def to_json(self) -> dict[str, Any]:
        return {"p50_us": self.p50_us, "p99_us": self.p99_us, "max_us": self.max_us, "misses": self.misses}

    @classmethod
    def from_json(cls, said: Any) -> PacingStatus:
        return cls(_number(said["p50_us"]), _number(said["p99_us"]), _number(said["max_us"]), int(said["misses"]))


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

    def to_json(self) -> dict[str, Any]:
        """``asdict`` without its deep copies: four times as fast, for thousands."""
        return {
            "name": self.name,
            "idcode": self.idcode,
            "enabled": self.enabled,
            "clients": self.clients,
            "fates": self.fates,
            "pacing": self.pacing.to_json(),
            "faults": self.faults,
        }

    @classmethod
    def from_json(cls, said: Any) -> StreamStatus:
        return cls(
            str(said["name"]),
            int(said["idcode"]),
            bool(said["enabled"]),
            int(said["clients"]),
            {str(fate): int(count) for fate, count in said["fates"].items()},
            PacingStatus.from_json(said["pacing"]),
            {str(option): str(value) for option, value in said["faults"].items()},
        )


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
        """All but the streams, which are written one by one."""
        head = {item.name: getattr(self, item.name) for item in fields(self) if item.name != "streams"}
        return head | {"pacing": self.pacing.to_json()}

    @classmethod
    def from_json(cls, said: Any) -> PlayerStatus:
        """A status as the player sent it, with its ``streams``; raises SourceError where it is not one."""
        try:
            between = said["between"]
            return cls(
                PlayState(said["state"]),
                _number(said["position_s"]),
                _number(said["length_s"]),
                int(said["loop"]),
                _number(said["speed"]),
                (_number(between[0]), _number(between[1])) if between else None,
                _number(said["elapsed_s"]),
                _number(said["frames_per_s"]),
                int(said["sent"]),
                PacingStatus.from_json(said["pacing"]),
                tuple(map(StreamStatus.from_json, said["streams"])),
            )
        except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
            raise SourceError(
                f"the player's answer is not understood ({error!r}); use the player's own version"
            ) from None


def _number(said: Any) -> float:
    return float("nan") if said is None else float(said)
