"""Outcomes that are kept for the documentation: what differs from them fails, or is written where that is asked for."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from support.outcomes import WRITES, Outcome, complete, keep, relays_of

MEASURED = {"0 V": "", "relays open after": "87 ms, of at most 120 ms"}
STOP = Outcome("a stop", "ESTOP", "tripped", ("estop", "watchdog"), (), MEASURED, "")


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "outcomes.json"
    path.write_text(json.dumps({"trials": {"stop": asdict(STOP), "other": asdict(STOP)}}))
    monkeypatch.delenv(WRITES, raising=False)
    return path


def test_what_is_measured_may_differ_and_the_order_of_events(kept: Path) -> None:
    before = kept.read_bytes()
    facts = {"0 V": "", "relays open after": "91 ms, of at most 120 ms"}
    keep("trials", "stop", replace(STOP, events=("watchdog", "estop"), facts=facts), kept)
    complete("trials", ("stop", "other"), kept)
    assert kept.read_bytes() == before


@pytest.mark.parametrize(
    "change",
    [
        {"what": "another stop"},
        {"state": "FAULT"},
        {"relays": "open"},
        {"events": ("estop",)},
        {"restarts": ("server",)},
        {"facts": {"0 V": ""}},
        {"facts": {"1 V": "", "relays open after": "87 ms, of at most 120 ms"}},
        {"facts": {"0 V": "", "relays open after": "3 ms, of at most 4 ms"}},
        {"paper": "Fig. 1"},
    ],
)
def test_anything_else_fails_and_says_what_to_do(change: dict[str, object], kept: Path) -> None:
    with pytest.raises(AssertionError, match="make trials"):
        keep("trials", "stop", replace(STOP, **change), kept)  # type: ignore[arg-type]


def test_a_row_or_table_that_is_not_there_fails(kept: Path) -> None:
    for table, name in (("trials", "new"), ("paper", "stop")):
        with pytest.raises(AssertionError, match="make trials"):
            keep(table, name, STOP, kept)
    for names in (("stop",), ("other", "stop"), ("stop", "other", "new")):
        with pytest.raises(AssertionError, match="make trials"):
            complete("trials", names, kept)


def test_writing_puts_a_row_in_its_place_and_leaves_the_others(kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(WRITES, "write")
    keep("trials", "new", replace(STOP, state="FAULT"), kept)
    complete("trials", ("new", "stop"), kept)
    keep("paper", "loss", STOP, kept)
    monkeypatch.delenv(WRITES)
    complete("trials", ("new", "stop"), kept)
    keep("trials", "new", replace(STOP, state="FAULT"), kept)
    keep("trials", "stop", STOP, kept)
    keep("paper", "loss", STOP, kept)


@pytest.mark.parametrize(
    ("events", "relays"),
    [
        ((), "closed"),
        (("warning",), "closed"),
        (("open",), "open"),
        (("start",), "open"),
        (("open", "trip"), "tripped"),
    ],
)
def test_relays_are_read_off_the_watchdogs_events(events: tuple[str, ...], relays: str) -> None:
    assert relays_of(events) == relays
