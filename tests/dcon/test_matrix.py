"""The paper's cases at default settings: checks that must fire do, and no other but those that may."""

from __future__ import annotations

import sys
from functools import cache
from pathlib import Path

import pytest

from dcon.core.rows import CORE
from dcon.core.thresholds import Thresholds
from dcon.settings import parse
from dcon.sim.plan import Plan
from dcon.sim.simulate import Outcome, settings_of, simulate
from pmutools.grid.pmu_model import fleet

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))
from generate.matrix import CASES, START_S, STARTING

NAMES = frozenset(CORE.names)


@cache
def outcome(case: str) -> Outcome:
    return simulate(Plan(**CASES[case].plan))


def fired(case: str) -> set[str]:
    """Checks that rose, but for those that say that the first frames are still to come."""
    rose = {(event.name, at_s >= START_S) for at_s, event in outcome(case).events if event.name in NAMES}
    return {name for name, begun in rose if begun or name not in STARTING}


@pytest.mark.parametrize("case", CASES)
def test_what_must_fire_does_and_nothing_else_but_what_may(case: str) -> None:
    expected = CASES[case]
    assert set(expected.must) <= fired(case) <= {*expected.must, *expected.may}
    assert outcome(case).final_state == expected.ends
    assert any(event.name == "active" for _, event in outcome(case).events)


def test_the_controller_is_at_its_defaults() -> None:
    for case in CASES.values():
        settings = settings_of(Plan(**case.plan), fleet())
        assert settings.params.thresholds == Thresholds() and "[supervisor]" not in settings.text
        assert parse(settings.text, "again").params == settings.params


def test_the_table_names_checks_that_there_are() -> None:
    for case in CASES.values():
        assert {*case.must, *case.may} <= NAMES
        assert not set(case.must) & set(case.may)
