"""Numbers, times and names as a report tells them."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmutools.measure.diagnoses import ROWS
from pmutools.report.remedies import REMEDIES
from pmutools.report.text import clean, count, labels, lasting, listed, milliseconds, percent, plural, span, utc
from pmutools.timebase import NS


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (0.0, "0.00"),
        (-0.0001, "0.00"),
        (-3.456, "−3.46"),
        (41.234, "41.23"),
        (99.996, "100.0"),
        (1234.56, "1,234.6"),
        (413_856_123.0, "413,856,123"),
        (None, "–"),
        (math.inf, "∞"),
    ],
)
def test_milliseconds(value: float | None, told: str) -> None:
    assert milliseconds(value) == told


@pytest.mark.parametrize(
    ("share", "told"),
    [
        (0, "0 %"),
        (1, "100 %"),
        (0.5, "50.0 %"),
        (0.00056, "0.056 %"),
        (1e-9, "<0.0001 %"),
        (0.9996, "99.96 %"),
        (0.99999, "99.999 %"),
        (1 - 1e-9, ">99.9999 %"),
        (None, "–"),
    ],
)
def test_percent(share: float | None, told: str) -> None:
    assert percent(share) == told


@given(st.floats(0, 1, exclude_min=True, exclude_max=True))
def test_what_is_not_all_never_reads_so(share: float) -> None:
    assert percent(share) not in ("0 %", "100 %") and "e" not in percent(share)


def test_times() -> None:
    assert [span(s * NS) for s in (0.1, 59.94, 60, 3600, 7380, 90_000)] == [
        "0.1 s",
        "59.9 s",
        "1 min",
        "1 h",
        "2 h 3 min",
        "1 d 1 h",
    ]
    assert lasting(413_856_123) == "4 d 18 h" and lasting(-37_000) == "−37 s" and lasting(50) == "50.00 ms"
    assert utc(1_473_354_311_016_667_000, 3) == "2016-09-08 17:05:11.016 UTC"
    assert utc(10**21) == "1000000000000 s of POSIX time" and utc(None) == "–"


def test_words() -> None:
    assert (
        count(-1234.4) == "−1,234" and plural(1, "stream") == "1 stream" and plural(1200, "stream") == "1,200 streams"
    )
    assert listed(["a"]) == "a" and listed(["a", "b", "c"]) == "a, b and c"
    assert listed("abcdefgh", 3) == "a, b, c and 5 others"


@given(st.lists(st.text(max_size=60), max_size=12))
def test_labels_are_short_and_unlike(names: list[str]) -> None:
    found = labels(names)
    assert len(found) == len(names) == len(set(found))
    assert all(label.isprintable() and 0 < len(label) <= 28 for label in found)


@given(st.text())
def test_clean_text_prints(text: str) -> None:
    assert clean(text).isprintable() and len(clean(text)) == len(text)


def test_remedies_are_of_findings_that_there_are() -> None:
    assert REMEDIES.keys() <= {row.id for row in ROWS}
