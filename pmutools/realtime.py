"""Making a process fit for a fixed rhythm, as far as the system lets it."""

from __future__ import annotations

import gc
from typing import NamedTuple

from pmutools import linux

FIFO_PRIORITY = 10
"""Ahead of every normal task, behind the kernel's own threads."""


class Shortfall(NamedTuple):
    """What could not be had, each in one line that says why and what would help; None where it was had."""

    slack: str | None
    """Wake-ups may come some 50 µs late."""
    memory: str | None
    """Memory may be paged out; usual without privilege, and rarely felt."""
    fifo: str | None
    """Other tasks may be run first; None too where it was not asked for."""


def go_realtime(*, fifo: bool, priority: int = FIFO_PRIORITY) -> Shortfall:
    """Leave no garbage to go over, little timer slack, memory locked; with ``fifo`` SCHED_FIFO at ``priority`` (1..99).

    Concerns this process, and this thread of it, until it ends. Call it once everything is loaded, and spin
    for microseconds only under SCHED_FIFO. Never raises.
    """
    gc.collect()
    gc.freeze()
    return Shortfall(linux.timer_slack(), linux.lock_memory(), linux.fifo(priority) if fifo else None)
