"""What was done to a running controller, and what became of it: as its tests saw it (``make trials`` writes that)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from generate.markdown import code, table

EXAMPLES = Path(__file__).parents[1] / "systemd"
OUTCOMES = Path(__file__).with_name("outcomes.json")
RELAYS = {"closed": "stay closed", "open": "open", "tripped": "open, latched"}
Row = Mapping[str, Any]


def outcomes(name: str) -> list[Row]:
    """The rows of a table, in the order in which it was done."""
    return list(json.loads(OUTCOMES.read_text(encoding="utf-8"))[name].values())


def events(row: Row) -> str:
    """By name; those of single streams with whom they concern."""
    subjects = dict[str, list[str]]()
    for event in row["events"]:
        name, _, subject = event.partition(" ")
        subjects.setdefault(name, []).append(subject)
    return ", ".join(" ".join((code(name), *of)).rstrip() for name, of in subjects.items())


def facts(row: Row) -> str:
    """What was seen, with what was measured."""
    again = [f"{name} started again" for name in row["restarts"]]
    seen = [f"{words} ({measured})" if measured else words for words, measured in row["facts"].items()]
    return "; ".join(again + seen)


def trials() -> str:
    """Every trial and its outcome."""
    rows = ((row["what"], row["state"], RELAYS[row["relays"]], events(row), facts(row)) for row in outcomes("trials"))
    return table(("what happens", "controller", "relays", "events", "besides"), rows)


def paper_cases() -> str:
    """The paper's cases over sockets, and what was seen of each."""
    rows = (
        (row["paper"], row["what"], row["state"], RELAYS[row["relays"]], events(row), facts(row))
        for row in outcomes("paper")
    )
    return table(("in the paper", "what happens", "controller", "relays", "events", "what is seen"), rows)


def example(name: str, language: str) -> str:
    """A file of ``docs/systemd``, whole."""
    return f"```{language}\n{(EXAMPLES / name).read_text(encoding='utf-8').strip()}\n```"


GENERATORS = {
    "trials": trials,
    "paper-cases": paper_cases,
    "systemd-unit": lambda: example("dcon.service", "ini"),
    "site-ini": lambda: example("site.ini", "ini"),
}
