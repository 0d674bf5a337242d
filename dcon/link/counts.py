"""What the processes count: what did not become what it was sent for. One list of names, for the log and for operators.

The front tells its own through the pair (:class:`FrontCounts`), the aides theirs as news; the control
process adds what it counts itself, logs all of it each second (``/dcon/counts``), and sums up with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

COUNTS: Final[Mapping[str, str]] = {
    "foreign": (
        "frames that no PMU of the settings sends (another IDCODE, or another source), and what else came from such "
        "sources"
    ),
    "undecodable": (
        "datagrams and runs of bytes that are no frame; configurations that make no sense, or are too long to be "
        "handed on, and the frames of the latter; data frames given up for want of a configuration"
    ),
    "held": "data frames that wait for a configuration now",
    "unreadable_yet": "frames that came more than a second before the first configuration of their PMU",
    "unneeded": "good frames that rule no data by themselves: headers, commands, CFG-1, parts of a CFG-3",
    "repeated": "configurations that are known already",
    "own_drops": "datagrams that this machine's full receive buffers have lost",
    "crowded": (
        "frames that came in a flood, or while the control process stood still, and found no room to wait; those of a "
        "PMU whose configuration had to"
    ),
    "overtaken_configs": "configurations that a newer one of their PMU replaced before they were taken",
    "unread": "frames that do not fit what the controller is set up for",
    "unsent": "commands that the system refused to send, or that nobody listened to",
    "news_ignored": "datagrams to the control process that say nothing it knows",
    "orders_refused": "orders whose signature, age, sequence or right did not hold; the log has up to ten a second",
    "orders_malformed": "datagrams from the server that hold no order, or name no place that could be answered",
    "orders_lost": "orders, and refusals of some, that the control process did not take",
    "line_foreign": "statuses of the line from another address than the one that is set",
    "line_refused": "statuses of the line that are malformed, old, no number, or from the future",
    "line_failed": "times that the line's device could not be asked",
    "untold": "news of front and aides that the control process did not take",
}
"""Names, and what each counts, since the start of its process; ``held`` is now."""

USUAL: Final = frozenset(("repeated",))
"""A spontaneous sender repeats its configuration about once a minute."""


@dataclass
class FrontCounts:
    """The front's share of :data:`COUNTS`, since its start."""

    foreign: int = 0
    undecodable: int = 0
    held: int = 0
    unreadable_yet: int = 0
    unneeded: int = 0
    repeated: int = 0
    own_drops: int = 0
    crowded: int = 0
    overtaken_configs: int = 0
    untold: int = 0


def total(*counts: Mapping[str, int]) -> dict[str, int]:
    """All of ``COUNTS``, added up by name; other names, of another version's log, are left out."""
    return {name: sum(each.get(name, 0) for each in counts) for name in COUNTS}


def words(counts: Mapping[str, int]) -> str:
    """Those that are not 0, in one line, but for what any stream brings; "" for none."""
    return ", ".join(f"{name} {counts[name]}" for name in COUNTS if name not in USUAL and counts.get(name))
