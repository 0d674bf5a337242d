"""A tick as log entries: pure, so that it can be done in one process and written to the disk in another."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from dcon.core.values import NOTHING, Order, Pdci, Record, Surroundings
from dcon.engine import Memory
from dcon.link.bundle import Entry
from dcon.session import codec
from dcon.session.checkpoint import encode_checkpoint
from dcon.session.codec import Timing, Watchdog
from pmutools.schema.pmu_log import Loggable

_new = tuple.__new__  # half the time of a call; there are a dozen in a tick


def tick_entries(
    instances: Sequence[str],
    record: Record,
    frames: Iterable[Loggable] = (),
    orders: Iterable[Order] = (),
    *,
    timing: Timing | None = None,
    pdci: Pdci | None = None,
    counts: Mapping[str, int] | None = None,
    surroundings: Surroundings = NOTHING,
    memory: Memory | None = None,
) -> list[Entry]:
    """One tick: the ``frames``, ``orders`` and ``surroundings`` it was given, what it decided, how it ran.

    ``instances`` are the names that ``record.active`` counts in. ``frames`` in the order in which the controller got
    them. ``pdci`` is the line's status beside the tick; by default the one that the tick was told. ``counts`` are what
    the platform has counted by then. With ``memory``, the engine's before the tick, it is a checkpoint. Raises
    ValueError for a tick that is no POSIX time: a frame's tick 0 means none.
    """
    tick_ns = record.tick_ns
    if tick_ns <= 0:
        raise ValueError(f"tick_ns is {tick_ns}")
    entries = [
        _new(Entry, ("PmuFrame", frame.name, frame.encode(tick_ns), frame.arrival_ns or frame.time_ns, frame.time_ns))
        for frame in frames
    ]

    def add(message: str, data: bytes, time_ns: int = tick_ns) -> None:
        entries.append(_new(Entry, (message, "", data, tick_ns, time_ns)))

    if memory is not None and (checkpoint := encode_checkpoint(tick_ns, memory)) is not None:
        add("Checkpoint", checkpoint)
    for order in orders:
        add("Setting", codec.encode_order(tick_ns, order))
    if surroundings != NOTHING:
        add("Surroundings", codec.encode_surroundings(tick_ns, surroundings))
        pdci = pdci or surroundings.pdci
    add("Tick", codec.encode_tick(record, instances))
    add("Instance", codec.encode_instances(record))
    for event in record.events:
        add("Event", codec.encode_event(tick_ns, event))
    for flag in record.flag_changes:
        add("Flag", codec.encode_flag(tick_ns, flag))
    if timing is not None:
        add("Timing", codec.encode_timing(tick_ns, timing))
    if counts is not None:
        add("Counts", codec.encode_counts(tick_ns, counts))
    if pdci is not None:
        add("Pdci", codec.encode_pdci(tick_ns, pdci), pdci.time_ns)
    return entries


def watchdog_entry(watchdog: Watchdog) -> Entry:
    """State of the watchdog."""
    return Entry("Watchdog", "", codec.encode_watchdog(watchdog), watchdog.time_ns, watchdog.time_ns)
