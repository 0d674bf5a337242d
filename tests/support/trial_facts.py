"""What has to be seen of the trials of a running controller, each fact judged from the logs and the gateway."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from support.logged import ramps_down

from dcon.core.values import Event, Order, SystemState
from dcon.link.command import CommandOut
from dcon.session.reader import LoggedTick
from pmutools.timebase import NS

SOON_MS = 120
"""The watchdog's stated time for a fast loop."""


@dataclass
class Seen:
    """One trial: when it was, and what was found at its end."""

    from_ns: int
    to_ns: int = 0
    state: str = ""
    commands: list[CommandOut] = field(default_factory=list)
    """What the gateway got meanwhile."""
    watchdog: list[dict[str, Any]] = field(default_factory=list)
    """Events of its log meanwhile."""
    ticks: list[LoggedTick] = field(default_factory=list)
    restarts: list[str] = field(default_factory=list)
    more: Any = None

    @property
    def late_ms(self) -> float:
        """For how long the machine had kept the watchdog from running when it opened the relays."""
        opening = next((event for event in self.watchdog if event["event"] in ("trip", "open")), None)
        return max(0.0, opening["late_ms"]) if opening else 0.0

    @property
    def events(self) -> list[Event]:
        return [event for tick in self.ticks for event in tick.record.events]

    @property
    def orders(self) -> list[Order]:
        return [order for tick in self.ticks for order in tick.orders]


def every_tick_is_run(trial: Seen) -> None:
    steps = {round((b.record.tick_ns - a.record.tick_ns) * 60 / NS) for a, b in pairwise(trial.ticks)}
    assert steps == {1}


def the_other_pmu_is_heard(trial: Seen) -> None:
    """Every stamp from the first to the last."""
    heard = {frame.time_ns for tick in trial.ticks for frame in tick.frames if frame.name == "S1"}
    slots = sorted(round(time_ns * 60 / NS) for time_ns in heard)
    assert slots == list(range(slots[0], slots[0] + len(slots)))
    assert len(slots) >= len(trial.ticks) - 3


def nothing_spoofed_reaches_a_tick(trial: Seen) -> None:
    """Those that do are on the instants of the true PMU, one a tick."""
    frames = [frame for tick in trial.ticks for frame in tick.frames if frame.name == "N1"]
    assert len(frames) <= len(trial.ticks) + 3
    assert all(abs(frame.time_ns * 60 / NS - round(frame.time_ns * 60 / NS)) < 1e-3 for frame in frames)


def forged_and_replayed_are_refused(trial: Seen) -> None:
    forged, good, replayed = trial.more
    assert "signature" in forged["refused"] and "replayed" in replayed["refused"] and good["accepted"]
    assert [(order.name, order.value) for order in trial.orders if order.name == "gain"] == [("gain", 10.0)]
    refused = [event for event in trial.events if event.name == "refused"]
    assert {event.subject for event in refused} == {"link"} and len(refused) == 2


def who_and_why_are_logged(trial: Seen) -> None:
    (stop,) = [order for order in trial.orders if order.name == "estop"]
    assert (stop.who, stop.why) == ("ann", "a trial")
    assert trial.watchdog[0]["who"] == "ann"


def nothing_is_driven_in_estop(trial: Seen) -> None:
    after = [tick.record for tick in trial.ticks if tick.record.state == "ESTOP"]
    assert {record.output_v for record in after} == {0.0}


def relays_open_in_time(trial: Seen) -> str:
    """After the kill, by the watchdog's own clock."""
    trip = next(event for event in trial.watchdog if event["event"] == "trip")
    assert trip["causes"]
    opened_ms = (trip["monotonic_ns"] - trial.more) / 1e6 - trial.late_ms
    assert 0 < opened_ms <= SOON_MS
    return f"{opened_ms:.0f} ms after that, of at most {SOON_MS} ms"


def the_watchdog_says_why(trial: Seen) -> str:
    trip = next(event for event in trial.watchdog if event["event"] == "trip")
    assert trip["causes"]
    return ", ".join(sorted(cause["rule"] for cause in trip["causes"]))


def no_command_leaves(trial: Seen) -> str:
    """But 0 V."""
    driven_ms = [(command.time_ns - trial.from_ns) / 1e6 for command in trial.commands if command.output_v]
    last_ms = max(driven_ms, default=0.0) - trial.late_ms
    assert last_ms <= SOON_MS
    last = f"the last {last_ms:.0f} ms after it" if last_ms >= 0.5 else "none at all"
    return f"{last}, of at most {SOON_MS} ms"


def comes_down_in_a_second(trial: Seen) -> str:
    """In 60 equal steps."""
    records = [tick.record for tick in trial.ticks]
    k = next(k for k, record in enumerate(records) if record.state is SystemState.RAMPDOWN)
    return f"from {ramps_down(records, k):.1f} MW"


def begins_unarmed(trial: Seen) -> None:
    begun = [tick for tick in trial.ticks if tick.record.mode == "open_loop"]
    assert begun and not any(tick.orders for tick in begun)
    assert {tick.record.state for tick in begun} <= {"INIT", "STANDBY", "FAULT"}
    assert not any(tick.record.output_v for tick in begun)
