"""The tables that can be made of a session log: for each its columns, and its rows from one tick's messages.

An unknown number (NaN) is a null. ``tick``: one row a tick, the columns of every session in the same order.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

from dcon.core.values import value_of
from dcon.session.reader import SessionReader, TickMessages
from pmutools.schema.messages import MESSAGES, Field

ColumnType = Literal["int64", "uint64", "float64", "string", "bool"]
Row = tuple[int | float | str | bool | None, ...]


class Column(NamedTuple):
    name: str
    type: ColumnType
    nullable: bool = True


Rows = Callable[[TickMessages], Iterator[Row]]


@dataclass(frozen=True, slots=True)
class Table:
    """``messages`` are those (names of the schema table) that ``rows`` looks at, tick by tick."""

    messages: frozenset[str]
    columns: Callable[[SessionReader], tuple[Column, ...]]
    rows: Callable[[SessionReader], Rows]


def _known(value: float | None) -> float | None:
    return None if value is None or math.isnan(value) else value


def _column_names(prefix: str, names: tuple[str, ...], suffix: str) -> tuple[Column, ...]:
    return tuple(Column(f"{prefix}{name}{suffix}", "float64") for name in names)


def _tick_columns(session: SessionReader) -> tuple[Column, ...]:
    return (
        Column("tick_ns", "int64", nullable=False),
        Column("state", "string", nullable=False),
        Column("mode", "string", nullable=False),
        Column("active_instance", "string"),
        Column("gain_mw_per_mhz", "float64", nullable=False),
        Column("delta_f_mhz", "float64"),
        Column("command_mw", "float64", nullable=False),
        Column("output_v", "float64", nullable=False),
        Column("pdci_mw", "float64"),
        Column("flags", "uint64", nullable=False),
        *_column_names("f_", session.pmus, "_hz"),
        *_column_names("age_", session.pmus, "_ms"),
        Column("compute_us", "float64"),
        Column("late_us", "float64"),
        Column("probe_mw", "float64"),
    )


def _tick_rows(session: SessionReader, group: TickMessages) -> Iterator[Row]:
    tick, timing, pdci = group.one("Tick"), group.one("Timing"), group.one("Pdci")
    if tick is None:
        return
    count = len(session.pmus)
    yield (
        tick.tick_ns,
        tick.state,
        tick.mode,
        tick.active_instance or None,
        tick.gain_mw_per_mhz,
        _known(tick.delta_f_mhz),
        tick.command_mw,
        tick.output_v,
        None if pdci is None else _known(pdci.power_mw),
        tick.flags,
        *_padded(tick.f_hz, count),
        *_padded(tick.age_ms, count),
        None if timing is None else _known(timing.compute_us),
        None if timing is None else _known(timing.late_us),
        _known(tick.probe_mw),
    )


def _padded(values: Any, count: int) -> list[float | None]:
    """``count`` numbers: a log whose head is damaged may name fewer PMUs, or more, than its ticks hold."""
    known = [_known(value) for value in values[:count]]
    return known + [None] * (count - len(known))


def _instance_columns(_: SessionReader) -> tuple[Column, ...]:
    return (
        Column("tick_ns", "int64", nullable=False),
        Column("instance", "string", nullable=False),
        Column("state", "string", nullable=False),
        Column("active", "bool", nullable=False),
        Column("delta_f_mhz", "float64"),
        Column("command_mw", "float64"),
        Column("reason", "string"),
    )


def _instance_rows(session: SessionReader, group: TickMessages) -> Iterator[Row]:
    instance = group.one("Instance")
    if instance is None:
        return
    # a damaged head may name fewer instances than a tick holds: number the rest
    names = session.instances + tuple(map(str, range(len(session.instances), len(instance.state))))
    lists = (names, instance.state, instance.active, instance.delta_f_mhz, instance.command_mw, instance.reason)
    for name, state, active, delta_f_mhz, command_mw, reason in zip(*lists, strict=False):
        yield group.tick_ns, name, state, active, _known(delta_f_mhz), _known(command_mw), reason or None


def _pmu_columns(_: SessionReader) -> tuple[Column, ...]:
    return (
        Column("time_ns", "int64", nullable=False),
        Column("arrival_ns", "int64"),
        Column("tick_ns", "int64", nullable=False),
        Column("pmu", "string", nullable=False),
        Column("stamp_source", "string"),
        Column("stat", "int64", nullable=False),
        Column("time_quality", "int64", nullable=False),
        Column("v1.mag", "float64"),
        Column("v1.deg", "float64"),
        Column("freq_hz", "float64"),
        Column("rocof_hz_s", "float64"),
    )


def _pmu_rows(_: SessionReader, group: TickMessages) -> Iterator[Row]:
    for name, frame in group.frames:
        yield (
            frame.time_ns,
            frame.arrival_ns or None,
            frame.tick_ns,
            name,
            frame.stamp_source or None,
            frame.stat,
            frame.time_quality,
            _known(math.hypot(frame.v1_re, frame.v1_im)),
            _known(math.degrees(math.atan2(frame.v1_im, frame.v1_re))),
            _known(frame.frequency_hz),
            _known(frame.rocof_hz_s),
        )


def _event_columns(_: SessionReader) -> tuple[Column, ...]:
    return (
        Column("tick_ns", "int64", nullable=False),
        Column("kind", "string", nullable=False),
        Column("name", "string", nullable=False),
        Column("subject", "string"),
        Column("detail", "string"),
        Column("value", "float64"),
    )


def _event_rows(_: SessionReader, group: TickMessages) -> Iterator[Row]:
    """What the operator ordered (an input of the tick), then what happened in it."""
    for order in group.messages.get("Setting", ()):
        yield group.tick_ns, "order", order.name, None, None, _known(value_of(order.name, order.value))
    for event in group.messages.get("Event", ()):
        yield group.tick_ns, "event", event.name, event.subject or None, event.detail or None, None


_COLUMN_TYPES: dict[str, ColumnType] = {
    "double": "float64",
    "uint64": "uint64",
    "bool": "bool",
    "string": "string",
    "bytes": "string",
}


def _message_table(name: str) -> Table:
    """A message as it is: a column a field; a list as JSON, bytes as hexadecimal digits."""
    fields = MESSAGES[name].fields

    def columns(_: SessionReader) -> tuple[Column, ...]:
        return tuple(
            Column(field.name, "string" if field.repeated else _COLUMN_TYPES.get(field.type, "int64"))
            for field in fields
        )

    value = _order_value if name == "Setting" else getattr

    def rows(group: TickMessages) -> Iterator[Row]:
        for message in group.messages.get(name, ()):
            yield tuple(_cell(value(message, field.name), field) for field in fields)

    return Table(frozenset((name,)), columns, lambda _: rows)


def _order_value(order: Any, field: str) -> Any:
    return value_of(order.name, order.value) if field == "value" else getattr(order, field)


def _cell(value: Any, field: Field) -> int | float | str | bool | None:
    if field.repeated:
        return json.dumps([_cell(each, field._replace(repeated=False)) for each in value], ensure_ascii=False)
    if field.type == "bytes":
        return str(value.hex())
    if value == "":
        return None
    known: int | float | str | bool | None = _known(value) if isinstance(value, float) else value
    return known


def _each(rows: Callable[[SessionReader, TickMessages], Iterator[Row]]) -> Callable[[SessionReader], Rows]:
    return lambda session: partial(rows, session)


_OWN: dict[str, Table] = {
    "tick": Table(frozenset(("Tick", "Timing", "Pdci")), _tick_columns, _each(_tick_rows)),
    "instance": Table(frozenset(("Instance",)), _instance_columns, _each(_instance_rows)),
    "pmu": Table(frozenset(("PmuFrame",)), _pmu_columns, _each(_pmu_rows)),
    "event": Table(frozenset(("Event", "Setting")), _event_columns, _each(_event_rows)),
}
_TOPICS = {message.topic.removeprefix("/dcon/"): name for name, message in MESSAGES.items() if name != "PmuFrame"}
TABLES: dict[str, Table] = _OWN | {topic: _message_table(name) for topic, name in _TOPICS.items() if topic not in _OWN}
"""Every topic has one; the first four are made for reading."""
