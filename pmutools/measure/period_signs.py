"""Diagnoses of delays that have to do with the reporting period: the device's, most likely, and not the network's."""

from __future__ import annotations

from typing import NamedTuple

from pmutools.measure.scene import Peer, Row, Scene, ms_text
from pmutools.timebase import NS

APART = 1.5
"""Rates tell delays apart if the highest is so many times the lowest."""
OFF = 0.1
"""Of the delay: farther from the line, a rate refutes it."""
TWO_REST = 0.25
"""A line goes through any two points: with two rates it must be so nearly proportional, as a share of the least."""
ABOUT = 0.05
"""So near to a period, as a share, a delay is about one."""
STEADY = 0.2
"""Of a period: what makes a median that varies more is not the period."""
MOST_NS = 10 * NS
"""Beyond, it is a clock's error."""


class Growth(NamedTuple):
    """Delay = ``periods`` / Fs + ``rest_ns``, by least squares over the rates."""

    periods: float
    rest_ns: float

    def at(self, rate: float) -> float:
        return self.periods * NS / rate + self.rest_ns


def growth(peers: list[Peer]) -> Growth | None:
    """The line that the delays of all rates are on; None where there is none, or not of whole or half periods."""
    rates = [peer.rate for peer in peers]
    if len(peers) < 2 or max(rates) < APART * min(rates):
        return None
    periods = [NS / rate for rate in rates]
    x, y = sum(periods) / len(peers), sum(peer.middle_ns for peer in peers) / len(peers)
    across = sum((period - x) * (peer.middle_ns - y) for period, peer in zip(periods, peers, strict=True))
    slope = across / sum((period - x) ** 2 for period in periods)
    found = Growth(slope, y - slope * x)
    least = min(peer.middle_ns for peer in peers)
    if found.rest_ns < -OFF * least or (len(peers) == 2 and found.rest_ns > TWO_REST * least):
        return None
    if any(abs(peer.middle_ns - found.at(peer.rate)) > OFF * peer.middle_ns for peer in peers):
        return None
    halves = round(2 * slope)
    return found if 0.8 <= slope <= 1.2 or (halves >= 1 and abs(slope - halves / 2) <= 0.1) else None


def _peers(scene: Scene) -> list[Peer]:
    return [peer for peer in scene.others if peer.rate > 0 and 0 < peer.middle_ns < MOST_NS]


def _grows(scene: Scene) -> str | None:
    middle, period, peers = scene.middle_ns, scene.result.period_ns, _peers(scene)
    found = growth(peers)
    if found is None or middle is None or not period:
        return None
    if abs(middle - found.at(NS / period)) > OFF * middle:
        return None  # another's delay, not this one's
    told = ", ".join(f"{ms_text(peer.middle_ns)} at {peer.rate:g}/s" for peer in peers)
    few = "; two rates may do so by chance, a third would tell" if len(peers) == 2 else ""
    return (
        f"the delay grows with 1/Fs ({told}): {found.periods:.2f} periods and {ms_text(found.rest_ns)} that no rate "
        f"changes; devices that stamp, and then wait or fill a window before they send, are like that{few}"
    )


def _about_one(scene: Scene) -> str | None:
    middle, period = scene.middle_ns, scene.result.period_ns
    if middle is None or not period or not _is_about(middle, period):
        return None
    floor = scene.result.counts.delays.delay.min_ns or 0
    others = [peer for peer in _peers(scene) if abs(peer.rate * period / NS - 1) > 1e-6]
    if middle - floor > STEADY * period or others:
        return None  # other rates tell by themselves
    return (
        f"the delay, {ms_text(middle)}, is about one reporting period of {ms_text(period)}: may be a device that waits "
        "for its window before it sends, or chance; compare with another rate"
    )


def _is_about(middle_ns: float, period_ns: float) -> bool:
    return abs(middle_ns / period_ns - 1) <= ABOUT


ROWS: tuple[Row, ...] = (
    Row(
        "delay-of-a-period",
        "delay on a line over 1/Fs, within 10 % at every rate, of 0.8 to 1.2 or of whole or half periods; with two "
        "rates, nearly proportional",
        _grows,
    ),
)
NOTES: tuple[Row, ...] = (
    Row(
        "about-a-period",
        "delay within 5 % of one period, steady, and no other rate to compare with",
        _about_one,
        "note",
    ),
)
