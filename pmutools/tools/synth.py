"""``pmu synth``: a simulated grid lives through a scenario; its PMUs' frames become a recording.

Everything is a function of the arguments: the same ones give the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from pmutools import timebase
from pmutools.c37118.demux import Message
from pmutools.c37118.framer import Frame
from pmutools.flow import Flow, StampSource
from pmutools.grid.emulate import EmulatedStream
from pmutools.grid.grid import Grid
from pmutools.grid.plant import build
from pmutools.grid.pmu_model import PmuModel, fleet, measure
from pmutools.grid.scenarios import scenario
from pmutools.impair.pipeline import Pipeline
from pmutools.impair.profile import parse_profile
from pmutools.impair.profiles import ready_profile

START_NS = timebase.parse_utc("2024-01-01T00:00:00Z")
DELAYS = "table1"
"""The ready profile that frames go through from the stamp to the recorder, in order."""
_IN_ORDER = "[stream *]\ndelay = +constant(0) order=keep\n"
FIRST_PORT = 4801
NOISE_RAD = 1e-4


@dataclass(frozen=True, slots=True)
class Recipe:
    """What to synthesise; ``duration_s`` None means the scenario's own."""

    scenario: str = "cjb"
    plant: str = "modal"
    pmus: int = 8
    rate: int = 60
    duration_s: float | None = None
    seed: int = 1
    pdc_idcode: int | None = None
    """Put all PMUs into one stream with this IDCODE, as a concentrator does."""
    start_ns: int = START_NS


def fleet_of(count: int, seed: int) -> tuple[PmuModel, ...]:
    """``count`` PMUs, shared between north and south, the north's first."""
    models = fleet((count + 1) // 2, noise_rad=NOISE_RAD, seed=seed)
    north, south = models[: len(models) // 2], models[len(models) // 2 :]
    return (*north, *south[: count - len(north)])


def synthesise(recipe: Recipe) -> Iterator[Message]:
    """Frames of all PMUs in order of arrival, each stream's CFG-2 first. Raises SettingsError for unknown names."""
    course = scenario(recipe.scenario)
    grid = Grid(build(recipe.plant, course.condition), course, start_ns=recipe.start_ns, seed=recipe.seed)
    pmus = fleet_of(recipe.pmus, recipe.seed)
    groups = [pmus] if recipe.pdc_idcode is not None else [(pmu,) for pmu in pmus]
    streams = [EmulatedStream(group, recipe.rate, idcode=recipe.pdc_idcode) for group in groups]
    flows = [_flow(number) for number in range(len(streams))]
    profile = ready_profile(DELAYS).then(parse_profile(_IN_ORDER, "order"))
    links = [[Pipeline(profile, pmu.name, recipe.seed) for pmu in stream.pmus] for stream in streams]
    duration_s = course.duration_s if recipe.duration_s is None else recipe.duration_s
    for stream, flow in zip(streams, flows, strict=True):
        opening = stream.config_frame(recipe.start_ns)
        yield Message(Frame(opening, recipe.start_ns, StampSource.CAPTURE, 0), flow, stream.config)
    waiting: list[Message] = []
    for slot in range(round(duration_s * recipe.rate)):
        time_ns = recipe.start_ns + (slot * timebase.NS + recipe.rate // 2) // recipe.rate
        yield from _due(waiting, time_ns)
        grid.advance(time_ns)
        buses = grid.buses()
        for stream, flow, ways in zip(streams, flows, links, strict=True):
            reports = [measure(pmu, buses, time_ns, slot, nominal_hz=stream.nominal_hz) for pmu in stream.pmus]
            data = stream.data_frame(reports)
            delayed = [out for way in ways for out in way.apply(slot, data, time_ns)]
            arrival_ns = max(out.offset_ns for out in delayed)  # a concentrator waits for its slowest PMU
            frame = Frame(data, arrival_ns, StampSource.CAPTURE, 0)
            waiting.append(Message(frame, flow, stream.config))
    yield from _due(waiting, 1 << 63)


def _due(waiting: list[Message], time_ns: int) -> Sequence[Message]:
    """Take the messages that arrive before ``time_ns`` out of ``waiting``, in order of arrival."""
    due = sorted((m for m in waiting if _arrival(m) < time_ns), key=_arrival)
    waiting[:] = [m for m in waiting if _arrival(m) >= time_ns]
    return due


def _arrival(message: Message) -> int:
    return message.frame.arrival_ns or 0


def _flow(number: int) -> Flow:
    """Addresses of the documentation range (RFC 5737), one sender a stream, one port a stream at the receiver."""
    return Flow("udp", f"192.0.2.{11 + number % 200}:4713", f"192.0.2.1:{FIRST_PORT + number}")
