"""What a display draws: all streams at one moment, as columns, and one of them as a row."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.tools.watch.table import Floats, Ints


class StreamState(StrEnum):
    """What a stream, or an endpoint that has none yet, does; those that want attention first."""

    LOST = "connection lost"
    FAILED = "no connection"
    UNANSWERED = "no answer"
    NOTHING = "nothing came"
    SILENT = "silent"
    NO_CONFIG = "no configuration"
    FOREIGN = "foreign"
    WAITING = "waiting"
    STREAMING = "streaming"


STATES = tuple(StreamState)


class Row(NamedTuple):
    """One stream at one moment. Numbers that are not known are NaN; what is recent is of the last 10 s."""

    name: str
    idcode: int
    transport: str
    where: str
    """Who sends it."""
    state: StreamState
    silent_s: float
    """Since its last frame; NaN where none has come."""
    configured_hz: float
    rate_hz: float
    """Frames that came in the last second."""
    recent_hz: float
    """... in the last 10 s, a second."""
    frames: int
    lost: int
    duplicated: int
    late: int
    stale: int
    recent_loss: float
    """Share of the recent slots that nothing came for."""
    recent_complete: float
    """Share of the recent slots whose frame came within the wait."""
    recent_good: float
    """Share of the recent frames that can be used."""
    p50_ms: float
    p99_ms: float
    max_ms: float
    all_p50_ms: float
    """Since the start, to 6 %."""
    all_p99_ms: float
    all_max_ms: float
    jitter_ms: float
    frequency_hz: float
    """The last one, of the first station."""
    stat: int
    """The last STAT; of several stations, the bits that any of them sets."""
    time_quality: int
    """The last time quality byte."""
    stations: int
    news: str
    news_s: float
    """How long ago that was."""
    frequencies_hz: Floats
    """(P,) means of quarters of a second, the oldest first."""
    delays_ms: Floats
    """(P,) the largest of each."""


@dataclass(frozen=True)
class Snapshot:
    """All streams, a column a field of :class:`Row`; and what is of all of them together."""

    columns: Mapping[str, Any]
    """Each (R,) or a sequence of R; the two series (R, P)."""
    running_s: float
    frames: int
    rate_hz: float
    lost: int
    duplicated: int
    own_drops: int
    """Datagrams that this machine had no room for."""
    skipped: Mapping[str, int] = field(default_factory=dict)
    """Bytes that are in no frame, by reason."""
    untold: int = 0
    """Frames of streams beyond those that are kept."""

    def __len__(self) -> int:
        return len(self.columns["name"])

    def row(self, number: int) -> Row:
        return Row(
            **{
                name: STATES[column[number]] if name == "state" else _plain(column[number])
                for name, column in self.columns.items()
            }
        )

    def column(self, name: str) -> npt.NDArray[Any]:
        """The values of one field, as something that can be sorted."""
        return np.asarray(self.columns[name])

    def worst_first(self) -> npt.NDArray[np.intp]:
        """Rows: what does not stream, then by recent loss, by frames that cannot be used, by p99."""
        columns = self.columns
        known = [np.nan_to_num(columns[name], nan=0.0) for name in ("p99_ms", "recent_loss")]
        bad = 1 - np.nan_to_num(columns["recent_good"], nan=1.0)
        return np.lexsort((-known[0], -bad, -known[1], columns["state"]))

    def count(self, state: StreamState) -> int:
        """Streams in a state."""
        states: Ints = self.columns["state"]
        return int(np.count_nonzero(states == STATES.index(state)))


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
