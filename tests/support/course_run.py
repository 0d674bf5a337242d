"""The paper's course over sockets: one player, two ``dcon run`` that get the very same packets, and their logs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow.parquet as pq
from support import paper_course as course
from support.feeding import player
from support.logged import NAMES, RATE, Logged
from support.running import Running
from support.swing import MS

from dcon.engine import Engine
from dcon.link.command import CommandOut
from dcon.settings import parse
from pmutools.c37118 import Frame, decode_config
from pmutools.flow import StampSource
from pmutools.timebase import parse_utc

AS_SET = "as-set"
"""Everything at its default, but for the gain."""
WITHOUT = "without"
"""Neither alignment nor, for one lost frame, disabling: that is bridged."""
SETTINGS: dict[str, dict[str, bool]] = {AS_SET: {}, WITHOUT: {"align": False, "interpolate_single_loss": True}}
GAIN, DEADBAND_MHZ = 10.0, 0.25
PATIENCE_S = course.END_S + 15
FRAME_LATE_MS, TICK_LATE_MS = 15.0, 50.0
"""A frame that is later misses its tick, a tick that is later is near the watchdog's limits: the machine paused."""
TOLD = 10


class Fault(NamedTuple):
    """A check of single streams that rose."""

    tick: int
    check: str
    name: str


class LiveSession(Logged):
    """One of the two sessions, the commands that its gateway got, and its watchdog's events."""

    def __init__(self, site: Running, start_ns: int) -> None:
        super().__init__(site.log, start_ns)
        self.logs = [path.name for path in site.folder.glob("*.mcap")]
        self.commands: list[CommandOut] = list(site.gateway.commands)
        self.watchdog: list[tuple[float, dict[str, Any]]] = [
            (self.seconds(parse_utc(event["utc"])), event) for event in site.watchdog_events()
        ]
        settings = parse(self.reader.ini_text, "log")
        self.params = settings.params

    @cached_property
    def frequencies(self) -> dict[str, dict[int, float]]:
        """f (Hz, deviation) of every PMU by slot, as the controller had it."""
        return self.per_stamp()

    def taken(self, name: str) -> Iterator[tuple[int, int, int]]:
        """(tick, slot, arrival in ns) of a PMU's frames, in the order in which a tick uses them."""
        for k, tick in enumerate(self.ticks):
            for frame in sorted((f for f in tick.frames if f.name == name), key=lambda f: f.time_ns):
                yield k, self.slot(frame.time_ns), frame.arrival_ns or 0

    @cached_property
    def newest(self) -> dict[str, list[int]]:
        """The newest slot of each PMU that has come by each tick; -1 before the first."""
        return {name: self._newest(name) for name in NAMES}

    def _newest(self, name: str) -> list[int]:
        slots, found, newest = dict[int, int](), list[int](), -1
        for k, slot, _ in self.taken(name):
            slots[k] = slot
        for k in range(len(self.ticks)):
            newest = max(newest, slots.get(k, -1))
            found.append(newest)
        return found

    def due(self) -> list[Fault]:
        """Every fault of a single stream that has to be seen, by what arrived when: the paper's rules, and no more.

        A frame that is not the one after the last is a lost one; nothing for more than 50 ms is silence. After either
        the next frame begins anew. One lost frame may be bridged.
        """
        return sorted(fault for name in NAMES for fault in self._due(name))

    def _due(self, name: str) -> Iterator[Fault]:
        frames: dict[int, list[tuple[int, int]]] = {}
        for k, slot, arrival_ns in self.taken(name):
            frames.setdefault(k, []).append((slot, arrival_ns))
        last: int | None = None
        arrived_ns: int | None = None
        silent = False
        for k, record in enumerate(self.records):
            for slot, at_ns in frames.get(k, ()):
                if last is not None and slot != last + 1:
                    bridged = self.params.interpolate_single_loss and slot == last + 2
                    yield Fault(k, "interpolated" if bridged else "stamp_step", name)
                last, arrived_ns = slot, at_ns
            was, silent = silent, arrived_ns is not None and record.tick_ns - arrived_ns > 50 * MS
            if silent:
                last = None
                if not was:
                    yield Fault(k, "arrival_gap", name)

    def seen(self) -> list[Fault]:
        """Those that the controller saw."""
        checks = ("stamp_step", "arrival_gap", "interpolated")
        return sorted(
            Fault(k, event.name, event.subject)
            for k, record in enumerate(self.records)
            for event in record.events
            if event.name in checks
        )

    def fault(self, check: str, name: str) -> int:
        """The tick of the one fault of that kind before the end."""
        (found,) = [
            one.tick
            for one in self.seen()
            if one[1:] == (check, name) and self.seconds(self.records[one.tick].tick_ns) < course.ALL_STOP_S
        ]
        return found

    def states(self, instance: int, ticks: range) -> list[str]:
        return [str(self.records[k].instances[instance].state) for k in ticks]

    def of(self, name: str) -> list[int]:
        """Indices of the instances that use a PMU."""
        return [k for k, pair in enumerate(self.reader.instances) if name in pair.split("-")]


class CourseRun:
    """The course as it was: both sessions, and what the player says it sent when."""

    def __init__(self, sites: dict[str, Running], sent: dict[str, list[bytes]], ledger: Path) -> None:
        rows = pq.read_table(ledger).to_pylist()
        self.start_ns = course.START_NS + rows[0]["time_ns"] - rows[0]["source_time_ns"]
        self.scheduled_ns = {
            (row["stream"], row["time_ns"]): row["scheduled_ns"] for row in rows if row["fate"] == "sent"
        }
        self.sent = sent
        self.sessions = {name: LiveSession(site, self.start_ns) for name, site in sites.items()}

    @cached_property
    def perfect(self) -> dict[str, list[float]]:
        """f (Hz, deviation) by slot of every PMU, of the recording in virtual time: every frame comes, and evenly."""
        session = self.sessions[AS_SET]
        settings = parse(session.reader.ini_text, "log")
        engine = Engine(settings.params, settings.sites)
        for name, frame in course.configs().items():
            engine.configure(name, decode_config(frame)[1])
        found: dict[str, list[float]] = {name: [] for name in NAMES}
        for slot in range(round(course.END_S * RATE)):
            stamp_ns = course.stamp_ns(slot)
            arrival_ns = stamp_ns + round(course.DELAY_MS * MS)
            frames = {name: [Frame(self.sent[name][slot], arrival_ns, StampSource.CAPTURE, 0)] for name in NAMES}
            engine.tick(frames, (), arrival_ns + 4 * MS)
            for name, pmu in zip(NAMES, engine.state.pmus, strict=True):
                found[name].append(pmu.ring[0] if pmu.ring else float("nan"))
        return found

    @property
    def is_sound(self) -> bool:
        return not any(self.held_up(course.END_S))

    def held_up(self, until_s: float) -> Iterator[str]:
        """What the machine held up before a time: frames against the player's schedule, ticks against UTC."""
        for name, session in self.sessions.items():
            for tick in session.ticks:
                at_s = session.seconds(tick.record.tick_ns)
                if at_s > until_s:
                    break
                due_ns = [self.scheduled_ns.get((frame.name, frame.time_ns)) for frame in tick.frames]
                late_ms = [
                    ((frame.arrival_ns or 0) - due) / MS
                    for frame, due in zip(tick.frames, due_ns, strict=True)
                    if due is not None
                ]
                if late := [one for one in late_ms if one > FRAME_LATE_MS]:
                    yield f"at {at_s:.3f} s {len(late)} frames came up to {max(late):.0f} ms late ({name})"
                if tick.timing is not None and tick.timing.late_us > TICK_LATE_MS * 1e3:
                    yield f"at {at_s:.3f} s a tick was {tick.timing.late_us / 1e3:.0f} ms late ({name})"

    @contextmanager
    def blaming(self, until_s: float) -> Iterator[None]:
        """What fails within says whether the machine stood still before."""
        try:
            yield
        except Exception as error:
            if held_up := [*islice(self.held_up(until_s), TOLD)]:
                error.add_note("\n  ".join(("the machine stood still, which spoils this:", *held_up)))
            raise


def run(folder: Path) -> CourseRun:
    """Both controllers through the whole course: 60 s. Where the machine stood still meanwhile, once again."""
    first = _run(folder / "first")
    return first if first.is_sound else _run(folder / "second")


def _run(folder: Path) -> CourseRun:
    folder.mkdir()
    sites: dict[str, Running] = {}
    law = {"gain_mw_per_mhz": GAIN, "deadband_mhz": DEADBAND_MHZ, "init_s": 20.0}
    sent = course.frames()
    recording, profile = course.write(folder, sent)
    ledger = folder / "ledger.parquet"
    with ExitStack() as stack:
        for name, settings in SETTINGS.items():
            (folder / name).mkdir()
            sites[name] = Running(folder / name, names=NAMES, supervisor="", **law, **settings)
            stack.callback(sites[name].close)
            sites[name].begin()
        for site in sites.values():
            site.until(lambda now: now["controller_connected"], "connected")
        to = [url for site in sites.values() for url in site.to]
        playing = player(folder, recording, to, "--impair", str(profile), "--ledger", str(ledger))
        stack.callback(playing.kill)
        for site in sites.values():
            site.until(lambda now: any(one["state"] == "INITIALISING" for one in now["instances"]), "frames")
        for site in sites.values():
            with suppress(AssertionError):  # where the machine stood still: the log has it, and the tests say so
                site.activate(least_v=0.0)
        assert playing.wait(PATIENCE_S) == 0, (folder / "stderr").read_text()
        for site in sites.values():
            site.in_state("STANDBY", "INIT", "FAULT")  # the last two where the machine stood still
        for site in sites.values():
            assert site.end() == 130, site.said()
    return CourseRun(sites, sent, ledger)
