"""When ticks fall, and orders given beforehand."""

from __future__ import annotations

from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcon.cli.ctl import LOOKS, VERBS
from dcon.control.orders import OrderBook, TimedOrder, parse_order
from dcon.control.schedule import TickGrid
from dcon.core.system import ORDERS
from dcon.core.values import Order
from pmutools.errors import SettingsError

NS = 1_000_000_000
DAY = 86_400

grids = st.builds(TickGrid, st.sampled_from((30, 50, 60, 120)), st.integers(0, NS))
times = st.integers(0, 4_000_000_000 * NS)


@given(grids, times)
def test_the_next_tick_is_the_first_one_later(grid: TickGrid, time_ns: int) -> None:
    index = grid.after(time_ns)
    assert grid.time_ns(index - 1) <= time_ns < grid.time_ns(index)


@given(grids, st.integers(0, 4_000_000_000), st.integers(0, 119))
def test_ticks_are_exact_and_never_drift(grid: TickGrid, second: int, within: int) -> None:
    """Tick k is at k/rate of UTC plus the phase, to the nanosecond, however many went before."""
    index = second * grid.rate_hz + within % grid.rate_hz
    exact = Fraction(index, grid.rate_hz) * NS + grid.phase_ns
    assert abs(grid.time_ns(index) - exact) <= Fraction(1, 2)
    if within % grid.rate_hz == 0:
        assert grid.time_ns(index) == second * NS + grid.phase_ns


def test_the_papers_16_666_and_16_667_without_its_20_ppm() -> None:
    grid = TickGrid(60, 0)
    steps = [grid.time_ns(k + 1) - grid.time_ns(k) for k in range(60)]
    assert set(steps) == {16_666_666, 16_666_667}
    assert sum(steps) == NS
    assert grid.time_ns(60 * DAY) == DAY * NS


@pytest.mark.parametrize(
    ("text", "order"),
    [
        ("30:arm", TimedOrder(30 * NS, Order("arm"))),
        ("0.5:closed_loop", TimedOrder(NS // 2, Order("closed_loop"))),
        ("40:gain=12", TimedOrder(40 * NS, Order("gain", 12.0))),
        ("-1:estop", TimedOrder(-NS, Order("estop"))),
    ],
)
def test_an_order(text: str, order: TimedOrder) -> None:
    assert parse_order(text) == order


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("arm", "--order arm: write SECONDS:NAME or SECONDS:NAME=VALUE, as in 30:arm or 40:gain=12"),
        ("x:arm", "write SECONDS:NAME"),
        ("nan:arm", "write SECONDS:NAME"),
        ("inf:arm", "write SECONDS:NAME"),
        ("1:gain=x", "write SECONDS:NAME"),
        ("1:gain=nan", "write SECONDS:NAME"),
        ("1:gain=inf", "write SECONDS:NAME"),
        ("1:gain=1_0", "write SECONDS:NAME"),
        ("1_0:arm", "write SECONDS:NAME"),
        ("1e300:arm", "write SECONDS:NAME"),
        ("1:amr", "--order 1:amr: 'amr' is no order; did you mean 'arm'?"),
        ("1:", "'' is no order; known: start, off, arm"),
        ("1:gain", "--order 1:gain: no value; write 1:gain=MW_PER_MHZ"),
        ("1:arm=3", "--order 1:arm=3: arm takes no value"),
    ],
)
def test_an_order_that_is_none_is_one_line(text: str, said: str) -> None:
    with pytest.raises(SettingsError, match=r"^[^\n]*$") as caught:
        parse_order(text)
    assert said in str(caught.value)


def test_an_operator_can_give_every_order_there_is() -> None:
    assert sorted({*VERBS} - {*LOOKS}) == sorted(map(str, ORDERS))


def test_orders_are_handed_out_once_in_time_and_in_the_order_given() -> None:
    book = OrderBook([parse_order(text) for text in ("2:activate", "1:arm", "1:gain=9", "3:disarm")], 100 * NS)
    assert book.due(101 * NS - 1) == ()
    assert book.due(101 * NS) == (Order("arm"), Order("gain", 9.0))
    assert book.due(101 * NS) == ()
    assert book.due(200 * NS) == (Order("activate"), Order("disarm"))
    assert book.due(300 * NS) == ()
