"""What happens to ``dcon run`` in its life, one thing after the other, and what becomes of each: judged from the logs.

One run bears it all: three sessions, since a controller whose helpers die begins again.
"""

from __future__ import annotations

import json
import random
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from support.running import Running, flood, frames_now
from support.swing import Streams

from dcon.cli import dcon
from dcon.core.values import Event, Order
from dcon.link.command import CommandOut
from dcon.link.orders import SignedOrder, sign
from dcon.server.client import Client
from dcon.session.reader import LoggedTick, SessionReader
from pmutools.cli.shell import run
from pmutools.timebase import NS

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))
from generate.trials import TRIALS

pytestmark = [
    pytest.mark.alone,
    pytest.mark.slow,
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform != "linux", reason="dcon run is Linux's"),
]


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
    def events(self) -> list[Event]:
        return [event for tick in self.ticks for event in tick.record.events]

    @property
    def orders(self) -> list[Order]:
        return [order for tick in self.ticks for order in tick.orders]


# --- what is done ------------------------------------------------------------------------------------------------


def estop(site: Running) -> None:
    site.obeyed("estop", why="a trial")


def gps(site: Running) -> Callable[[], None]:
    site.around.gps_age_s = 1.0
    return lambda: setattr(site.around, "gps_age_s", 0.0)


def line(site: Running) -> Callable[[], None]:
    site.around.in_service = False
    return lambda: setattr(site.around, "in_service", True)


def foreign_flood(site: Running) -> None:
    with flood(site.ports[0], [Streams(("N2",)).data("N2", time.time_ns())], 1.5):
        pass


def malformed_flood(site: Running) -> None:
    rng = random.Random(1)
    (frame,) = frames_now("N1", 1)
    bent = [frame[:k] + bytes([frame[k] ^ 1]) + frame[k + 1 :] for k in rng.sample(range(len(frame)), 20)]
    with flood(site.ports[0], [*bent, frame[:9], b"", rng.randbytes(1000)], 1.5):
        pass


def spoof(site: Running) -> None:
    with flood(site.ports[0], frames_now("N1"), 1.0, source="127.0.0.2"):
        pass


def forge(site: Running) -> list[dict[str, Any]]:
    now_ns = time.time_ns()
    forged = sign(SignedOrder("ann", now_ns, now_ns, "disarm"), bytes(32))
    good = sign(SignedOrder("ann", now_ns + 1, now_ns + 1, "gain", 10.0), site.operator.key)
    answers = []
    for signed in (forged, good, good):
        with Client(site.server) as client:
            answers.append(client.ask({"signed": signed.decode()}))
    return answers


def stop_server(site: Running) -> None:
    site.kill("server", signal.SIGSTOP)
    time.sleep(3.0)
    site.kill("server", signal.SIGCONT)


def kill(name: str) -> Callable[[Running], int]:
    return lambda site: site.kill(name)


def stop_platform(site: Running) -> None:
    site.kill("platform", signal.SIGSTOP)
    time.sleep(0.5)
    site.kill("platform", signal.SIGCONT)


DONE: dict[str, Callable[[Running], Any]] = {
    "estop": estop,
    "gps": gps,
    "line": line,
    "flood": foreign_flood,
    "malformed": malformed_flood,
    "spoofed": spoof,
    "forged": forge,
    "server-stopped": stop_server,
    "server-killed": kill("server"),
    "platform-stopped": stop_platform,
    "watchdog-killed": kill("watchdog"),
    "front-killed": kill("front"),
    "aides-killed": kill("aides"),
    "platform-killed": kill("platform"),
}
"""In this order. What is called at the end of a trial, if anything, undoes it."""


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Seen]]:
    folder = tmp_path_factory.mktemp("trials")
    site = Running(folder)
    found: dict[str, Seen] = {}
    try:
        site.start()
        for name, do in DONE.items():
            found[name] = perform(site, name, do)
        code = site.end()
        assert code == 130, site.said()
        read_logs(site, found)
        yield found
    finally:
        site.close()


def perform(site: Running, name: str, do: Callable[[Running], Any]) -> Seen:
    site.activate()
    begun, restarts, sent = (
        len(site.watchdog_events()),
        site.said().count("started again in"),
        len(site.gateway.commands),
    )
    trial = Seen(time.time_ns())
    undo = do(site)
    if TRIALS[name].restarts:
        site.until(lambda _: site.restarts() > restarts, "started again")
    if "watchdog" in TRIALS[name].restarts:
        site.until(
            lambda _: any(event["event"] == "start" for event in site.watchdog_events()[begun:]), "a new watchdog"
        )
    after = trial.from_ns
    site.until(
        lambda now: now["controller_connected"] and now["state"] == TRIALS[name].state and now["tick_ns"] > after, name
    )
    time.sleep(0.4)  # long enough for a state that is on its way to something else
    trial.state = site.in_state(*STATES)["state"]
    trial.to_ns = time.time_ns()
    trial.watchdog = site.watchdog_events()[begun:]
    trial.commands = site.gateway.commands[sent:]
    trial.restarts = re.findall(r"the (\w+) process has ended, .*; started again in", site.said())[restarts:]
    if callable(undo):
        undo()
    else:
        trial.more = undo
    return trial


STATES = ("STANDBY", "ACTIVE", "FAULT", "ESTOP")


def read_logs(site: Running, found: dict[str, Seen]) -> None:
    for path in sorted(site.folder.glob("session*.mcap"), key=lambda path: path.stat().st_mtime):
        if ".part" in path.name:
            continue
        for tick in SessionReader(path).ticks():
            for trial in found.values():
                if trial.from_ns <= tick.record.tick_ns <= trial.to_ns:
                    trial.ticks.append(tick)
    found["replays"] = Seen(0, more={str(p): run(dcon(), ["replay", str(p), "--quiet"]) for p in logs(site)})


def logs(site: Running) -> list[Path]:
    return [path for path in site.folder.glob("session*.mcap") if ".part" not in path.name]


# --- what became of it -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TRIALS)
def test_what_becomes_of_it(name: str, seen: dict[str, Seen]) -> None:
    trial, expected = seen[name], TRIALS[name]
    assert trial.state == expected.state
    assert set(expected.events) <= {event.name for event in trial.events}
    assert set(trial.restarts) == set(expected.restarts)
    happened = {event["event"] for event in trial.watchdog}
    assert ("trip" in happened) == (expected.relays == "tripped")
    assert bool(happened & {"open", "trip", "start"}) == (expected.relays != "closed")


def test_every_session_replays_bit_for_bit(seen: dict[str, Seen]) -> None:
    replays = seen["replays"].more
    assert len(replays) == 4
    assert set(replays.values()) == {0}, replays


@pytest.mark.parametrize("name", ["flood", "malformed", "spoofed", "server-stopped", "server-killed"])
def test_every_tick_is_run_and_logged_and_the_other_pmu_is_heard(name: str, seen: dict[str, Seen]) -> None:
    ticks = seen[name].ticks
    steps = {round((b.record.tick_ns - a.record.tick_ns) * 60 / NS) for a, b in pairwise(ticks)}
    assert steps == {1}
    heard = [frame for tick in ticks for frame in tick.frames if frame.name == "S1"]
    assert len({frame.time_ns for frame in heard}) >= len(ticks) - 3


def test_nothing_that_was_spoofed_reaches_a_tick(seen: dict[str, Seen]) -> None:
    ticks = seen["spoofed"].ticks
    assert sum(frame.name == "N1" for tick in ticks for frame in tick.frames) <= len(ticks) + 3


def test_forged_and_replayed_orders_are_refused_and_in_the_log(seen: dict[str, Seen]) -> None:
    trial = seen["forged"]
    forged, good, replayed = trial.more
    assert "signature" in forged["refused"] and "replayed" in replayed["refused"] and good["accepted"]
    assert [(order.name, order.value) for order in trial.orders if order.name == "gain"] == [("gain", 10.0)]
    refused = [event for event in trial.events if event.name == "refused"]
    assert {event.subject for event in refused} == {"link"} and len(refused) == 2


def test_an_emergency_stop_is_in_the_log_with_who_and_why(seen: dict[str, Seen]) -> None:
    (stop,) = [order for order in seen["estop"].orders if order.name == "estop"]
    assert (stop.who, stop.why) == ("ann", "a trial")
    assert seen["estop"].watchdog[0]["who"] == "ann"
    after = [tick.record for tick in seen["estop"].ticks if tick.record.state == "ESTOP"]
    assert {record.output_v for record in after} == {0.0}


@pytest.mark.parametrize("name", ["front-killed", "platform-killed", "platform-stopped"])
def test_the_relays_open_within_the_time_that_is_stated(name: str, seen: dict[str, Seen]) -> None:
    trial = seen[name]
    killed_ns = trial.more if isinstance(trial.more, int) else None
    trip = next(event for event in trial.watchdog if event["event"] == "trip")
    assert trip["causes"]
    if killed_ns is not None:
        assert 0 < trip["monotonic_ns"] - killed_ns < 150_000_000


@pytest.mark.parametrize("name", ["estop", "watchdog-killed", "front-killed", "platform-killed", "platform-stopped"])
def test_no_command_leaves_after_that(name: str, seen: dict[str, Seen]) -> None:
    trial = seen[name]
    driven = [c.time_ns - trial.from_ns for c in trial.commands if c.output_v]
    assert max(driven, default=0) < 150_000_000


def test_nothing_is_armed_again_by_itself(seen: dict[str, Seen]) -> None:
    for name in ("front-killed", "aides-killed", "platform-killed"):
        begun = [tick for tick in seen[name].ticks if tick.record.mode == "open_loop"]
        assert begun and not any(tick.orders for tick in begun)
        assert {tick.record.state for tick in begun} <= {"INIT", "STANDBY", "FAULT"}
        assert not any(tick.record.output_v for tick in begun)


def test_the_table_has_every_trial() -> None:
    assert set(TRIALS) == set(DONE)
    json.dumps({name: trial.what for name, trial in TRIALS.items()})
