"""Two summaries side by side: what became better or worse from one run to the next."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from pmutools.measure.require import METRICS

COMPARED = {
    "loss": 1,
    "availability": -1,
    "completeness": -1,
    "duplicates": 1,
    "reordered": 1,
    "late": 1,
    "corrupt": 1,
    "conflicting": 1,
    "stale": 1,
    "own_drops": 1,
    "longest_loss": 1,
    "empty_windows": 1,
    "delay_min": 0,
    "delay_p50": 1,
    "delay_p99": 1,
    "delay_p99_9": 1,
    "delay_max": 1,
    "pdv_p99": 1,
    "interarrival_max": 1,
    "jitter": 1,
    "uncertainty": 1,
    "expected": 0,
}
"""Metrics by name; 1: more is worse, -1: more is better, 0: neither."""
_NOISE = {"ms": 0.05, "s": 1.0, "share": 1e-4, "count": 0.0}
"""Differences up to this, or up to 5 %, are told as the same."""
_SAME = 0.05


class Difference(NamedTuple):
    """One metric of one stream, None where a run has no figure.

    ``verdict`` is same, better, worse, changed, new or gone.
    """

    stream: str
    metric: str
    unit: str
    before: float | None
    after: float | None
    verdict: str

    @property
    def change(self) -> float | None:
        return None if self.before is None or self.after is None else self.after - self.before


def compare(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[Difference]:
    """Rows of two ``summary.json``, stream by stream (by name), then all together. A missing stream is one row."""
    old, new = ({stream["name"]: stream for stream in summary["streams"]} for summary in (before, after))
    rows = []
    for name in [*old, *(name for name in new if name not in old)]:
        if name not in new or name not in old:
            one = float((old if name in old else new)[name]["received"])
            gone = name not in new
            rows.append(
                Difference(
                    name, "received", "count", one if gone else None, None if gone else one, "gone" if gone else "new"
                )
            )
            continue
        rows += _differences(name, old[name], new[name])
    return rows + list(_differences("all", before["all"], after["all"]))


def _differences(name: str, before: Mapping[str, Any], after: Mapping[str, Any]) -> Iterator[Difference]:
    for metric, worse in COMPARED.items():
        read, unit = METRICS[metric].read, METRICS[metric].unit
        one, other = read(before), read(after)
        if one is None and other is None:
            continue
        yield Difference(name, metric, unit, one, other, _verdict(one, other, unit, worse))
    kept = {diagnosis["id"] for diagnosis in before.get("diagnoses", ())}
    found = {diagnosis["id"] for diagnosis in after.get("diagnoses", ())}
    for each in sorted(kept ^ found):
        gone = each in kept
        yield Difference(name, f"diagnosis {each}", "", float(gone), float(not gone), "gone" if gone else "new")


def _verdict(before: float | None, after: float | None, unit: str, worse: int) -> str:
    if before is None or after is None:
        return "new" if before is None else "gone"
    change = after - before
    if abs(change) <= max(_NOISE[unit], _SAME * abs(before)):
        return "same"
    return "changed" if not worse else "worse" if change * worse > 0 else "better"
