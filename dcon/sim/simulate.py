"""``dcon simulate``: grid, PMUs, wire, faults and controller in one process and in virtual time.

Every frame exists as bytes: encoded, sent through the fault pipeline, and decoded by the controller's front end.
Only clocks and sockets are missing. A run is a function of its plan.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from heapq import heappop, heappush
from typing import Any

from dcon.core.rows import CORE
from dcon.core.values import Event, Mode, Pdci, Record
from dcon.engine import Engine
from dcon.limiter import MW_PER_V
from dcon.session import checkpoint
from dcon.session.encode import tick_entries
from dcon.session.head import Head
from dcon.session.writer import SessionWriter
from dcon.settings import Settings, parse
from dcon.sim.delays import Delays, split
from dcon.sim.judging import Estimate, is_closed, judge, why_unjudged
from dcon.sim.operator import EagerOperator
from dcon.sim.plan import NOMINAL_HZ, START_NS, Plan, ini_of
from dcon.sim.wire import Wire
from pmutools import timebase
from pmutools.c37118 import Frame
from pmutools.errors import SettingsError
from pmutools.flow import StampSource
from pmutools.grid.emulate import EmulatedStream
from pmutools.grid.grid import Grid
from pmutools.grid.plant import build
from pmutools.grid.pmu_model import PmuModel, fleet, measure
from pmutools.grid.scenarios import Scenario
from pmutools.grid.signals import Bus
from pmutools.impair.outgoing import Fate
from pmutools.impair.pipeline import Pipeline
from pmutools.impair.profile import Profile, parse_profile


@dataclass
class Outcome:
    """What a run gave. Columns have one entry a reporting instant (``swing_mhz``) or a tick (the others)."""

    plan: Plan
    swing_mhz: list[float] = field(default_factory=list)
    """f_north - f_south of the grid itself, at 60/s or the plan's rate."""
    tick_s: list[float] = field(default_factory=list)
    delta_f_mhz: list[float] = field(default_factory=list)
    command_mw: list[float] = field(default_factory=list)
    events: list[tuple[float, Event]] = field(default_factory=list)
    final_state: str = ""
    peak_command_mw: float = 0.0
    closed: list[bool] = field(default_factory=list)
    """Whether the feedback drove the line."""
    mode: Estimate | None = None
    """Of the closed loop."""
    mode_reason: str = ""
    """Why there is none: above all, that the loop was not closed for as long as it is judged."""
    open_loop: Estimate | None = None

    def summary(self) -> Outcome:
        """The same without its columns."""
        return replace(self, swing_mhz=[], tick_s=[], delta_f_mhz=[], command_mw=[], closed=[])

    def to_json(self) -> dict[str, Any]:
        plan = self.plan
        return {
            "scenario": plan.scenario,
            "plant": plan.plant,
            "gain_mw_per_mhz": plan.gain_mw_per_mhz,
            "delay_ms": plan.delay_ms,
            "rate_hz": plan.rate_hz,
            "seed": plan.seed,
            "duration_s": plan.length_s,
            "mode": None if self.mode is None else self.mode._asdict(),
            "mode_reason": self.mode_reason or None,
            "open_loop": None if self.open_loop is None else self.open_loop._asdict(),
            "peak_command_mw": self.peak_command_mw,
            "final_state": self.final_state,
            "events": [
                {"time_s": round(time_s, 6), "name": event.name, "subject": event.subject, "detail": event.detail}
                for time_s, event in self.events
            ],
        }


class _Sender:
    """One emulated PMU: its frames into the fault pipeline, what comes out onto the heap of arrivals."""

    def __init__(self, pmu: PmuModel, plan: Plan, profile: Profile) -> None:
        self.pmu = pmu
        self.stream = EmulatedStream([pmu], plan.rate_hz, nominal_hz=NOMINAL_HZ)
        self.wire = Wire(pmu.name, self.stream.config)
        names = (str(pmu.idcode), pmu.bus)
        self.pipeline = Pipeline(profile, pmu.name, plan.seed, config=self.stream.config, aliases=names)


def settings_of(plan: Plan, pmus: Sequence[PmuModel]) -> Settings:
    """The controller's settings for a plan, by way of the text that is logged."""
    text = ini_of(
        pmus,
        gain_mw_per_mhz=plan.gain_mw_per_mhz,
        deadband_mhz=plan.deadband_mhz,
        rate_hz=plan.rate_hz,
        align=plan.align,
        interpolate_single_loss=plan.interpolate_single_loss,
        extra="\n" + plan.split.section,
    )
    return parse(text, f"simulation of {plan.scenario}")


Tell = Callable[[float], None]
Arrival = tuple[int, int, Wire, bytes]
"""When a datagram arrives, its number, where, and what it holds."""
_SENT, _CAPTURE = Fate.SENT, StampSource.CAPTURE  # looking a member up takes longer than comparing it
_new = tuple.__new__  # what calling a NamedTuple comes to, for half the time
TOLD_TICKS = 600
SCHEDULE_MW = 2000.0
"""Of the DC line, north to south; assumed, and without effect on the plants that there are."""


def simulate(plan: Plan, log_path: str | None = None, tell: Tell | None = None) -> Outcome:
    """Run a plan, with its session logged if ``log_path`` is given, and judge its ringdown.

    ``tell`` is given the simulated seconds now and then. Raises SettingsError for what the plan names and there is not,
    SourceError where the log cannot be written.
    """
    pmus = fleet(noise_rad=plan.noise_rad, seed=plan.seed)
    if unmatched := plan.profile.unmatched((pmu.name, str(pmu.idcode), pmu.bus) for pmu in pmus):
        there = ", ".join(pmu.name for pmu in pmus)
        raise SettingsError(f"--impair: no PMU is called {unmatched[0]}; there are {there}, north and south")
    settings = settings_of(plan, pmus)
    delays = split(plan.delay_ms)
    base = parse_profile(f"[stream *]\ndelay = constant({delays.arrival_ns / 1e6!r})\n", "delay")
    senders = [_Sender(pmu, plan, base.then(plan.impairment)) for pmu in pmus]
    engine = Engine(settings.params, settings.sites, verified=True)
    configs = {}
    for sender in senders:
        engine.configure(sender.pmu.name, sender.stream.config)
        configs[sender.pmu.name] = sender.stream.config_frame(START_NS)
    outcome = Outcome(plan)
    if log_path is None:
        _run(plan, delays, senders, engine, outcome, None, tell)
    else:
        metadata = {
            "scenario": plan.scenario,
            "plant": plan.plant,
            "seed": str(plan.seed),
            "delay_ms": repr(plan.delay_ms),
            "verified": "true",
        }
        names = tuple(pmu.name for pmu in pmus)
        head = Head(settings.text, names, settings.params.instance_names, CORE.names, metadata)
        with SessionWriter(log_path, head, configs) as log:
            _run(plan, delays, senders, engine, outcome, log, tell)
    outcome.peak_command_mw = max(map(abs, outcome.command_mw), default=0.0)
    outcome.mode_reason = why_unjudged(plan, outcome.tick_s, outcome.closed, outcome.events)
    if not outcome.mode_reason and (mode := judge(outcome.swing_mhz, plan)) is not None:
        outcome.mode = mode
    elif not outcome.mode_reason:
        outcome.mode_reason = "no inter-area mode is to be seen in the ringdown"
    if plan.course.ringdown_s is not None:
        outcome.open_loop = judge(_uncontrolled(plan), plan)
    return outcome


def _run(
    plan: Plan,
    delays: Delays,
    senders: Sequence[_Sender],
    engine: Engine,
    outcome: Outcome,
    log: SessionWriter | None,
    tell: Tell | None,
) -> None:
    grid = _grid(plan, plan.split.plant, delays.command_ns)
    split = plan.split
    probe_s = split.start_s if split.section else None
    operator = EagerOperator(Mode.CLOSED_LOOP if plan.control else Mode.OPEN_LOOP, probe_s)
    operated = plan.control or probe_s is not None
    names = engine.params.instance_names
    arrivals: list[Arrival] = []
    order = 0
    end_ns = START_NS + round(plan.length_s * timebase.NS)
    stamps = _stamps(plan)
    next_stamp, slot = next(stamps), 0
    period = timebase.NS / engine.params.tick_hz
    for number in range(round(plan.length_s * engine.params.tick_hz)):
        tick_ns = START_NS + delays.phase_ns + round(number * period)
        while next_stamp <= tick_ns and next_stamp < end_ns:
            order = _measure(grid, senders, next_stamp, slot, outcome, arrivals, order)
            next_stamp, slot = next(stamps), slot + 1
        frames = _arrived(arrivals, tick_ns, engine, log)
        orders = operator.orders(engine.state.system, (tick_ns - START_NS) / timebase.NS) if operated else ()
        tick = engine.tick(frames, orders, tick_ns)
        grid.command(tick.record.output_v * MW_PER_V, tick_ns)
        _note(outcome, tick.record)
        if tell is not None and number % TOLD_TICKS == 0:
            tell(outcome.tick_s[-1])
        if log is not None:
            line, around = _line(grid, tick_ns), tick.surroundings
            memory = tick.memory if checkpoint.is_due(number, engine.params.tick_hz) else None
            given = (names, tick.record, tick.readings, orders)
            log.write(tick_entries(*given, pdci=line, surroundings=around, memory=memory), tick_ns)


def _arrived(
    arrivals: list[Arrival], tick_ns: int, engine: Engine, log: SessionWriter | None
) -> dict[str, list[Frame]]:
    """Data frames that have come by a tick, by PMU; a configuration among them is in force for those after it."""
    frames: dict[str, list[Frame]] = {}
    while arrivals and arrivals[0][0] <= tick_ns:
        arrival_ns, _, wire, data = heappop(arrivals)
        if wire.is_plain(data):
            frames.setdefault(wire.name, []).append(_new(Frame, (data, arrival_ns, _CAPTURE, 0)))
            continue
        for frame, config in wire.frames(data, arrival_ns):
            if config is None:
                frames.setdefault(wire.name, []).append(frame)
            elif engine.configs.get(wire.name) != config:
                engine.reconfigure(wire.name, config)
                if log is not None:
                    log.config(wire.name, frame.data, arrival_ns)
    return frames


def _line(grid: Grid, tick_ns: int) -> Pdci:
    """The DC line as it is at a tick: at most 1/60 s after the grid was last looked at."""
    return Pdci(tick_ns, SCHEDULE_MW + grid.drive.modulation_mw)


def _grid(plan: Plan, course: Scenario, command_ns: int) -> Grid:
    plant = build(plan.plant, course.condition)
    return Grid(plant, course, start_ns=START_NS, command_delay_ns=command_ns, seed=plan.seed)


def _stamps(plan: Plan) -> Iterator[int]:
    slot = 0
    while True:
        yield START_NS + (slot * timebase.NS + plan.rate_hz // 2) // plan.rate_hz
        slot += 1


def _measure(
    grid: Grid,
    senders: Sequence[_Sender],
    stamp_ns: int,
    slot: int,
    outcome: Outcome,
    arrivals: list[Arrival],
    order: int,
) -> int:
    """Move the grid to a reporting instant and send every PMU's frame; what gets through goes onto the heap.

    ``order`` counts frames, to keep those that arrive at one time apart; returns the next.
    """
    grid.advance(stamp_ns)
    buses = grid.buses()
    outcome.swing_mhz.append(_swing_mhz(buses))
    since_ns = stamp_ns - START_NS
    for sender in senders:
        stream = sender.stream
        report = measure(sender.pmu, buses, stamp_ns, slot, nominal_hz=stream.nominal_hz)
        for out in sender.pipeline.apply(slot, stream.data_frame((report,)), since_ns):
            if out.fate is _SENT:
                heappush(arrivals, (START_NS + out.offset_ns, order, sender.wire, out.data))
                order += 1
    return order


def _note(outcome: Outcome, record: Record) -> None:
    time_s = (record.tick_ns - START_NS) / timebase.NS
    outcome.tick_s.append(time_s)
    outcome.delta_f_mhz.append(record.delta_f_mhz)
    outcome.command_mw.append(record.command_mw)
    outcome.closed.append(is_closed(record))
    if record.events:
        outcome.events.extend((time_s, event) for event in record.events)
    outcome.final_state = str(record.state)


def _uncontrolled(plan: Plan) -> list[float]:
    """The same grid left alone, as long as it is judged: its swing in mHz at the plan's rate."""
    grid = _grid(plan, plan.course, 0)
    swing = []
    stamps = _stamps(plan)
    length_s = min(plan.length_s, plan.course.ringdown_s[1]) if plan.course.ringdown_s else plan.length_s
    for _ in range(round(length_s * plan.rate_hz)):
        grid.advance(next(stamps))
        swing.append(_swing_mhz(grid.buses()))
    return swing


def _swing_mhz(buses: Mapping[str, Bus]) -> float:
    north, south = buses["north"], buses["south"]
    return (north.deviation_hz - south.deviation_hz + north.common_hz - south.common_hz) * 1e3
