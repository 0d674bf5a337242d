"""One engine, three clocks: frames and orders in, a record and log entries out, one tick at a time.

The live platform, the simulation and the replay all drive :class:`Engine`, with their own sense of time. It has no
clock and no socket; what it cannot read is counted and treated as missing, so nothing here stops the controller.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from dcon.core.params import Params
from dcon.core.pmu import end_run
from dcon.core.rows import CORE
from dcon.core.state import State, initial_state
from dcon.core.step import step
from dcon.core.values import NOTHING, Event, Inputs, Mode, Order, Record, Sample, Surroundings, brief
from dcon.frontend import Binding, Reading, bind
from pmutools.c37118 import Frame, StreamConfig
from pmutools.errors import SettingsError, WireError
from pmutools.schema.pmu_log import PmuFrame
from pmutools.sites import Site


class Memory(NamedTuple):
    """All that the ticks to come depend on, beside the settings and what they are given."""

    state: State
    notes: tuple[Event, ...]
    """Events that the next tick will tell: of configurations that came before it."""
    configs: tuple[tuple[str, str], ...]
    """PMUs, sorted, and the digest of the configuration that is in force for each."""


@dataclass(frozen=True)
class Tick:
    """What one tick decided, and what it read, in the order read."""

    record: Record
    readings: tuple[Reading, ...]
    memory: Memory
    """What the engine knew just before it."""
    surroundings: Surroundings = NOTHING
    """What it was told, with the frames that it could not read."""

    @cached_property
    def frames(self) -> tuple[PmuFrame, ...]:
        """The frames read, as log entries."""
        return tuple(reading.entry() for reading in self.readings)


class Engine:
    """The controller's memory and its PMUs' bindings.

    :attr:`memory` is all of it that a tick depends on: an engine with the same settings that is given it by
    :meth:`resume` goes on bit for bit alike.
    """

    def __init__(
        self, params: Params, sites: Iterable[Site], *, mode: Mode = Mode.OPEN_LOOP, verified: bool = False
    ) -> None:
        """``sites`` in the order of ``params.pmus``; ``verified`` credits every instance with 20 s of good data."""
        self.params = params
        self.state: State = initial_state(params, mode=mode, verified=verified)
        _ = params.waveform, CORE.tables(params)  # worked out before a tick needs them
        self.sites = tuple(sites)
        self._index = {site.name: number for number, site in enumerate(self.sites)}
        self.bindings: dict[str, Binding] = {}
        self.unread: dict[str, int] = {}
        """Frames that could not be read, by PMU: no configuration yet, or not of its configuration."""
        self.configs: dict[str, StreamConfig] = {}
        """Newest configuration of each PMU, usable or not."""
        self._notes: list[Event] = []
        self._digests: tuple[tuple[str, str], ...] = ()

    @property
    def memory(self) -> Memory:
        """What is known now, for :meth:`resume`."""
        return Memory(self.state, tuple(self._notes), self._digests)

    def resume(self, memory: Memory, configs: Mapping[str, StreamConfig]) -> None:
        """Go on from ``memory``, with ``configs`` in force.

        Raises ValueError where other configurations were in force: only those tell how frames are read.
        """
        self.configs, self.bindings = {}, {}
        for name, config in configs.items():
            with suppress(SettingsError):  # unusable then as now
                self.configure(name, config)
        if self._digests != memory.configs:
            raise ValueError("other configurations were in force")
        self.state, self._notes = memory.state, list(memory.notes)

    def configure(self, name: str, config: StreamConfig) -> None:
        """A PMU's configuration came. Raises SettingsError where the PMU cannot be used with it: it is then unread."""
        self.configs[name] = config
        self._digests = tuple((each, self.configs[each].digest) for each in sorted(self.configs))
        self.bindings.pop(name, None)
        if name not in self._index:
            raise SettingsError(f"no PMU {name!r} in the settings; there are {', '.join(self._index)}")
        site = self.sites[self._index[name]]
        self.bindings[name] = bind(
            name,
            config,
            rate_hz=self.params.rate_hz,
            voltage=site.voltage,
            station=site.station,
            nominal_hz=self.params.nominal_hz,
        )

    def reconfigure(self, name: str, config: StreamConfig) -> str | None:
        """:meth:`configure` in a running session: a change is an event of the next tick; trouble is also returned.

        Where frames are read otherwise from now on, the PMU starts again, and its instances are verified anew.
        """
        known, bound = self.configs.get(name), self.bindings.get(name)
        if known == config:
            return None
        try:
            self.configure(name, config)
        except SettingsError as error:
            problem = brief(str(error))
            self._notes.append(Event("config_unusable", name, problem))
            return problem
        if known is not None:
            self._notes.append(Event("config_changed", name, f"data frames of {config.frame_size} bytes"))
            if bound is None or not bound.reads_like(self.bindings[name]):
                self._restart(self._index[name])
        return None

    def _restart(self, index: int) -> None:
        pmus = self.state.pmus
        self.state = self.state._replace(pmus=(*pmus[:index], end_run(pmus[index]), *pmus[index + 1 :]))

    def tick(
        self,
        frames: Mapping[str, Iterable[Frame]],
        orders: tuple[Order, ...],
        now_ns: int,
        surroundings: Surroundings = NOTHING,
    ) -> Tick:
        """Run one tick at ``now_ns`` with the data frames of each PMU that arrived since the last, in order.

        ``surroundings`` is what the tick is told besides; frames that cannot be read are added to it.
        """
        memory = self.memory
        samples: list[list[Sample]] = [[] for _ in self.sites]
        readings: list[Reading] = []
        lost = [0] * len(samples)
        for name, arrived in frames.items():
            binding, index = self.bindings.get(name), self._index.get(name)
            for frame in arrived:
                try:
                    read = None if binding is None else binding.read(frame)
                except WireError:
                    read = None
                if read is not None and index is not None:
                    samples[index].append(read.sample)
                    readings.append(read)
                    continue
                self.unread[name] = self.unread.get(name, 0) + 1
                if index is not None:
                    lost[index] += 1
        if any(lost):
            surroundings = surroundings._replace(unread=tuple(lost))
        inputs = Inputs(tuple(map(tuple, samples)), orders, surroundings)
        self.state, record = step(self.params, self.state, inputs, now_ns)
        if self._notes:
            record = record._replace(events=(*self._notes, *record.events))
            self._notes = []
        return Tick(record, tuple(readings), memory, surroundings)
