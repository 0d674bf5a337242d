"""Tables of the documentation that exist as tables in code: one function each, called when the site is built."""

from __future__ import annotations

from collections.abc import Callable

from generate import (
    api,
    commands,
    controller,
    impairments,
    live,
    matrix,
    measures,
    player,
    streams,
    structure,
    studies,
    trials,
    watchdog,
)

GENERATORS: dict[str, Callable[[], str]] = {
    **structure.GENERATORS,
    **streams.GENERATORS,
    **impairments.GENERATORS,
    **player.GENERATORS,
    **live.GENERATORS,
    **controller.GENERATORS,
    **watchdog.GENERATORS,
    **matrix.GENERATORS,
    **measures.GENERATORS,
    **studies.GENERATORS,
    **trials.GENERATORS,
    **commands.GENERATORS,
    **api.GENERATORS,
}
"""Markdown by the name that a marker gives."""
