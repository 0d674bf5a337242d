"""What happens to ``dcon run`` in its life, one thing after the other, and what becomes of each: judged from the logs.

One run bears it all: four sessions, since a controller whose helpers die begins again. What is seen goes into a table
of the documentation.
"""

from __future__ import annotations

import random
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from support import trial_facts as see
from support.outcomes import Fact, Outcome, complete, keep, relays_of
from support.running import Running, flood, frames_now
from support.swing import Streams

from dcon.cli import dcon
from dcon.link.orders import SignedOrder, sign
from dcon.server.client import Client
from dcon.session.reader import SessionReader
from pmutools.c37118.config import encode_config
from pmutools.cli.shell import run

pytestmark = [
    pytest.mark.alone,
    pytest.mark.slow,
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform != "linux", reason="dcon run is Linux's"),
]


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


def config_flood(site: Running) -> None:
    config = Streams(("N1",)).configs["N1"]
    (station,) = config.stations
    changing = [encode_config(replace(config, stations=(replace(station, cfgcnt=1000 + k),))) for k in range(100)]
    with flood(site.ports[0], changing, 1.5, source="127.0.0.2"):
        pass


def stranger_flood(site: Running) -> None:
    config = Streams(("N1",)).configs["N1"]
    ever_others = [encode_config(replace(config, idcode=1000 + k)) for k in range(15_000)]
    addresses = [f"127.1.{k // 250}.{1 + k % 250}" for k in range(800)]
    with flood(site.ports[0], ever_others, 1.5, source=addresses):
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


# --- the trials --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Trial:
    """What is done to a controller that is ACTIVE in closed loop, and what has to become of it."""

    what: str
    do: Callable[[Running], Any]
    """What it returns is called at the end of the trial, if it can be, and undoes it; else it is kept."""
    state: str
    relays: str
    facts: tuple[Fact, ...] = ()
    events: tuple[str, ...] = ()
    """That the session log must have; it may have more."""
    restarts: tuple[str, ...] = ()


EVERY_TICK = Fact("every tick is run and logged", see.every_tick_is_run)
OTHER_HEARD = Fact("no frame of the other PMU is lost", see.the_other_pmu_is_heard)
IN_TIME = Fact("the relays open in time", see.relays_open_in_time)
NOTHING_LEAVES = Fact("no command leaves any more", see.no_command_leaves)
UNARMED = Fact("a new session, in open loop, that nobody has armed", see.begins_unarmed)
COMES_DOWN = Fact("the command comes down to 0 in a second, without a step", see.comes_down_in_a_second)
SAYS_WHY = Fact("the watchdog says why", see.the_watchdog_says_why)
TRIALS = {
    "estop": Trial(
        "an operator's emergency stop",
        estop,
        "ESTOP",
        "tripped",
        (
            Fact("who and why are in both logs", see.who_and_why_are_logged),
            Fact("0 V from that tick on", see.nothing_is_driven_in_estop),
            NOTHING_LEAVES,
        ),
        ("estop",),
    ),
    "gps": Trial(
        "the clock loses its GPS lock for longer than the holdover",
        gps,
        "STANDBY",
        "open",
        (COMES_DOWN,),
        ("gps", "rampdown"),
    ),
    "line": Trial("the DC line is blocked", line, "STANDBY", "open", (COMES_DOWN,), ("line_out", "rampdown")),
    "flood": Trial(
        "10,000 frames/s of another IDCODE at the port of one PMU",
        foreign_flood,
        "ACTIVE",
        "closed",
        (EVERY_TICK, OTHER_HEARD),
    ),
    "malformed": Trial(
        "10,000 malformed datagrams/s at the port of one PMU",
        malformed_flood,
        "ACTIVE",
        "closed",
        (EVERY_TICK, OTHER_HEARD),
    ),
    "configurations": Trial(
        "10,000 configurations/s with a PMU's IDCODE, no two alike, from another address",
        config_flood,
        "ACTIVE",
        "closed",
        (EVERY_TICK, OTHER_HEARD),
    ),
    "strangers": Trial(
        "10,000 configurations/s of ever-changing IDCODEs from 800 other addresses",
        stranger_flood,
        "ACTIVE",
        "closed",
        (EVERY_TICK, OTHER_HEARD),
    ),
    "spoofed": Trial(
        "10,000 frames/s with a PMU's IDCODE from another address",
        spoof,
        "ACTIVE",
        "closed",
        (Fact("none of them reaches a tick", see.nothing_spoofed_reaches_a_tick), EVERY_TICK, OTHER_HEARD),
    ),
    "forged": Trial(
        "an order signed with a wrong key, and one that was heard before",
        forge,
        "ACTIVE",
        "closed",
        (Fact("both are refused, and in the log with the reason", see.forged_and_replayed_are_refused),),
        ("refused",),
    ),
    "server-stopped": Trial(
        "the server hangs for three seconds (SIGSTOP)",
        stop_server,
        "ACTIVE",
        "closed",
        (EVERY_TICK, OTHER_HEARD),
        ("server",),
    ),
    "server-killed": Trial(
        "the server is killed (SIGKILL)",
        kill("server"),
        "ACTIVE",
        "closed",
        (EVERY_TICK, OTHER_HEARD),
        restarts=("server",),
    ),
    "platform-stopped": Trial(
        "the control process hangs for half a second (SIGSTOP)",
        stop_platform,
        "FAULT",
        "tripped",
        (SAYS_WHY, NOTHING_LEAVES),
        ("watchdog", "fault"),
    ),
    "watchdog-killed": Trial(
        "the watchdog is killed",
        kill("watchdog"),
        "FAULT",
        "open",
        (NOTHING_LEAVES,),
        ("watchdog", "fault"),
        ("watchdog",),
    ),
    "front-killed": Trial(
        "the front is killed",
        kill("front"),
        "FAULT",
        "tripped",
        (IN_TIME, NOTHING_LEAVES, UNARMED),
        ("watchdog", "fault"),
        ("platform",),
    ),
    "aides-killed": Trial(
        "the aides are killed", kill("aides"), "STANDBY", "open", (COMES_DOWN, UNARMED), ("rampdown",), ("platform",)
    ),
    "platform-killed": Trial(
        "the control process is killed",
        kill("platform"),
        "FAULT",
        "tripped",
        (IN_TIME, NOTHING_LEAVES, UNARMED),
        restarts=("platform",),
    ),
}
"""In this order."""


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, see.Seen]]:
    folder = tmp_path_factory.mktemp("trials")
    site = Running(folder)
    found: dict[str, see.Seen] = {}
    try:
        site.start()
        for name, trial in TRIALS.items():
            found[name] = perform(site, name, trial)
        code = site.end()
        assert code == 130, site.said()
        read_logs(site, found)
        yield found
    finally:
        site.close()


def perform(site: Running, name: str, trial: Trial) -> see.Seen:
    site.activate()
    begun, restarts, sent = (
        len(site.watchdog_events()),
        site.said().count("started again in"),
        len(site.gateway.commands),
    )
    seen = see.Seen(time.time_ns())
    undo = trial.do(site)
    if trial.restarts:
        site.until(lambda _: site.restarts() > restarts, "started again")
    if "watchdog" in trial.restarts:
        site.until(
            lambda _: any(event["event"] == "start" for event in site.watchdog_events()[begun:]), "a new watchdog"
        )
    after = seen.from_ns
    site.until(lambda now: now["controller_connected"] and now["state"] == trial.state and now["tick_ns"] > after, name)
    time.sleep(0.4)  # long enough for a state that is on its way to something else
    seen.state = site.in_state(*STATES)["state"]
    seen.to_ns = time.time_ns()
    seen.watchdog = site.watchdog_events()[begun:]
    seen.commands = site.gateway.commands[sent:]
    seen.restarts = re.findall(r"the (\w+) process has ended, .*; started again in", site.said())[restarts:]
    if callable(undo):
        undo()
    else:
        seen.more = undo
    return seen


STATES = ("STANDBY", "ACTIVE", "FAULT", "ESTOP")


def read_logs(site: Running, found: dict[str, see.Seen]) -> None:
    for path in sorted(site.folder.glob("session*.mcap"), key=lambda path: path.stat().st_mtime):
        if ".part" in path.name:
            continue
        for tick in SessionReader(path).ticks():
            for trial in found.values():
                if trial.from_ns <= tick.record.tick_ns <= trial.to_ns:
                    trial.ticks.append(tick)
    found["replays"] = see.Seen(0, more={str(p): run(dcon(), ["replay", str(p), "--quiet"]) for p in logs(site)})


def logs(site: Running) -> list[Path]:
    return [path for path in site.folder.glob("session*.mcap") if ".part" not in path.name]


# --- what became of it -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TRIALS)
def test_what_becomes_of_it(name: str, seen: dict[str, see.Seen]) -> None:
    found, trial = seen[name], TRIALS[name]
    assert found.state == trial.state
    assert set(trial.events) <= {event.name for event in found.events}
    assert set(found.restarts) == set(trial.restarts)
    relays = relays_of(event["event"] for event in found.watchdog)
    assert relays == trial.relays
    facts = {fact.words: fact.holds(found) or "" for fact in trial.facts}
    keep("trials", name, Outcome(trial.what, found.state, relays, leading(found), tuple(found.restarts), facts))


SETTLED_NS = 200_000_000
"""What the watchdog has to say of it is heard sooner; a new session takes longer to begin."""


def leading(found: see.Seen) -> tuple[str, ...]:
    """Events of the system and of orders, each once, until the controller has settled where it ended."""
    ended = [tick.record.tick_ns for tick in found.ticks if tick.record.state == found.state]
    until_ns = found.to_ns if found.state == "ACTIVE" else ended[0] + SETTLED_NS
    events = (event for tick in found.ticks if tick.record.tick_ns < until_ns for event in tick.record.events)
    return tuple(dict.fromkeys(event.name for event in events if event.subject in ("system", "link")))


def test_the_table_has_every_trial() -> None:
    complete("trials", TRIALS)


def test_every_session_replays_bit_for_bit(seen: dict[str, see.Seen]) -> None:
    replays = seen["replays"].more
    assert len(replays) == 4
    assert set(replays.values()) == {0}, replays
