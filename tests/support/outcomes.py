"""What trials of a running controller see, kept for the documentation's tables.

``make trials`` writes ``docs/generate/outcomes.json``; every other run of the same tests holds what it sees to that.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

KEPT = Path(__file__).parents[2] / "docs" / "generate" / "outcomes.json"
WRITES = "DCON_TRIALS"
"""The variable of the environment that asks for writing."""
MEASURED = "facts"
BOUND = re.compile(r"at most [\d.,]+ \w+")
"""In what was measured: the bound that every run has to keep."""
"""The one part whose values differ from run to run; its names do not."""


class Fact(NamedTuple):
    """Something that is seen, in words that stand in the table where it was."""

    words: str
    holds: Callable[..., str | None]
    """Fails where it does not; what was measured, if anything, in words."""


@dataclass(frozen=True)
class Outcome:
    """A row: what was done, and what became of it."""

    what: str
    state: str
    """Of the controller, at the end."""
    relays: str
    """``closed`` all along, ``open`` because the controller asked for it, ``tripped`` until an operator resets."""
    events: tuple[str, ...]
    """In the session log, each once."""
    restarts: tuple[str, ...] = ()
    """Processes that were started again."""
    facts: dict[str, str] = field(default_factory=dict)
    """What else was seen, in words, each with what was measured."""
    paper: str = ""
    """Where the paper has it."""

    def settled(self) -> dict[str, Any]:
        """What every run must see alike."""
        return {
            **asdict(self),
            "events": sorted(self.events),
            "restarts": sorted(self.restarts),
            MEASURED: {fact: BOUND.findall(measured) for fact, measured in self.facts.items()},
        }


def relays_of(events: Iterable[str]) -> str:
    """What became of the relays, by the watchdog's own events."""
    found = set(events)
    return "tripped" if "trip" in found else "open" if found & {"open", "start"} else "closed"


def keep(table: str, name: str, seen: Outcome, kept: Path = KEPT) -> None:
    """Write a row where that is asked for, else hold it to what is written."""
    tables = _tables(kept)
    rows = tables.setdefault(table, {})
    if os.environ.get(WRITES) == "write":
        rows[name] = asdict(seen)
        _write(kept, tables)
        return
    assert name in rows, f"{kept.name} has no {name}: make trials writes it"
    written = Outcome(**rows[name]).settled()
    assert seen.settled() == written, (
        f"{name}: the documentation says otherwise; if this is right, make trials writes it"
    )


def complete(table: str, names: Iterable[str], kept: Path = KEPT) -> None:
    """The table has these rows and no others, in this order."""
    tables, wanted = _tables(kept), list(names)
    rows = tables.get(table, {})
    if os.environ.get(WRITES) == "write":
        tables[table] = {name: rows[name] for name in wanted if name in rows}
        _write(kept, tables)
        return
    assert list(rows) == wanted, "make trials writes it anew"


def _tables(kept: Path) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else {}
    return found


def _write(kept: Path, tables: dict[str, dict[str, Any]]) -> None:
    kept.write_text(json.dumps(tables, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
