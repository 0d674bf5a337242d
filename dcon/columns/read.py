"""A session as numpy columns: the base of everything that looks at a whole session afterwards.

>>> session = read_columns("session.mcap")            # doctest: +SKIP
>>> session.tick.command_mw                           # doctest: +SKIP
>>> session.pmu["N1"].frequency_hz                    # doctest: +SKIP

The values are those of :class:`~dcon.session.reader.SessionReader`, to the last bit (but for |V1| and its angle, which
are computed). It takes a quarter of the time, about ten seconds for an hour, and gives no other phasors, no bytes and
no reasons: an event tells why an instance was disabled.

A log may be in parts, cut or damaged: what can be read is there, :attr:`SessionColumns.gaps` says between which ticks
something is missing. Memory: a batch of chunks, and about 200 MB for an hour of eight PMUs at 60 frames/s.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any, Final

import numpy as np

from dcon.columns.blocks import Blocks, codes_of, looked_up, named, places
from dcon.columns.tables import (
    INSTANCE_STATES,
    MODES,
    STAMP_SOURCES,
    STATES,
    UNKNOWN,
    EventRow,
    FlagRow,
    Floats,
    InstanceColumns,
    Ints,
    OrderRow,
    PmuColumns,
    SessionColumns,
    TickColumns,
)
from dcon.session.codec import Watchdog, decode_flag, decode_order
from dcon.session.newer import newer_in
from dcon.session.parts import Part, Paths, lost
from dcon.session.reader import SessionReader
from pmutools.schema.columns import Texts, decode_columns
from pmutools.schema.descriptors import message_class, unnamed_fields
from pmutools.schema.log_reader import LogReader
from pmutools.schema.pmu_log import name_of

BATCH_MESSAGES: Final = 50_000
"""Messages that are held as bytes at once; about 20 MB."""
Batch = dict[tuple[str, str], list[bytes]]
"""Messages by kind; those of PMUs by topic, too."""
_ALWAYS = frozenset(("Tick", "Timing", "Pdci"))
_MESSAGES: Final = {
    "instance": frozenset(("Instance",)),
    "pmu": frozenset(("PmuFrame",)),
    "event": frozenset(("Event", "Setting", "Flag", "Watchdog")),
}
TABLES: Final = tuple(_MESSAGES)
"""What may be left out."""


def read_columns(paths: Paths, tables: Collection[str] = TABLES) -> SessionColumns:
    """Read a session log: one file, the first part with those that follow it, or parts as named.

    ``tables``: which of :data:`TABLES` to read beside ``tick``; ``event`` is events, orders, changes
    of flags, and watchdog. Raises
    SourceError for what is no session log, as :class:`~dcon.session.reader.SessionReader` does.
    """
    reader = SessionReader(paths)
    builder = _Builder(reader, "instance" in tables)
    wanted = _ALWAYS.union(*(_MESSAGES[table] for table in tables))
    reader.reset_damage()
    before: Part | None = None
    for part in reader.parts:
        if lost(before, part):
            builder.gap()
        for batch, is_damaged in _batches(part.log, wanted):
            builder.take(batch)
            if is_damaged:
                builder.gap()
        before = part
    return builder.session()


def _batches(log: LogReader, wanted: Collection[str]) -> Iterator[tuple[Batch, bool]]:
    """The wanted messages of one file, whole ticks together, and whether something is missing behind them."""
    batch: Batch = {}
    count = losses = 0
    for found in log.batches(wanted):
        if not isinstance(found, list):
            continue
        for channel, _, _, data in found:
            kind = channel.message
            # What belongs to a tick and is told beside it comes after it: before a tick, all that is waiting is whole.
            if kind == "Tick" and (count >= BATCH_MESSAGES or log.damage.losses > losses):
                yield batch, log.damage.losses > losses
                batch, count, losses = {}, 0, log.damage.losses
            batch.setdefault((str(kind), channel.topic if kind == "PmuFrame" else ""), []).append(data)
            count += 1
    yield batch, log.damage.losses > losses


class _Builder:
    """Takes messages batch by batch."""

    def __init__(self, reader: SessionReader, with_instances: bool) -> None:
        self._reader = reader
        self._with_instances = with_instances
        self._ticks = 0
        self._tick = Blocks()
        self._instance = Blocks()
        self._pmu: dict[str, Blocks] = {}
        self._gaps: list[int] = []
        self._incomplete = 0
        self._events: list[EventRow] = []
        self._orders: list[OrderRow] = []
        self._flags: list[FlagRow] = []
        self._watchdog: list[Watchdog] = []
        self._take_instances(self._take_ticks({}), [])  # so that every column is there

    def gap(self) -> None:
        """Something is missing here."""
        if self._ticks not in self._gaps[-1:]:
            self._gaps.append(self._ticks)

    def take(self, batch: Batch) -> None:
        """Messages by kind (and topic); those of one tick in one batch."""
        tick_ns = self._take_ticks(batch)
        if self._with_instances:
            self._take_instances(tick_ns, batch.get(("Instance", ""), []))
        for (kind, topic), messages in batch.items():
            if kind == "PmuFrame":
                self._take_frames(name_of(topic), messages)
            elif kind == "Event":
                self._events += [EventRow(m.tick_ns, m.name, m.subject, m.detail) for m in self._each(kind, messages)]
            elif kind == "Setting":
                self._orders += [OrderRow(m.tick_ns, *decode_order(m)) for m in self._each(kind, messages)]
            elif kind == "Flag":
                self._flags += [FlagRow(m.tick_ns, decode_flag(m)) for m in self._each(kind, messages)]
            elif kind == "Watchdog":
                self._watchdog += [_watchdog(message) for message in self._each(kind, messages)]
        self._ticks += len(tick_ns)

    def _take_ticks(self, batch: Batch) -> Ints:
        rows, of = self._columns("Tick", batch.get(("Tick", ""), []), _TICK_FIELDS)
        for row in np.flatnonzero(np.diff(rows, prepend=-1) > 1).tolist():  # a tick that does not decode
            self._gaps.append(self._ticks + row)
        tick_ns: Ints = of["tick_ns"]
        beside: dict[str, Floats] = {}
        for kind, names in _BESIDE.items():
            _, others = self._columns(kind, batch.get((kind, ""), []), {"tick_ns", *names})
            at = places(others["tick_ns"], tick_ns)
            for field, column in names.items():
                beside[column] = looked_up(others[field], at)
        self._tick.add(
            tick_ns=tick_ns,
            state=codes_of(of["state"], STATES),
            mode=codes_of(of["mode"], MODES),
            active=of["active"].astype(np.int16),
            **{name: of[name] for name in _TICK_NUMBERS},
            **beside,
        )
        return tick_ns

    def _take_instances(self, tick_ns: Ints, messages: list[bytes]) -> None:
        _, of = self._columns("Instance", messages, {"tick_ns", "state", "delta_f_mhz", "command_mw"})
        at = places(of["tick_ns"], tick_ns)
        self._incomplete += int((at < 0).sum())
        self._instance.add(
            state=looked_up(codes_of(of["state"], INSTANCE_STATES), at, UNKNOWN),
            delta_f_mhz=looked_up(of["delta_f_mhz"], at),
            command_mw=looked_up(of["command_mw"], at),
        )

    def _take_frames(self, name: str, messages: list[bytes]) -> None:
        _, of = self._columns("PmuFrame", messages, _FRAME_FIELDS)
        used = of["tick_ns"] != 0
        if not used.all():  # no tick consumed them
            of = {
                key: column._replace(codes=column.codes[used]) if isinstance(column, Texts) else column[used]
                for key, column in of.items()
            }
        self._pmu.setdefault(name, Blocks()).add(
            time_ns=of["time_ns"],
            arrival_ns=of["arrival_ns"],
            tick_ns=of["tick_ns"],
            v1_mag=np.hypot(of["v1_re"], of["v1_im"]),
            v1_rad=np.arctan2(of["v1_im"], of["v1_re"]),
            frequency_hz=of["frequency_hz"],
            rocof_hz_s=of["rocof_hz_s"],
            stat=of["stat"].astype(np.uint16),
            time_quality=of["time_quality"].astype(np.uint8),
            stamp_source=codes_of(of["stamp_source"], STAMP_SOURCES),
        )

    def _columns(self, kind: str, messages: list[bytes], fields: Collection[str]) -> tuple[Ints, dict[str, Any]]:
        """``rows`` and ``fields`` of the messages; what else there is to say of them is noted."""
        columns = decode_columns(kind, messages, fields)
        log = self._reader.parts[0].log
        log.damage.undecodable += len(messages) - len(columns.rows)
        log.unnamed(kind, columns.unnamed)
        return columns.rows, columns.fields

    def _each(self, kind: str, messages: list[bytes]) -> Iterator[Any]:
        from google.protobuf.message import DecodeError

        log = self._reader.parts[0].log
        for message in messages:
            try:
                decoded = message_class(kind).FromString(message)
            except DecodeError:
                log.damage.undecodable += 1
                continue
            log.unnamed(kind, unnamed_fields(decoded))
            yield decoded

    def session(self) -> SessionColumns:
        reader = self._reader
        tick = self._tick.whole(len(reader.pmus))
        instance = self._instance.whole(len(reader.instances))
        return SessionColumns(
            metadata=reader.metadata,
            ini_text=reader.ini_text,
            pmus=named(reader.pmus, tick["f_hz"].shape[1]),
            instances=named(reader.instances, instance["state"].shape[1]),
            flags=reader.flags,
            tick=TickColumns(**tick),
            instance=InstanceColumns(**instance),
            pmu={name: PmuColumns(**blocks.whole()) for name, blocks in self._pmu.items()},
            events=self._events,
            orders=self._orders,
            flag_changes=self._flags,
            watchdog=self._watchdog,
            gaps=self._gaps,
            incomplete_ticks=self._incomplete,
            damage=reader.damage,
            newer=newer_in(reader),
            missing=reader.missing,
        )


_TICK_NUMBERS = (*("gain_mw_per_mhz", "delta_f_mhz", "command_mw", "output_v", "probe_mw", "flags", "f_hz", "age_ms"),)
_TICK_FIELDS = frozenset(("tick_ns", "state", "mode", "active", *_TICK_NUMBERS))
_BESIDE = {"Timing": {"compute_us": "compute_us", "late_us": "late_us"}, "Pdci": {"power_mw": "pdci_mw"}}
"""Messages told beside a tick: their fields, and the columns that these become."""
_FRAME_FIELDS = frozenset(
    (
        *("time_ns", "arrival_ns", "tick_ns", "v1_re", "v1_im", "frequency_hz", "rocof_hz_s"),
        *("stat", "time_quality", "stamp_source"),
    )
)


def _watchdog(message: Any) -> Watchdog:
    heartbeats = tuple(zip(message.heartbeat, message.heartbeat_age_ms, strict=False))
    said = (message.relays_closed, message.estop, message.latched, message.reason)
    return Watchdog(message.time_ns, *said, heartbeats, message.silent)
