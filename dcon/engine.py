"""One engine, three clocks: frames and orders in, a record and log entries out, one tick at a time.

The live platform, the simulation and the replay all drive :class:`Engine`, with their own sense of time. It has no
clock and no socket; what it cannot read is counted and treated as missing, so nothing here stops the controller.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from dcon.core.params import Params
from dcon.core.state import State, initial_state
from dcon.core.step import step
from dcon.core.values import Event, Inputs, Mode, Order, Record, Sample
from dcon.frontend import Binding, bind
from dcon.settings import Site
from pmutools.c37118 import Frame, StreamConfig
from pmutools.errors import SettingsError, WireError
from pmutools.schema.pmu_log import PmuFrame


class Tick(NamedTuple):
    """What one tick decided, and the frames it consumed as log entries, in the order consumed."""

    record: Record
    frames: tuple[PmuFrame, ...]


class Engine:
    """The controller's memory and its PMUs' bindings."""

    def __init__(
        self, params: Params, sites: Iterable[Site], *, mode: Mode = Mode.OPEN_LOOP, verified: bool = False
    ) -> None:
        """``sites`` in the order of ``params.pmus``; ``verified`` credits every instance with 20 s of good data."""
        self.params = params
        self.state: State = initial_state(params, mode=mode, verified=verified)
        self.sites = tuple(sites)
        self._index = {site.name: number for number, site in enumerate(self.sites)}
        self.bindings: dict[str, Binding] = {}
        self.unread: dict[str, int] = {}
        """Frames that could not be read, by PMU: no configuration yet, or not of its configuration."""
        self._notes: list[Event] = []

    def configure(self, name: str, config: StreamConfig) -> None:
        """A PMU's configuration came. Raises SettingsError where the PMU cannot be used with it."""
        site = self.sites[self._index[name]]
        if (bound := self.bindings.get(name)) is not None and bound.config == config:
            return
        self.bindings.pop(name, None)
        self.bindings[name] = bind(
            name,
            config,
            rate_hz=self.params.rate_hz,
            voltage=site.voltage,
            station=site.station,
            nominal_hz=self.params.nominal_hz,
        )

    def reconfigure(self, name: str, config: StreamConfig) -> str | None:
        """:meth:`configure` in a running session: trouble becomes an event of the next tick, and is returned."""
        try:
            self.configure(name, config)
        except SettingsError as error:
            self._notes.append(Event("config_unusable", name, str(error)))
            return str(error)
        return None

    def tick(self, frames: Mapping[str, Iterable[Frame]], orders: tuple[Order, ...], now_ns: int) -> Tick:
        """Run one tick at ``now_ns`` with the data frames of each PMU that arrived since the last, in order."""
        samples: list[list[Sample]] = [[] for _ in self.sites]
        logged: list[PmuFrame] = []
        for name, arrived in frames.items():
            binding, into = self.bindings.get(name), samples[self._index[name]]
            for frame in arrived:
                try:
                    read = binding.read(frame) if binding is not None else None
                except WireError:
                    read = None
                if read is None:
                    self.unread[name] = self.unread.get(name, 0) + 1
                else:
                    into.append(read[0])
                    logged.append(read[1])
        inputs = Inputs(tuple(map(tuple, samples)), orders)
        self.state, record = step(self.params, self.state, inputs, now_ns)
        if self._notes:
            record = record._replace(events=(*self._notes, *record.events))
            self._notes = []
        return Tick(record, tuple(logged))
