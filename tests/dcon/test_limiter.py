from __future__ import annotations

import ast
import math
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcon import limiter
from dcon.limiter import LIMIT_MW, MW_PER_V, SLEW_MW_PER_S, Limited, limit, volts

TICK = 1 / 60
ANYTHING = st.one_of(
    st.none(),
    st.booleans(),
    st.floats(),
    st.integers(),
    st.text(),
    st.complex_numbers(),
    st.binary(),
    st.lists(st.none()),
)


@pytest.mark.parametrize("wanted", [math.nan, math.inf, -math.inf, None, "12", True, 1j, 10**400, [5.0]])
def test_what_is_no_finite_number_is_zero_at_once(wanted: object) -> None:
    assert limit(wanted, 100.0, TICK) == Limited(0.0, "invalid")
    assert volts(wanted) == 0.0


class Failing(float):
    def __float__(self) -> float:
        raise RuntimeError("no")


class Lying(int):
    def __float__(self) -> float:
        return "1"  # type: ignore[return-value]


class Faceless:
    @property
    def __class__(self) -> type:  # type: ignore[override]
        raise KeyError("no")


@pytest.mark.parametrize("make", [lambda: Failing(5.0), lambda: Lying(5), Faceless], ids=["float", "int", "object"])
def test_an_object_that_fails_is_zero_wherever_it_stands(make: Callable[[], object]) -> None:
    bad = make()
    usual: list[object] = [10.0, 10.0, TICK, 125.0]
    for place in range(4):
        assert limit(*usual[:place], bad, *usual[place + 1 :]) == Limited(0.0, "invalid")
    assert volts(bad) == 0.0


@pytest.mark.parametrize("dt", [0.0, -1.0, math.nan, math.inf, None])
def test_without_a_time_step_there_is_no_command(dt: object) -> None:
    assert limit(1.0, 1.0, dt).mw == 0.0


def test_no_previous_or_no_limit_is_zero() -> None:
    assert limit(1.0, math.nan, TICK).mw == 0.0
    assert limit(1.0, 1.0, TICK, math.nan).mw == 0.0
    assert limit(1.0, 1.0, TICK, -5.0).mw == 0.0


@pytest.mark.parametrize("sign", [1, -1])
def test_boundaries(sign: int) -> None:
    step = SLEW_MW_PER_S * TICK
    assert limit(sign * 125.0, sign * 124.0, TICK) == Limited(sign * 125.0, "")
    assert limit(sign * math.nextafter(125.0, 126), sign * 124.0, TICK) == Limited(sign * 125.0, "limit")
    assert limit(sign * step, 0.0, TICK) == Limited(sign * step, "")
    assert limit(sign * (step + 0.01), 0.0, TICK) == Limited(sign * step, "slew")
    assert limit(sign * 50.0, sign * 49.0, TICK, 10.0).mw == pytest.approx(sign * 10.0)
    assert volts(sign * 125.0) == sign * 10.0
    assert volts(sign * 1e6) == sign * 10.0


def test_a_larger_limit_is_not_granted() -> None:
    assert limit(500.0, 124.9, TICK, 1000.0).mw == LIMIT_MW


def test_a_long_silence_earns_no_large_step() -> None:
    assert limit(-125.0, 125.0, 3600.0).mw == pytest.approx(125.0 - SLEW_MW_PER_S * 0.1)


@given(ANYTHING, ANYTHING, ANYTHING, ANYTHING)
def test_any_input_gives_a_finite_command_inside_the_limit(a: object, b: object, c: object, d: object) -> None:
    mw, reason = limit(a, b, c, d)
    assert isinstance(mw, float) and abs(mw) <= LIMIT_MW and reason in ("", "invalid", "limit", "slew")
    assert abs(volts(a)) <= LIMIT_MW / MW_PER_V


@given(st.floats(-125, 125), st.floats(allow_nan=False, allow_infinity=False), st.floats(1e-4, 0.1))
def test_no_step_beyond_the_slew(previous: float, wanted: float, dt: float) -> None:
    mw, _ = limit(wanted, previous, dt)
    assert abs(mw - previous) <= SLEW_MW_PER_S * dt * (1 + 1e-12) + 1e-12


def test_it_imports_nothing_of_ours() -> None:
    tree = ast.parse(Path(limiter.__file__).read_text())
    modules = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    modules |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    assert modules == {"__future__", "math", "typing"}
