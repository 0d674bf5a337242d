"""What the controller is doing, by the newest bundles: decoded for operators, whatever the disk does."""

from __future__ import annotations

import math
from collections import deque
from typing import Any, NamedTuple

from google.protobuf.message import DecodeError

from dcon.core.values import Event, InstanceState, Order, Surroundings
from dcon.link.bundle import Bundle, Entry
from dcon.link.counts import total
from dcon.server.status import NO_LINE, LineExpected, flag_text, line_of, watchdog_of
from dcon.session import codec
from dcon.session.head import Head
from pmutools.schema.descriptors import message_class

EVENTS = 50
"""The last that are told."""
MOST_FLAGS = 1000
"""Entries of the flag register that are kept."""
WELL = (InstanceState.READY, InstanceState.HELD)
SHOWN = frozenset(
    ("Tick", "Instance", "Event", "Flag", "Setting", "Surroundings", "Pdci", "Watchdog", "Timing", "Counts")
)


class TickSummary(NamedTuple):
    """What one tick tells of orders and of the line."""

    tick_ns: int = 0
    state: str = ""
    orders: tuple[Order, ...] = ()
    events: tuple[Event, ...] = ()
    driven_v: float | None = None
    line: tuple[int, float] | None = None
    """Time and modulation of the line's last report, MW."""


class Newest:
    """The last tick, the flag register and the last events of a session. Memory: bounded by the numbers above."""

    def __init__(self, head: Head, source: LineExpected = NO_LINE) -> None:
        """``source`` of the line's status."""
        self.head = head
        self._source = source
        self.tick_ns = 0
        self.ticks = 0
        self.undecodable = 0
        self._last: dict[str, Any] = {}
        self._flags: dict[tuple[str, str], Any] = {}
        self._events: deque[dict[str, Any]] = deque(maxlen=EVENTS)

    def take(self, bundle: Bundle) -> TickSummary:
        """Take in a tick."""
        news = TickSummary(bundle.tick_ns)
        orders: list[Order] = []
        events: list[Event] = []
        for entry in bundle.entries:
            if entry.message not in SHOWN or (message := self._decoded(entry)) is None:
                continue
            if entry.message == "Setting":
                orders.append(codec.decode_order(message))
            elif entry.message == "Event":
                events.append(Event(message.name, message.subject, message.detail))
                self._events.append({"tick_ns": bundle.tick_ns, **events[-1]._asdict()})
            elif entry.message == "Flag":
                self._flag(message)
            else:
                self._last[entry.message] = message
                if entry.message == "Tick":
                    self.tick_ns, self.ticks = bundle.tick_ns, self.ticks + 1
                    news = news._replace(state=message.state, driven_v=message.output_v)
                elif entry.message == "Pdci":
                    line = message.power_mw - message.scheduled_mw
                    news = news._replace(line=(message.time_ns, line if math.isfinite(line) else message.power_mw))
        return news._replace(orders=tuple(orders), events=tuple(events))

    def status(self, utc_ns: int, is_old: bool) -> dict[str, Any]:
        """For operators at ``utc_ns``; what is not known is None. ``is_old``: no ticks come any more."""
        tick, message = self._last.get("Tick"), self._last.get("Surroundings")
        if tick is None:
            none: dict[str, Any] = {"flags": [], "instances": [], "pmus": [], "events": []}
            return {
                "state": None,
                **none,
                "watchdog": None,
                "line": line_of(self._source, None, utc_ns),
                "counts": None,
            }
        told = None if message is None else codec.decode_surroundings(message)
        names, active = self.head.instances, tick.active
        return {
            "tick_ns": tick.tick_ns,
            "state": tick.state,
            "mode": tick.mode,
            "active": names[active] if 0 <= active < len(names) else None,
            "gain_mw_per_mhz": tick.gain_mw_per_mhz,
            "delta_f_mhz": tick.delta_f_mhz,
            "command_mw": tick.command_mw,
            "output_v": tick.output_v,
            "probe_mw": tick.probe_mw,
            "flags": self._flags_up(tick, told),
            "instances": self._instances(),
            "pmus": [
                {"name": name, "age_ms": age, "f_hz": f}
                for name, age, f in zip(self.head.pmus, tick.age_ms, tick.f_hz, strict=False)
            ],
            "watchdog": self._watchdog(utc_ns, is_old),
            "surroundings": None if told is None else _shown(told),
            "line": line_of(self._source, self._last.get("Pdci"), utc_ns),
            "timing": self._timing(),
            "counts": self._counts(),
            "events": list(self._events),
        }

    def _decoded(self, entry: Entry) -> Any | None:
        try:
            return message_class(entry.message).FromString(entry.data)
        except DecodeError:
            self.undecodable += 1
            return None

    def _flag(self, message: Any) -> None:
        key = (message.name, message.subject)
        self._flags.pop(key, None)
        self._flags[key] = message
        if len(self._flags) > MOST_FLAGS:
            self._flags.pop(next(iter(self._flags)))

    def _flags_up(self, tick: Any, told: Surroundings | None) -> list[dict[str, Any]]:
        """Those that are up, or latched; of the checks that are up and were not heard of, the name alone."""
        line = line_of(self._source, self._last.get("Pdci"), tick.tick_ns)
        known = [flag for flag in self._flags.values() if flag.up or flag.latched]
        shown = [
            {
                "name": flag.name,
                "subject": flag.subject,
                "text": flag_text(flag.name, told, line),
                "up": flag.up,
                "latched": flag.latched,
                "acknowledged": flag.acknowledged,
                "since_ns": flag.last_ns,
                "times": flag.times,
                "value": flag.value,
                "limit": flag.limit,
            }
            for flag in known
        ]
        heard = {flag.name for flag in known}
        for place, name in enumerate(self.head.flags):
            if tick.flags >> place & 1 and name not in heard:
                shown.append({"name": name, "subject": "", "text": flag_text(name, told, line), "up": True})
        return shown

    def _instances(self) -> list[dict[str, Any]]:
        instance = self._last.get("Instance")
        if instance is None:
            return []
        columns = (instance.state, instance.active, instance.delta_f_mhz, instance.command_mw, instance.reason)
        return [
            {
                "name": name,
                "state": state,
                "active": active,
                "delta_f_mhz": delta,
                "command_mw": command,
                "reason": "" if state in WELL else reason,  # it keeps why it was disabled last
            }
            for name, state, active, delta, command, reason in zip(self.head.instances, *columns, strict=False)
        ]

    def _watchdog(self, utc_ns: int, is_old: bool) -> dict[str, Any] | None:
        """What the controller heard of it, which it logs each second and when it changes."""
        watchdog = self._last.get("Watchdog")
        if watchdog is None:
            return None
        return watchdog_of(
            watchdog.silent or is_old,
            source="log",
            age_ms=max(utc_ns - watchdog.time_ns, 0) / 1e6,
            time_ns=watchdog.time_ns,
            relays_closed=watchdog.relays_closed,
            estop=watchdog.estop,
            latched=watchdog.latched,
            causes=watchdog.reason.split(),
            beats_ms=dict(zip(watchdog.heartbeat, watchdog.heartbeat_age_ms, strict=False)),
        )

    def _counts(self) -> dict[str, int] | None:
        counts = self._last.get("Counts")
        return None if counts is None else total(dict(zip(counts.name, counts.value, strict=False)))

    def _timing(self) -> dict[str, Any] | None:
        timing = self._last.get("Timing")
        if timing is None:
            return None
        return {"compute_us": timing.compute_us, "late_us": timing.late_us}


def _shown(told: Surroundings) -> dict[str, Any]:
    return {name: value for name, value in told._asdict().items() if name not in ("pdci", "unread")}
