"""Text to typed values."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmutools.parsers import (
    Call,
    Parser,
    bind,
    boolean,
    call,
    choice,
    duration_ns,
    indices,
    integer,
    milliseconds_ns,
    number,
    one_of,
    parse_place,
    parsed_by,
    probability,
    seconds_ns,
    size_bytes,
    span_ns,
    split_top,
    words,
)


@pytest.mark.parametrize(
    ("parse", "text", "value"),
    [
        (number(), "-2.5e3", -2500.0),
        (integer(), " 12 ", 12),
        (integer(0, 0xFFFF), "0xAA01", 0xAA01),
        (probability, "5%", 0.05),
        (probability, "0.05", 0.05),
        (probability, "100 %", 1.0),
        (boolean, "Yes", True),
        (boolean, "off", False),
        (choice("free", "keep"), "KEEP", "keep"),
        (seconds_ns, "5.000000001", 5_000_000_001),
        (milliseconds_ns, "16.6666665", 16_666_666),
        (words, "a, b,c(d, e)", ("a", "b", "c(d, e)")),
        (words, " ", ()),
    ],
)
def test_values(parse: Parser[Any], text: str, value: object) -> None:
    assert parse(text) == value


@pytest.mark.parametrize(
    ("parse", "text", "message"),
    [
        (number(0, 15), "20", "20 is out of range; it must be 0 to 15"),
        (number(0), "-1", "-1 is out of range; it must be at least 0"),
        (integer(high=7), "8", "8 is out of range; it must be at most 7"),
        (number(), "nan", "'nan' is not a finite number"),
        (number(), "1,5", "'1,5' is not a number"),
        (integer(), "1.5", "'1.5' is not a whole number"),
        (probability, "5", "5 is not a probability; did you mean 5%?"),
        (probability, "105%", "105% is not a probability; write 0% to 100%"),
        (probability, "often", "'often' is not a probability; write 5% or 0.05"),
        (boolean, "2", "'2' is neither yes nor no"),
        (choice("free", "keep"), "lost", "'lost' is not one of free, keep"),
        (seconds_ns, "5s", "'5s' is not a number"),
        (seconds_ns, "-1", "-1 is out of range; it must be at least 0"),
        (seconds_ns, "inf", "'inf' is not a finite number"),
        (words, "a,,b", "'a,,b' has an empty item; remove the extra ','"),
        (words, "a(b", "'a(b' has a '(' without ')'"),
        (words, "a)b(", "'a)b(' has a ')' without '('"),
        (indices, "10,59-50", "'59-50' runs backwards; write the smaller index first"),
        (indices, "every 0", "'every 0' has no period; write every 1 or more"),
        (indices, "10,x", "'x' is not an index, a range like 50-59, or 'every 100 offset 3'"),
        (call, "normal(16", "'normal(16' is not of the form name(value, ...)"),
        (call, "f(a=1, 2)", "f: '2' stands after a named value; put it before"),
        (call, "f(a=1, A=2)", "f: A is given twice"),
    ],
)
def test_errors(parse: Parser[Any], text: str, message: str) -> None:
    with pytest.raises(ValueError) as error:
        parse(text)
    assert str(error.value) == message


def test_calls_are_taken_apart_at_the_top_level() -> None:
    assert call("Normal( 16, sd=2 )") == Call("normal", ("16",), {"sd": "2"})
    assert call("mixture(90% normal(16,2), 10% f(x=1))") == Call("mixture", ("90% normal(16,2)", "10% f(x=1)"), {})
    assert call("chk") == call("chk()") == Call("chk")
    assert split_top("a(b+c) + d", "+") == ["a(b+c)", "d"]


@dataclass(frozen=True)
class Two:
    mean: float = field(metadata=parsed_by(number()))
    sd: float = field(default=1.0, metadata=parsed_by(number(0)))


@dataclass(frozen=True)
class Many:
    values: tuple[int, ...] = field(metadata=parsed_by(integer(), rest=True))


def test_bind() -> None:
    assert bind(Two, call("two(3)")) == Two(3.0)
    assert bind(Two, call("two(sd=2, mean=3)")) == Two(3.0, 2.0)
    assert bind(Many, call("many(1, 2, 3)")) == Many((1, 2, 3))
    assert one_of({"two": Two, "many": Many}, "thing")("many(4)") == Many((4,))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("two(1, 2, 3)", "3 arguments are too many; write two(mean, sd)"),
        ("two(sd=2)", "mean is missing; write two(mean, sd)"),
        ("two(1, mean=2)", "mean is given twice; write two(mean, sd)"),
        ("two(1, sigma=2)", "two has no 'sigma'; known: mean, sd"),
        ("two(1, -2)", "two sd: -2 is out of range; it must be at least 0"),
        ("many()", "values is missing; write many(values)"),
        ("many(1, x)", "many values: 'x' is not a whole number"),
        ("too(1)", "'too' is no thing; did you mean 'two'?"),
    ],
)
def test_bind_errors(text: str, message: str) -> None:
    with pytest.raises(ValueError) as error:
        one_of({"two": Two, "many": Many}, "thing")(text)
    assert str(error.value) == message


RANGE = st.tuples(st.integers(0, 300), st.integers(0, 40)).map(lambda pair: (pair[0], pair[0] + pair[1]))
EVERY = st.tuples(st.integers(1, 50), st.integers(0, 200))


@given(st.lists(st.integers(0, 400)), st.lists(RANGE), st.lists(EVERY), st.none() | st.integers(0, 400))
def test_a_list_is_the_union_of_its_items(
    singles: list[int], ranges: list[tuple[int, int]], every: list[tuple[int, int]], tail: int | None
) -> None:
    items = [str(index) for index in singles] + [f"{first} - {last}" for first, last in ranges]
    items += [f"every {period} offset {offset}" for period, offset in every]
    items += [] if tail is None else [f"{tail}-"]
    chosen = indices(",".join(items))
    expected = set(singles).union(*(range(first, last + 1) for first, last in ranges))
    expected.update(*(range(offset, 500, period) for period, offset in every))
    expected.update(() if tail is None else range(tail, 500))
    assert {index for index in range(500) if index in chosen} == {index for index in expected if index < 500}


@pytest.mark.parametrize(
    "parse",
    [number(), integer(), probability, duration_ns(10**9), span_ns, size_bytes, indices, parse_place],
    ids=lambda parse: parse.__qualname__,
)
@pytest.mark.parametrize("text", ["१२", "१२%", "१२s", "१२MB", "every १२", "1-२", "２０16-09-08T17:05:11Z"])
def test_digits_are_ascii(parse: Parser[Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        parse(text)
