"""How wrong a delay may be: U = receiver's clock + sender's clock + stamp's place (+ batching), all worst cases.

OWAMP prints its error estimate beside every delay; here too a delay is told as ``23.4 ms ± 0.3``. Where a part has no
bound (an undisciplined clock, a sender that says it does not know), the sum has none, and the parts say why. Only the
offset is uncertain then: IPDV, PDV, inter-arrival and jitter need no common clock.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from pmutools.c37118.batch import STAMP_SOURCES
from pmutools.c37118.constants import TimeQuality, time_quality_error_ns
from pmutools.flow import StampSource
from pmutools.measure.histogram import NS_PER_MS, ms
from pmutools.measure.quality import QualityCounts

LOCKED_NS = 1_000
"""What a locked sender that says no more is taken to be good for: C37.118.1's 1 % TVE is 31 µs, clocks do better."""
PMU_TQ_NS = (None, 100, 1_000, 10_000, 100_000, 1_000_000, 10_000_000, None)
"""Bounds of the PMU_TQ codes of STAT; 0 says nothing, 7 is worse or unknown."""
STAMP_NS = {
    StampSource.HARDWARE: 1_000,
    StampSource.KERNEL: 100_000,
    StampSource.KERNEL_BATCHED: 100_000,
    StampSource.USER: 1_000_000,
    StampSource.CAPTURE: 100_000,
}
"""How much later than the wire an arrival may be stamped: NIC; interrupt and kernel; and scheduling on top."""


@dataclass(frozen=True, slots=True)
class Part:
    """One contribution; ``bound_ns`` None: nobody knows. ``assumed``: no one said so, it is what is usual."""

    name: str
    bound_ns: int | None
    why: str
    assumed: bool = False


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """The parts and their sum."""

    parts: tuple[Part, ...]

    @property
    def bound_ns(self) -> int | None:
        """The sum; None where a part has no bound."""
        known = [part.bound_ns for part in self.parts if part.bound_ns is not None]
        return sum(known) if len(known) == len(self.parts) else None

    @property
    def reason(self) -> str | None:
        """Why there is no sum; None where there is one."""
        return "; ".join(f"{part.name}: {part.why}" for part in self.parts if part.bound_ns is None) or None

    def told(self, delay_ns: float) -> str:
        """A delay as it should be printed."""
        value = f"{delay_ns / NS_PER_MS:.4g} ms"
        if (bound := self.bound_ns) is None:
            return f"{value} ± unknown ({', '.join(part.name for part in self.parts if part.bound_ns is None)})"
        return f"{value} ± {bound / NS_PER_MS:.2g}"

    def to_json(self) -> dict[str, Any]:
        rows = [
            {"name": part.name, "bound_ms": ms(part.bound_ns), "why": part.why, "assumed": part.assumed}
            for part in self.parts
        ]
        return {"bound_ms": ms(self.bound_ns), "parts": rows}


def uncertainty(
    receiver_bound_ns: int | None, receiver_why: str, quality: QualityCounts, period_ns: float, *, locked: bool = False
) -> Uncertainty:
    """Of the delays of a stream. ``locked``: of its locked frames alone, whatever others said."""
    return Uncertainty(
        (
            Part("receiver clock", receiver_bound_ns, receiver_why),
            _sender([0] if locked else quality.tq_codes, 0 if locked else quality.worst_stat()[1]),
            *_stamps(quality, period_ns),
        )
    )


def _sender(codes: Iterable[int], pmu_tq: int) -> Part:
    """By the worst of what the frames say: MSG_TQ, and PMU_TQ where it is used."""
    worst = max(codes, default=int(TimeQuality.FAILED))
    if worst == TimeQuality.LOCKED and pmu_tq == 0:
        return Part("sender clock", LOCKED_NS, "locked (MSG_TQ 0); how well is not said", assumed=True)
    if worst and (bound := time_quality_error_ns(worst)) is None:
        return Part("sender clock", None, f"MSG_TQ {worst:X}: clock failed or undefined")
    bounds = [time_quality_error_ns(worst) or 0]
    if pmu_tq:
        if (bound := PMU_TQ_NS[pmu_tq]) is None:
            return Part("sender clock", None, "PMU_TQ 7: error above 10 ms or unknown")
        bounds.append(bound)
    return Part("sender clock", max(bounds), f"MSG_TQ {worst:X}, PMU_TQ {pmu_tq}")


def _stamps(quality: QualityCounts, period_ns: float) -> Iterable[Part]:
    sources = [STAMP_SOURCES[index] for index in quality.source]
    if not sources:
        yield Part("arrival stamp", None, "nobody saw the frames come")
        return
    worst = max(sources, key=STAMP_NS.__getitem__)
    yield Part("arrival stamp", STAMP_NS[worst], f"taken by {worst}", assumed=True)
    if share := quality.source_share(StampSource.KERNEL_BATCHED):
        why = f"{share:.1%} of the frames share one TCP read's stamp: an upper bound, a period late at most"
        yield Part("batching", round(period_ns), why, assumed=True)
