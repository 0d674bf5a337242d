"""What was measured, as an impairment profile: ``pmu play`` then treats any recording as this network did.

Losses become a Gilbert model of the same ratio and mean burst, copies a chance.
"""

from __future__ import annotations

from collections.abc import Sequence

from pmutools.measure.fits import best_fit, histogram_text, typical
from pmutools.measure.stream import StreamResult


def profile_text(results: Sequence[StreamResult], *, exact: bool = False) -> str:
    """An INI profile with a section a stream. ``exact``: histograms in place of fitted distributions."""
    return "\n".join(["; as measured; delays in ms", *(line for result in results for line in _section(result, exact))])


def _section(result: StreamResult, exact: bool) -> list[str]:
    counts = result.counts
    lines = ["", f"[stream {result.identity.name}]"]
    delays, of = typical(counts.delays)
    if of == "pdv":
        lines.append("; above the floor: by the delays themselves a clock is wrong")
    if fit := best_fit(delays):
        lines.append(f"delay = {histogram_text(delays) if exact else fit.text}")
        lines.append(f"; {fit.name}, KS distance {fit.ks:.3f}, {fit.frames} frames" if not exact else "; as counted")
    if loss := loss_text(counts.slots.lost, counts.slots.expected, counts.losses.periods.mean):
        lines.append(f"loss = {loss}")
    if counts.slots.duplicated and counts.slots.received:
        lines.append(f"duplicate = {min(1.0, counts.slots.duplicated / counts.slots.received):.4%}")
    return lines


def loss_text(lost: int, expected: int, mean_burst: float | None) -> str | None:
    """The simple Gilbert model: r = 1/burst, p = L r/(1 - L); of single losses a plain chance; None without loss."""
    if not lost or not expected or lost >= expected or mean_burst is None:
        return None
    share = lost / expected
    if mean_burst <= 1 / (1 - share) * 1.02:  # what chance alone makes of runs
        return f"{share:.4%}"
    leave = 1 / mean_burst
    return f"gemodel({min(1.0, share * leave / (1 - share)):.4%}, {leave:.4%})"
