"""What the recorder must know when it is started again: kept in the run folder, replaced whole after every flush.

It is written after the log and before the acknowledgement, so that a kill at any instant leaves one of two things:
entries in the log that the file does not speak of, which are cut off and sent again; or nothing amiss.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import NamedTuple

from dcon.link.assembly import Place

FILE = "server.state"


class State(NamedTuple):
    session: int
    """Number that the control process drew."""
    key: str
    """What the parts of the log have in common."""
    path: str
    """Of the first part."""
    have: int
    """Last sequence that is in the log, or counted as missing there."""
    parts: tuple[str, ...] = ()
    """Paths."""
    size: int | None = None
    """Bytes of the last part that hold what is spoken of; None where it is ended."""
    configs: tuple[tuple[str, str, int], ...] = ()
    """PMU, configuration frame in hexadecimal, when it came."""
    ticks: int = 0
    """Of the session, up to ``have``."""
    unlogged: int = 0
    """Of those, the ones that are missing in the log."""
    untold: int = 0
    """Of these, the ones of which the log does not say so yet."""
    reason: str = ""
    """Why."""
    earlier: tuple[tuple[int, int], ...] = ()
    """Numbers of earlier sessions that lack ticks, and how many."""

    @property
    def place(self) -> Place:
        """From where the session goes on."""
        return Place(self.session, self.have, self.ticks)


def load(folder: Path) -> State | None:
    """None where there is none, or it is damaged."""
    try:
        values = json.loads((folder / FILE).read_bytes())
        state = State(**values)
        configs = tuple((str(name), bytes.fromhex(frame).hex(), int(at)) for name, frame, at in state.configs)
        earlier = tuple((session, ticks) for session, ticks in state.earlier)
        counts = (
            *(number for pair in earlier for number in pair),
            state.unlogged,
            state.untold,
            0 if state.size is None else state.size,
        )
        numbers = (state.session, state.have, state.ticks, *counts)
        texts = (state.key, state.path, state.reason)
        if not (all(type(number) is int for number in numbers) and all(isinstance(text, str) for text in texts)):
            return None
        return state._replace(parts=tuple(map(str, state.parts)), configs=configs, earlier=earlier)
    except (OSError, ValueError, TypeError):
        return None


def save(folder: Path, state: State) -> bool:
    """Whether it could be."""
    fresh = folder / f"{FILE}.new"
    try:
        fresh.write_text(json.dumps(state._asdict()))
        os.replace(fresh, folder / FILE)
    except OSError:
        return False
    return True
