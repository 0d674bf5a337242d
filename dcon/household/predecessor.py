"""The places in a run folder that an earlier ``dcon run`` may have left to processes that are still ending."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from dcon.link import paths
from pmutools.errors import SourceError

LOG = logging.getLogger(__name__)
PLACES_S = 10.0
"""For an earlier run's processes to end: where that was killed, the kernel has told them to."""
LOOK_S = 0.1
"""From one look to the next."""


def await_places(
    ears: Iterable[Path],
    places: Sequence[tuple[Path, int]],
    stopping: Callable[[], bool],
    pause: Callable[[float], object],
) -> None:
    """Return when all ``places`` (sockets, and their kinds) are free, or once ``stopping``; ``pause`` takes seconds.

    Where an ear of a run is held, that run lives, and nobody waits. Raises SourceError where one stays taken.
    """
    end_s = time.monotonic() + (0.0 if any(map(paths.is_held, ears)) else PLACES_S)
    is_told = False
    while not stopping():
        held = [path for path, kind in places if paths.is_held(path, kind)]
        if not held:
            return
        told = f"{held[0]}: another process that is running has it"
        if time.monotonic() >= end_s:
            raise SourceError(f"{told}; end that, or take another run folder")
        if not is_told:
            LOG.warning("%s; waiting for its end, %g s at most", told, PLACES_S)
            is_told = True
        pause(LOOK_S)
