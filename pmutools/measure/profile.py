"""What was measured, as an impairment profile: ``pmu play`` then treats any recording as this network did.

Delays become a distribution with the measured correlation of successive frames, and keep their order where no frame
overtook another; losses a Gilbert model of the same ratio and mean burst; copies a chance. Delays are counted from the
stamp, so the player must send by the stamp too (``--timing stamp``): with recorded latencies they would come twice.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from pmutools.measure.binned import histogram_text
from pmutools.measure.fits import Fit, best_fit, typical
from pmutools.measure.stream import StreamResult

LEAST_CORRELATION = 0.05
"""Less is told as none."""
MOST_CORRELATION = 0.99
_HEAD = "; as measured; delays in ms from the stamp: play with --timing stamp"
_PLAIN = re.compile(r"[^\W_][\w .+-]*")


def profile_text(results: Sequence[StreamResult], *, exact: bool = False) -> str:
    """An INI profile with a section a stream. ``exact``: histograms in place of fitted distributions."""
    return "\n".join([_HEAD, *(line for result in results for line in _section(result, exact))])


def _section(result: StreamResult, exact: bool) -> list[str]:
    counts = result.counts
    if not counts.slots.received:
        return []
    lines = ["", f"[stream {', '.join(_patterns(result))}]"]
    delays, of = typical(counts.delays)
    if of == "pdv":
        lines.append("; above the floor: by the delays themselves a clock is wrong")
    if fit := best_fit(delays):
        lines.append(f"delay = {histogram_text(delays) if exact else fit.text}{_manner(result)}")
        lines.append(f"; {_why(fit, exact)}, {fit.frames} frames")
    lost, own = counts.slots.lost, counts.own_lost
    if own:
        lines.append(f"; {own} of the {lost} lost frames may be own drops of the measuring host: left out of the loss")
    burst = counts.losses.periods.mean
    if loss := loss_text(lost - own, counts.slots.expected - own, burst and min(burst, lost - own)):
        lines.append(f"loss = {loss}")
    if counts.slots.duplicated:
        lines.append(f"duplicate = {min(1.0, counts.slots.duplicated / counts.slots.received):.4%}")
    return lines


def _why(fit: Fit, exact: bool) -> str:
    """What the delays are told by, and what is wrong with the nearest family where it is the histogram."""
    if exact or not fit.nearest:
        return "as counted" if exact or fit.name == "histogram" else f"{fit.name}, KS distance {fit.ks:.3f}"
    return f"as counted: {fit.nearest.text} is the nearest, and {fit.nearest.fault}"


def _patterns(result: StreamResult) -> list[str]:
    """What a player calls the stream: as it was called here, as its only station, or by its IDCODE."""
    identity, stations = result.identity, result.config.stations
    names = [identity.name, *(station.name for station in stations if len(stations) == 1)]
    return [name for name in dict.fromkeys(names) if _PLAIN.fullmatch(name)] or [str(identity.idcode)]


def _manner(result: StreamResult) -> str:
    """How successive delays depend on each other."""
    delays, told = result.counts.delays, ""
    correlation = delays.correlation or 0.0
    if correlation >= LEAST_CORRELATION:
        told += f" corr={min(correlation, MOST_CORRELATION):.1%}"
    return told if result.counts.order.reordered else f"{told} order=keep"


def loss_text(lost: int, expected: int, mean_burst: float | None) -> str | None:
    """The simple Gilbert model: r = 1/burst, p = L r/(1 - L); of single losses a plain chance; None without loss."""
    if not lost or not expected or lost >= expected or mean_burst is None:
        return None
    share = lost / expected
    if mean_burst <= 1 / (1 - share) * 1.02:  # what chance alone makes of runs
        return f"{share:.4%}"
    leave = 1 / mean_burst
    return f"gemodel({min(1.0, share * leave / (1 - share)):.4%}, {leave:.4%})"
