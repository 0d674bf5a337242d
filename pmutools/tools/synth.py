"""``pmu synth``, ``pmu play --plant``: a simulated grid lives through a scenario; its PMUs' frames are a recording.

Everything is a function of the arguments: the same ones give the same bytes. :func:`synthesise` makes frame after frame
in order of arrival, :func:`plant_blocks` the same frames a stream at a time, in columns.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools import timebase
from pmutools.c37118.batch import STAMP_SOURCES, Batch, decode_batch
from pmutools.c37118.checksum import seal_array
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import FrameType
from pmutools.c37118.demux import Loss, Message, Tally
from pmutools.c37118.framer import Frame
from pmutools.c37118.layout import dtype_of
from pmutools.flow import Flow, StampSource
from pmutools.formats.source import Block
from pmutools.grid.emulate import EmulatedStream
from pmutools.grid.grid import Grid
from pmutools.grid.plant import build
from pmutools.grid.pmu_model import PHASORS, PmuModel, fleet, measure, measured_columns
from pmutools.grid.scenarios import scenario
from pmutools.grid.signals import Bus
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


class _Emulated(NamedTuple):
    """A stream, where it comes from, and the way of each of its PMUs to the recorder."""

    stream: EmulatedStream
    flow: Flow
    ways: tuple[Pipeline, ...]

    def opening(self, start_ns: int) -> Message:
        data = self.stream.config_frame(start_ns)
        return Message(Frame(data, start_ns, StampSource.CAPTURE, 0), self.flow, self.stream.config)

    def arrival_ns(self, slot: int, data: bytes, time_ns: int) -> int:
        """A concentrator waits for its slowest PMU."""
        return max(out.offset_ns for way in self.ways for out in way.apply(slot, data, time_ns))


def _emulated(recipe: Recipe) -> list[_Emulated]:
    pmus = fleet_of(recipe.pmus, recipe.seed)
    groups = [pmus] if recipe.pdc_idcode is not None else [(pmu,) for pmu in pmus]
    streams = [EmulatedStream(group, recipe.rate, idcode=recipe.pdc_idcode) for group in groups]
    profile = ready_profile(DELAYS).then(parse_profile(_IN_ORDER, "order"))
    return [
        _Emulated(stream, _flow(number), tuple(Pipeline(profile, pmu.name, recipe.seed) for pmu in stream.pmus))
        for number, stream in enumerate(streams)
    ]


def _grid(recipe: Recipe) -> tuple[Grid, int]:
    """The grid at its start, and how many reporting instants it is to live through."""
    course = scenario(recipe.scenario)
    grid = Grid(build(recipe.plant, course.condition), course, start_ns=recipe.start_ns, seed=recipe.seed)
    duration_s = course.duration_s if recipe.duration_s is None else recipe.duration_s
    return grid, round(duration_s * recipe.rate)


def _time_ns(recipe: Recipe, slot: int) -> int:
    return recipe.start_ns + (slot * timebase.NS + recipe.rate // 2) // recipe.rate


def synthesise(recipe: Recipe) -> Iterator[Message]:
    """Frames of all PMUs in order of arrival, each stream's CFG-2 first. Raises SettingsError for unknown names."""
    grid, slots = _grid(recipe)
    emulated = _emulated(recipe)
    yield from (each.opening(recipe.start_ns) for each in emulated)
    waiting: list[Message] = []
    for slot in range(slots):
        time_ns = _time_ns(recipe, slot)
        yield from _due(waiting, time_ns)
        grid.advance(time_ns)
        buses = grid.buses()
        for each in emulated:
            stream = each.stream
            reports = [measure(pmu, buses, time_ns, slot, nominal_hz=stream.nominal_hz) for pmu in stream.pmus]
            data = stream.data_frame(reports)
            frame = Frame(data, each.arrival_ns(slot, data, time_ns), StampSource.CAPTURE, 0)
            waiting.append(Message(frame, each.flow, stream.config))
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


# --- many frames at once ----------------------------------------------------------------------------------------

BLOCK_S = 2
"""Seconds of stamps in a block."""


class PlantSource:
    """A simulated plant as a source: made as it is read, and the same each time it is opened.

    Raises SettingsError for names of plants and scenarios that there are not.
    """

    kind = "synth"

    def __init__(self, recipe: Recipe) -> None:
        self.path, self.tally = Path(recipe.plant), Tally()
        self._recipe = recipe
        _grid(recipe)  # unknown names are told now

    def defects(self) -> dict[str, int]:
        return {}

    def items(self) -> Iterator[Message | Loss]:
        for message in synthesise(self._recipe):
            self.tally.count(message.frame.type, 1, len(message.frame.data))
            yield message

    def blocks(self) -> Iterator[Block | Message | Loss]:
        for item in plant_blocks(self._recipe):
            if isinstance(item, Block):
                self.tally.count(FrameType.DATA, len(item.batch), item.batch.config.frame_size)
            else:
                self.tally.count(item.frame.type, 1, len(item.frame.data))
            yield item


def plant_blocks(recipe: Recipe) -> Iterator[Block | Message]:
    """The frames of :func:`synthesise` in blocks of :data:`BLOCK_S` seconds, stream after stream.

    The blocks are in order of their first stamps, and within one frames are in order of stamps.
    """
    grid, slots = _grid(recipe)
    emulated = _emulated(recipe)
    yield from (each.opening(recipe.start_ns) for each in emulated)
    step = max(BLOCK_S * recipe.rate, 1)
    for first in range(0, slots, step):
        numbers = range(first, min(first + step, slots))
        times_ns = [_time_ns(recipe, slot) for slot in numbers]
        courses = _courses(grid, times_ns)
        for each in emulated:
            yield Block(each.flow, _batch(each, numbers, times_ns, courses))


def _courses(grid: Grid, times_ns: Sequence[int]) -> dict[str, npt.NDArray[np.float64]]:
    """What each bus shows at these times: (N, 7), columns as in :class:`Bus`."""
    seen: dict[str, list[Bus]] = {}
    for time_ns in times_ns:
        grid.advance(time_ns)
        for name, bus in grid.buses().items():
            seen.setdefault(name, []).append(bus)
    return {name: np.array(course) for name, course in seen.items()}


def _batch(
    each: _Emulated, slots: range, times_ns: Sequence[int], courses: Mapping[str, npt.NDArray[np.float64]]
) -> Batch:
    stream, config = each.stream, each.stream.config
    wire = _blank(config, times_ns)
    for number, pmu in enumerate(stream.pmus):
        _put(wire[f"s{number}"], pmu, slots, courses[pmu.bus], stream.nominal_hz)
    octets = wire.view(np.uint8).reshape(len(wire), config.frame_size)
    seal_array(octets)
    wire.flags.writeable = False
    head = octets[0].tobytes()  # delays ask for a frame's type only
    arrivals = [each.arrival_ns(slot, head, time_ns) for slot, time_ns in zip(slots, times_ns, strict=True)]
    return decode_batch(wire, config, arrivals, STAMP_SOURCES.index(StampSource.CAPTURE), check=False)


def _blank(config: StreamConfig, times_ns: Sequence[int]) -> npt.NDArray[np.void]:
    wire = np.zeros(len(times_ns), dtype_of(config))
    soc, fracsec = timebase.from_ns_array(np.array(times_ns), config.time_base)
    wire["sync"], wire["framesize"], wire["idcode"] = FrameType.DATA.sync, config.frame_size, config.idcode
    wire["soc"], wire["fracsec"] = soc, fracsec
    return wire


def _put(
    block: npt.NDArray[np.void], pmu: PmuModel, slots: range, course: npt.NDArray[np.float64], nominal_hz: float
) -> None:
    """Column by column what :func:`~pmutools.grid.pmu_model.measure` reports one by one."""
    columns = measured_columns(pmu, course, slots, nominal_hz=nominal_hz)
    phasors = np.stack(columns[: len(PHASORS)], axis=1)
    block["phasors"][..., 0], block["phasors"][..., 1] = np.abs(phasors), np.angle(phasors)
    block["freq"], block["dfreq"] = columns[-2:]
