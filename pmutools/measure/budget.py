"""The delay budget of a control loop, as in the paper's Table I: PMU, communication, processing, command, effective.

C37.118 frames do not say when they left the PMU. So from a receiver alone the parts are told as far as they can be:
the floor of the delay is the PMU with the least of the network, what comes above the floor is the network's, and the
wait from an arrival to the controller's next step is measured. With frames seen at the sender too (a player's ledger,
its transmit stamps, a second capture) PMU and communication are told apart. What remains is assumed, and says so.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from pmutools.measure.histogram import NS_PER_MS, Histogram

TABLE_I = {
    "PMU": (44.0, 40.0, 48.0),
    "Communication": (16.0, 15.0, 40.0),
    "Control processing": (11.0, 2.0, 17.0),
    "Command": (11.0, 11.0, 11.0),
    "Effective": (82.0, 69.0, 113.0),
}
"""Mean, least and largest in ms, as the paper measured them on the Pacific DC Intertie's controller."""
COMPUTE_MS = 2.0
"""Of a control step; the paper has 1 to 2 ms."""


@dataclass(frozen=True, slots=True)
class Row:
    """A line of the budget, in ms."""

    name: str
    mean_ms: float
    min_ms: float
    max_ms: float
    measured: bool
    how: str

    def to_json(self) -> dict[str, Any]:
        mean, least, most = TABLE_I[self.name]
        return {
            "name": self.name,
            "mean_ms": self.mean_ms,
            "min_ms": self.min_ms,
            "max_ms": self.max_ms,
            "measured": self.measured,
            "how": self.how,
            "paper_ms": {"mean": mean, "min": least, "max": most},
        }


class Departures(NamedTuple):
    """What a sender's record tells of delays."""

    at_sender: Histogram
    """Stamp to departure."""
    one_way: Histogram
    """Departure to arrival."""


def budget(
    delay: Histogram,
    pdv: Histogram,
    to_tick: Histogram,
    *,
    departures: Departures | None = None,
    compute_ms: float = COMPUTE_MS,
    command_ms: float | None = None,
) -> tuple[Row, ...]:
    """The rows of a stream, the last one their sum; none where no delay was measured.

    ``delay`` is stamp-to-arrival, ``pdv`` above its floor, ``to_tick`` from arrival to the next control step (of
    :class:`~pmutools.measure.windows.WindowCounts`), ``departures`` come from the sender. ``command_ms`` is the
    measured time from command to actuator; the paper's stands in for it.
    """
    if not delay.count:
        return ()
    rows = [*_to_arrival(delay, pdv, departures)]
    if to_tick.count:
        why = f"measured wait for the next control window, and {compute_ms:g} ms assumed for computing"
        mean, least, most = _ends(to_tick)
        rows.append(Row("Control processing", mean + compute_ms, least + compute_ms, most + compute_ms, True, why))
    else:
        rows.append(Row("Control processing", *TABLE_I["Control processing"], False, "the paper's"))
    if command_ms is None:
        rows.append(Row("Command", *TABLE_I["Command"], False, "the paper's"))
    else:
        rows.append(Row("Command", command_ms, command_ms, command_ms, True, "given"))
    assumed = [row.name for row in rows if not row.measured]
    how = f"sum; {' and '.join(assumed)} assumed" if assumed else "sum"
    mean, least, most = (
        sum(part) for part in zip(*((row.mean_ms, row.min_ms, row.max_ms) for row in rows), strict=True)
    )
    return (*rows, Row("Effective", mean, least, most, not assumed, how))


def _to_arrival(delay: Histogram, pdv: Histogram, departures: Departures | None) -> tuple[Row, Row]:
    mean, least, most = _ends(delay)
    if departures is not None and departures.at_sender.count and departures.one_way.count:
        return (
            Row("PMU", *_ends(departures.at_sender), True, "stamp to departure, seen at the sender"),
            Row("Communication", *_ends(departures.one_way), True, "departure to arrival, frame by frame"),
        )
    above = _ends(pdv)
    floor = mean - above[0]
    return (
        Row("PMU", floor, least, max(least, floor), True, "floor of the delay: the PMU with the least of the network"),
        Row("Communication", above[0], 0.0, most - least, True, "delay above its floor"),
    )


def _ends(found: Histogram) -> tuple[float, float, float]:
    assert found.mean_ns is not None and found.min_ns is not None and found.max_ns is not None
    return found.mean_ns / NS_PER_MS, found.min_ns / NS_PER_MS, found.max_ns / NS_PER_MS
