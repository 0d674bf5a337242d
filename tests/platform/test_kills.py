"""SIGKILL and SIGSTOP at random instants, over every process: the relays open in time, the log is whole, all returns.

``DCON_KILLS=50`` does it fifty times; ``make soak`` does.
"""

from __future__ import annotations

import os
import random
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from support.running import PROCESSES, Running

from dcon.link.command import CommandOut
from dcon.replay.replay import replay
from dcon.session.reader import SessionReader

pytestmark = [
    pytest.mark.alone,
    pytest.mark.slow,
    pytest.mark.realtime,
    pytest.mark.timeout(1800),
    pytest.mark.skipif(sys.platform != "linux", reason="dcon run is Linux's"),
]
KILLS = int(os.environ.get("DCON_KILLS", "3"))
SEED = int(os.environ.get("DCON_SEED", "1"))
MS = 1_000_000
OPENS_MS = {"platform": 120, "front": 120, "aides": 2020}
"""As the watchdog states it. The server opens nothing; of the watchdog itself see below."""
CLOSED = 2
HANG_S = 2.6
"""A process that stands still for so long is killed after it."""


@dataclass
class Kill:
    """One of them."""

    name: str
    number: signal.Signals
    at_ns: int
    """Monotonic."""
    utc_ns: int
    commands: list[CommandOut]
    """That left from then on."""
    watchdog: list[dict[str, Any]]
    """Events of its log from then on."""

    def __str__(self) -> str:
        return f"{self.number.name} of {self.name}"

    @property
    def _opening(self) -> dict[str, Any] | None:
        return next((event for event in self.watchdog if event["event"] in ("trip", "open")), None)

    @property
    def late_ms(self) -> float:
        """For how long the machine had kept the watchdog from running when it opened them."""
        return max(0.0, self._opening["late_ms"]) if self._opening else 0.0

    def opened_ms(self) -> float | None:
        """From the signal to open relays, by the watchdog's log, less that."""
        return (self._opening["monotonic_ns"] - self.at_ns) / MS - self.late_ms if self._opening else None

    def driven_ms(self) -> float:
        """From the signal to the tick of the last command that was not 0 V, less that."""
        last_ms = max(((c.time_ns - self.utc_ns) / MS for c in self.commands if c.output_v), default=0.0)
        return last_ms - self.late_ms


@dataclass
class Story:
    kills: list[Kill]
    folder: Path
    last_driven_ns: list[int]
    """Tick of the last command that passed before each death of the control process, POSIX UTC."""
    code: int = 0


@pytest.fixture(scope="module")
def story(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Story]:
    rng = random.Random(SEED)
    site = Running(tmp_path_factory.mktemp("kills"))
    told = Story([], site.folder, [])
    try:
        site.start()
        deck: list[tuple[str, signal.Signals]] = []
        for _ in range(KILLS):
            if not deck:
                deck = [(name, number) for name in PROCESSES for number in (signal.SIGKILL, signal.SIGSTOP)]
                rng.shuffle(deck)
            told.kills.append(strike(site, rng, *deck.pop(), told))
        site.activate()  # after the last, too
        told.code = site.end()
        yield told
    finally:
        site.close()


def strike(site: Running, rng: random.Random, name: str, number: signal.Signals, told: Story) -> Kill:
    site.activate()
    site.caught_up()
    time.sleep(rng.uniform(0.0, 0.3))
    events, sent, restarts = len(site.watchdog_events()), len(site.gateway.commands), site.restarts()
    utc_ns = time.time_ns()
    at_ns = site.kill(name, number)
    if number is signal.SIGSTOP:
        time.sleep(HANG_S)
        site.kill(name)
    site.until(lambda _: site.restarts() > restarts, f"{name} started again")
    time.sleep(2.3 if name == "aides" else 0.3)
    kill = Kill(name, number, at_ns, utc_ns, site.gateway.commands[sent:], site.watchdog_events()[events:])
    if name == "platform":
        passed = [command.time_ns for command in site.gateway.commands[: sent + 60] if command.flags & CLOSED]
        told.last_driven_ns.append(passed[-1])
    return kill


def test_each_came_back_and_the_end_is_as_any(story: Story) -> None:
    assert len(story.kills) == KILLS and story.code == 130


def test_the_relays_open_within_the_time_that_is_stated(story: Story) -> None:
    for kill in story.kills:
        opened_ms = kill.opened_ms()
        if kill.name in OPENS_MS:
            assert opened_ms is not None and opened_ms <= OPENS_MS[kill.name], (str(kill), opened_ms)
        elif kill.name == "server":
            assert opened_ms is None, (str(kill), kill.watchdog)


def test_no_command_leaves_later_than_that(story: Story) -> None:
    """Of a watchdog that dies none at all: nothing passes it any more."""
    for kill in story.kills:
        if kill.name != "server":
            assert kill.driven_ms() <= OPENS_MS.get(kill.name, 20), (str(kill), kill.driven_ms())


def test_the_log_has_all_but_the_last_tick_and_replays(story: Story) -> None:
    logs = [path for path in story.folder.glob("session*.mcap") if ".part" not in path.name]
    spans = []
    for path in logs:
        ticks = [tick.record.tick_ns for tick in SessionReader(path).ticks()]
        spans.append((ticks[0], ticks[-1]))
        result = replay(str(path))
        assert (result.different, result.stopped) == (0, ""), (path.name, result.first)
    for last_ns in story.last_driven_ns:
        before = max(end for begin, end in spans if begin <= last_ns)
        assert last_ns - before <= 17 * MS
