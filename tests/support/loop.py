"""The controller and a grid in one process and virtual time: no bytes, no sockets."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction

from dcon.core.params import Params
from dcon.core.state import State, initial_state
from dcon.core.step import step
from dcon.core.values import Inputs, Mode, Order, Record, Sample, SystemState
from dcon.limiter import MW_PER_V
from pmutools.grid.grid import Grid
from pmutools.grid.plant import build
from pmutools.grid.pmu_model import PmuModel, fleet, measure
from pmutools.grid.scenarios import Scenario, scenario
from pmutools.timebase import NS, slot_time_ns

START_NS = 1_473_354_311 * NS
MS = 1_000_000
NORTH = ("N1", "N2", "N3", "N4")
SOUTH = ("S1", "S2", "S3", "S4")
QUIET = Scenario("quiet", "nothing happens")

Arrival = Callable[[str, int, int], Sequence[int]]
"""(PMU, frame index from 0, stamp) -> times at which copies of the frame arrive; none: lost."""


def on_time(_pmu: str, _index: int, time_ns: int) -> tuple[int, ...]:
    """Table I's means: 44 ms in the PMU, 16 ms on the network."""
    return (time_ns + 60 * MS,)


def params(**settings: object) -> Params:
    """Eight PMUs, sixteen instances; deadband 0 unless given."""
    return Params.paired(NORTH, SOUTH, nominal_kv=500.0, **{"deadband_mhz": 0.0, **settings})


@dataclass
class Session:
    """What a run leaves behind."""

    params: Params
    records: list[Record]
    difference_hz: list[float]
    """True f_north - f_south of the plant at each frame's stamp."""
    state: State
    inputs: list[tuple[Inputs, int]] = field(default_factory=list)

    def at(self, time_s: float) -> Record:
        return next(record for record in self.records if record.tick_ns >= START_NS + round(time_s * NS))

    def times(self, event: str, subject: str | None = None) -> list[float]:
        return [
            (record.tick_ns - START_NS) / NS
            for record in self.records
            for found in record.events
            if found.name == event and subject in (None, found.subject)
        ]


def run(
    settings: Params,
    *,
    duration_s: float,
    scene: Scenario | str = "cjb",
    plant: str = "modal",
    pmus: Sequence[PmuModel] | None = None,
    arrivals: Arrival = on_time,
    closed: bool = True,
    tick_age_ms: float = 71.0,
    command_ms: float = 11.0,
    orders: dict[float, Order] | None = None,
    verified: bool = True,
) -> Session:
    """Run a closed loop whose every tick is ``tick_age_ms`` (modulo a period) past the stamp it acts on."""
    scene = scenario(scene) if isinstance(scene, str) else scene
    pmus = fleet() if pmus is None else pmus
    rate = Fraction(settings.rate_hz)
    grid = Grid(build(plant, scene.condition), scene, start_ns=START_NS, command_delay_ns=round(command_ms * MS))
    first_slot = START_NS // NS * settings.rate_hz
    phase_ns = round(tick_age_ms * MS) % (NS // settings.tick_hz)
    state = initial_state(settings, mode=Mode.CLOSED_LOOP if closed else Mode.OPEN_LOOP, verified=verified)
    under_way: list[tuple[int, int, int, Sample]] = []
    session = Session(settings, [], [], state)
    pending = dict(orders or {})
    frame = serial = 0
    for tick in range(round(duration_s * settings.tick_hz)):
        now_ns = START_NS + phase_ns + slot_time_ns(tick, Fraction(settings.tick_hz))
        while (stamp := slot_time_ns(first_slot + frame, rate)) <= now_ns:
            grid.advance(stamp)
            buses = grid.buses()
            session.difference_hz.append(buses["north"].deviation_hz - buses["south"].deviation_hz)
            for index, pmu in enumerate(pmus):
                seen = measure(pmu, buses, stamp, first_slot + frame)
                for arrival in arrivals(pmu.name, frame, stamp):
                    sample = Sample(stamp, arrival, seen.v1, seen.frequency_hz, 0, 0)
                    heapq.heappush(under_way, (arrival, serial, index, sample))
                    serial += 1
            frame += 1
        queues: list[list[Sample]] = [[] for _ in pmus]
        while under_way and under_way[0][0] <= now_ns:
            _, _, index, sample = heapq.heappop(under_way)
            queues[index].append(sample)
        given = [pending.pop(at) for at in sorted(pending) if START_NS + at * NS <= now_ns]
        if orders is None:
            given = {SystemState.STANDBY: [Order("arm")], SystemState.ARMED: [Order("activate")]}.get(state.system, [])
        inputs = Inputs(tuple(map(tuple, queues)), tuple(given))
        state, record = step(settings, state, inputs, now_ns)
        session.records.append(record)
        session.inputs.append((inputs, now_ns))
        grid.advance(now_ns)
        grid.command(record.output_v * MW_PER_V, now_ns)
    session.state = state
    return session
