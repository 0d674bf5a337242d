"""What is counted: every count has a name and a text, and somebody who counts it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path

import pytest
from support.virtual_platform import stream, virtual_platform

from dcon.aides.aide import Aide
from dcon.aides.line import PdciAide
from dcon.aides.order_gate import OrderGate
from dcon.aides.orders import GuiAide
from dcon.control import loop
from dcon.control.heard import Heard, counted
from dcon.link import paths
from dcon.link.counts import COUNTS, USUAL, FrontCounts, total, words

FRONT = {item.name for item in fields(FrontCounts)}


def names_of_the_aides(folder: Path) -> set[str]:
    names = set[str]()
    aides: list[Aide] = [GuiAide(OrderGate({}, 5.0, folder, 0), folder), PdciAide(None, folder)]
    for aide in aides:
        names |= aide.counts().keys()
        aide.release()
    return names


def names_of_control(path: Path, monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Of what the loop itself adds."""
    names = set[str]()

    def seen(*counts: Mapping[str, int]) -> dict[str, int]:
        names.update(*counts)
        return total(*counts)

    monkeypatch.setattr(loop, "total", seen)
    virtual_platform(path, stream(0.5), monkeypatch).run(0.5, orders=())
    return names


def test_every_count_is_counted_by_somebody_under_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = paths.prepare(tmp_path / "run")
    found = names_of_the_aides(folder) | names_of_control(tmp_path / "x.mcap", monkeypatch)
    assert found | FRONT | {"news_ignored"} == COUNTS.keys()
    assert counted(Heard(0, ignored=3))["news_ignored"] == 3
    assert COUNTS.keys() > USUAL and all(COUNTS.values())


def test_counts_of_several_are_added_up_and_those_that_are_0_are_not_said() -> None:
    counts = total({"foreign": 2, "repeated": 5}, {"foreign": 1, "of_tomorrow": 7})
    assert counts.keys() == COUNTS.keys() and counts["foreign"] == 3
    assert words(counts) == "foreign 3" and words({}) == ""
