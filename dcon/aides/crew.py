"""The three loops together."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from dcon.aides.aide import ROUND_S, Aide
from dcon.aides.gps import GpsAide
from dcon.aides.line import PdciAide
from dcon.aides.order_gate import OrderGate
from dcon.aides.orders import GuiAide
from dcon.link.keys import read_keys
from dcon.settings import Settings

LEAVE_S = 2.0


def aides(settings: Settings, run_dir: Path) -> list[Aide]:
    """The three loops, not yet started. Raises SourceError where a place is taken."""
    made: list[Aide] = []
    try:
        made.append(GuiAide(_gate(settings, run_dir), run_dir))
        made.append(PdciAide(settings.line_input.url, run_dir))
        made.append(GpsAide(settings.platform, run_dir))
    except BaseException:
        for aide in made:
            aide.release()
        raise
    return made


def _gate(settings: Settings, run_dir: Path) -> OrderGate:
    operators = {} if settings.server.keys is None else read_keys(settings.server.keys)
    return OrderGate(operators, settings.server.window_s, run_dir, time.time_ns())


def work(loops: list[Aide], stopping: Callable[[], bool]) -> str:
    """Run the loops until ``stopping`` or until one fails; returns why, "" where none did."""
    for aide in loops:
        aide.start()
    while not stopping() and all(aide.is_alive() for aide in loops):
        time.sleep(ROUND_S)
    failure = "; ".join(f"the {aide.name} loop failed: {aide.failure}" for aide in loops if aide.failure)
    for aide in loops:
        aide.stop()
    for aide in loops:
        aide.join(LEAVE_S)
    return failure
