"""The numbers that the watchdog judges by: what they are unless set, and how far they may be set."""

from __future__ import annotations

from typing import Final, NamedTuple

TICK_MS: Final = 10.0
"""The loop comes round at least so often."""
FULL_SCALE_V: Final = 10.0
"""±10 V are ±125 MW."""
MW_PER_V: Final = 12.5
WINDOW_MS: Final = 1000.0
"""Over which the advance of a counter is judged; for which a malformed datagram or a wrong sequence is held against
the sender."""
PERIOD_MS: Final = 20.0
"""Status, and 0 V while the relays are open, leave so often."""
REMEMBERED: Final = 64
"""Forwarded commands that a readback may answer: 64 are a second of them."""


class Limits(NamedTuple):
    """A rule is up above its limit. What each is for: ``[watchdog]`` in :mod:`dcon.settings`, which sets them."""

    fast_timeout_ms: float = 100.0
    slow_timeout_ms: float = 2000.0
    server_timeout_ms: float = 2000.0
    control_rate_max_hz: float = 120.0
    front_rate_max_hz: float = 1000.0
    slow_rate_max_hz: float = 200.0
    command_timeout_ms: float = 100.0
    malformed_max: float = 0.0
    range_max_v: float = FULL_SCALE_V
    mismatch_max_mw: float = 0.5
    stamp_max_ms: float = 100.0
    unasked_max_v: float = 0.0
    readback_max_percent: float = 2.0
    readback_count: float = 3.0
    readback_timeout_ms: float = 200.0
    estop_discrepancy_ms: float = 50.0
    contact_timeout_ms: float = 100.0
    late_max_ms: float = 50.0
    close_max_v: float = 0.1


BOUNDS: Final[dict[str, tuple[float, float]]] = {
    "fast_timeout_ms": (20, 1000),
    "slow_timeout_ms": (100, 60_000),
    "server_timeout_ms": (100, 60_000),
    "control_rate_max_hz": (1, 1e4),
    "front_rate_max_hz": (1, 1e6),
    "slow_rate_max_hz": (1, 1e6),
    "command_timeout_ms": (20, 1000),
    "malformed_max": (0, 1e6),
    "range_max_v": (0, FULL_SCALE_V),
    "mismatch_max_mw": (1e-6, 10),
    "stamp_max_ms": (10, 1000),
    "unasked_max_v": (0, 1),
    "readback_max_percent": (0.01, 20),
    "readback_count": (1, 60),
    "readback_timeout_ms": (20, 10_000),
    "estop_discrepancy_ms": (10, 1000),
    "contact_timeout_ms": (10, 1000),
    "late_max_ms": (10, 1000),
    "close_max_v": (0, 1),
}
"""Least and most of each limit."""


def refusal(name: str, value: float) -> str:
    """Why a limit cannot have that value; "" where it can."""
    if name not in BOUNDS:
        return f"{name}: no such limit; there are {', '.join(BOUNDS)}"
    low, high = BOUNDS[name]
    return "" if low <= value <= high else f"{name}: {value:g} is out of range; it must be {low:g} to {high:g}"


class Rules(NamedTuple):
    """What one watchdog judges by."""

    limits: Limits = Limits()
    beats: tuple[str, ...] = ("control", "udp", "parse", "gps", "gui", "pdci")
    """Loops whose beats must come; others are judged from their first beat on."""
    readback_required: bool = False
    """A readback must come; otherwise it is judged from the first on."""
