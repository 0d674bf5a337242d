"""A whole ``dcon run`` for as long as is wished: is its memory flat, is every tick accounted for, does its log replay?

``PYTHONPATH=tests python -m bench.running 1800``. Beside it, one after the other: a flood of 10,000 packets/s, a server
that is stopped, and in the first half one that is killed, so that each process of the second half lives through it.
"""

from __future__ import annotations

import signal
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import cycle, pairwise
from pathlib import Path
from typing import NamedTuple

from bench.host import Look, growth_mib, rss_kib, steal_s
from bench.waking import FLEET, stranger
from support.running import PROCESSES, Running, flood

from dcon.replay.replay import replay
from dcon.session.reader import SessionReader
from pmutools.timebase import NS

GROWTH_MIB = 4.0
"""A process may grow by no more in the second half."""
RATE_HZ = 60
ASKED = 130
"""Exit code of ``dcon run`` where it was asked to end."""
LONGEST_S = 60.0
"""Between two disturbances."""


class Account(NamedTuple):
    """The ticks of a session: each that was due was logged, or is said to be missing."""

    due: int
    """From the first to the last, on their grid."""
    logged: int
    missing: int
    """That the log itself says are missing."""
    skipped: int
    """That the controller says it left out."""

    @property
    def unexplained(self) -> int:
        return self.due - self.logged - self.missing - self.skipped


def account(ticks_ns: Sequence[int], missing: int, skipped: int) -> Account:
    """Raises ValueError for ticks that are not in order, or one that is there twice."""
    if any(later <= earlier for earlier, later in pairwise(ticks_ns)):
        raise ValueError("ticks are not in order")
    due = round((ticks_ns[-1] - ticks_ns[0]) * RATE_HZ / NS) + 1 if ticks_ns else 0
    return Account(due, len(ticks_ns), missing, skipped)


def soak(seconds: float) -> int:
    """Run, print memory as it goes and the account at the end; 1 where something is not as it should be."""
    period_s = min(LONGEST_S, seconds / 8)
    before_s = steal_s()
    with tempfile.TemporaryDirectory(prefix="soak-") as folder:
        site = Running(Path(folder), names=FLEET)
        try:
            site.start("--json")
            site.activate()
            looks, killed = _disturbed(site, seconds, period_s)
            site.caught_up()
            code = site.end()
        finally:
            site.close()
        done = _account(site)
        restarts = site.summary()["restarts"]
        again = replay(str(site.log))
        logs = sorted(path.name for path in site.folder.glob("session*.mcap"))
    grown = {name: growth_mib(each) for name, each in looks.items()}
    print(f"{done.due} ticks: {done.logged} logged, {done.missing} missing by the log, {done.skipped} left out; "
          f"{done.unexplained} unexplained; in {', '.join(logs)}")  # fmt: skip
    print("memory of the second half: " + ", ".join(f"{name} {mib:+.1f} MiB" for name, mib in grown.items()))
    print(f"replay: {again.ticks} ticks, {again.different} different {again.stopped}".rstrip())
    print(f"exit code {code}; started again: {restarts}; the host took {steal_s() - before_s:.2f} s of processor time")
    flat = all(mib < GROWTH_MIB for mib in grown.values())  # not a number is not flat
    replays = again.different == 0 and not again.stopped and again.ticks > 0
    whole = done.unexplained == 0 and done.due >= (seconds - 1) * RATE_HZ
    return int(not (flat and replays and whole and ended_well(code, restarts, killed)))


def ended_well(code: int, restarts: Mapping[str, int], killed: int) -> bool:
    """It was asked to end, and does say so; nothing died or hung but the server, as often as it was killed."""
    return code == ASKED and restarts == ({"server": killed} if killed else {})


def _disturbed(site: Running, seconds: float, period_s: float) -> tuple[dict[str, list[Look]], int]:
    """Disturb it every ``period_s`` s; what each process had of memory, some forty times, and how often one was
    killed."""
    begun_s, kinds = time.monotonic(), cycle((_flooded, _stopped, _killed))
    looks: dict[str, list[Look]] = {name: [] for name in (*PROCESSES, "run")}
    look_s = disturb_s = 0.0
    killed = 0
    while (passed_s := time.monotonic() - begun_s) < seconds:
        if passed_s >= disturb_s + period_s:
            disturb_s += period_s
            kind: Callable[[Running, float], None] = next(kinds)
            if kind is _killed and passed_s > 0.45 * seconds:
                kind = _flooded
            kind(site, period_s)
            killed += kind is _killed
            state = site.status()["state"]
            site.activate()
            print(f"{passed_s:6.0f} s  {kind.__name__.strip('_')}: then {state}", flush=True)
        if passed_s >= look_s:
            look_s += max(seconds / 40, 0.25)
            _look(site, looks)
            if len(looks["run"]) % 4 == 1:
                print(f"{passed_s:6.0f} s  {_told(looks)}", flush=True)
        time.sleep(0.05)
    return looks, killed


def _look(site: Running, looks: Mapping[str, list[Look]]) -> None:
    assert site.run is not None
    for name, found in looks.items():
        pid = site.run.pid if name == "run" else site.pid(name)
        found.append((pid, rss_kib(pid)))


def _told(looks: Mapping[str, list[Look]]) -> str:
    return ", ".join(f"{name} {found[-1][1] / 1024:.1f}" for name, found in looks.items()) + " MiB"


def _flooded(site: Running, period_s: float) -> None:
    with flood(site.ports[0], stranger(), min(10.0, period_s / 2)):
        pass


def _stopped(site: Running, period_s: float) -> None:
    site.kill("server", signal.SIGSTOP)
    time.sleep(min(3.0, period_s / 2))
    site.kill("server", signal.SIGCONT)


def _killed(site: Running, period_s: float) -> None:
    restarts = site.restarts()
    site.kill("server")
    site.until(lambda _: site.restarts() > restarts, "server started again")


def _account(site: Running) -> Account:
    ticks_ns, missing = list[int](), 0
    for tick in SessionReader(site.log).ticks():
        ticks_ns.append(tick.record.tick_ns)
    for event in SessionReader(site.log).groups(("Event",)):
        missing += sum(int(each.detail.split()[0]) for each in event.messages["Event"] if each.name == "log_gap")
    return account(ticks_ns, missing, int(site.summary()["skipped_ticks"]))


if __name__ == "__main__":
    sys.exit(soak(float(sys.argv[1]) if len(sys.argv) > 1 else 1800.0))
