"""A player that only notes what it is told, with the state of one."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any, cast

from pmutools.errors import SettingsError
from pmutools.impair.profile import Action
from pmutools.parsers import no_such_stream
from pmutools.tools.player.status import PacingStatus, PlayerStatus, PlayState, StreamStatus

NAMES = ("N1", "N2", "S1", "S2", "E1", "E2", "W1", "W2")


def stream_status(number: int, name: str = "") -> StreamStatus:
    faults = {"loss": "gemodel(1%,20%)", "delay": "normal(16,2) corr=30%"} if number % 3 == 1 else {}
    name = name or (NAMES[number] if number < len(NAMES) else f"PMU-{number:04d}")
    fates = {"sent": 1800 + number, "lost": 17 * (number % 3), "dropped": number % 2, "disabled": 60 * (number == 2)}
    return StreamStatus(
        name,
        101 + number,
        number != 2,
        1 + number % 2,
        fates,
        PacingStatus(21.0 + number, 180.0, 903.5, number),
        faults,
    )


def player_status(streams: int = 8) -> PlayerStatus:
    """A player amid its work."""
    return PlayerStatus(
        state=PlayState.PLAYING,
        position_s=12.5,
        length_s=30.0,
        loop=2,
        speed=1.0,
        between=(5.0, 20.0),
        elapsed_s=72.5,
        frames_per_s=60.0 * streams,
        sent=1800 * streams,
        pacing=PacingStatus(21.0, 180.0, 903.5, 2),
        streams=tuple(stream_status(number) for number in range(streams)),
    )


def whole_json(status: PlayerStatus) -> dict[str, Any]:
    """A state as it goes over the wire."""
    said = status.to_json() | {"streams": [stream.to_json() for stream in status.streams]}
    return cast("dict[str, Any]", json.loads(json.dumps(said)))


class FakePlayer:
    """Obeys what changes its state, notes all, refuses stream N9."""

    def __init__(self, streams: int = 8) -> None:
        self.done: list[str] = []
        self.actions: list[Action] = []
        self.now = player_status(streams)

    def act(self, action: Action) -> None:
        patterns = ",".join(action.rule.patterns) if action.rule else ""
        if patterns == "N9":
            raise SettingsError(no_such_stream(f"{action.verb} {patterns}", NAMES[: len(self.now.streams)]))
        self.actions.append(action)
        self.done.append(" ".join(filter(None, (action.verb, patterns, action.argument))))
        match action.verb:
            case "pause":
                self.now = replace(self.now, state=PlayState.PAUSED)
            case "resume":
                self.now = replace(self.now, state=PlayState.PLAYING)
            case "speed":
                self.now = replace(self.now, speed=float(action.argument))
            case "seek":
                self.now = replace(self.now, position_s=float(action.argument))

    def status(self) -> PlayerStatus:
        return self.now
