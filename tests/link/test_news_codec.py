"""News to the control process: what is written is read, and nothing else is."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcon.core.values import Order, Pdci
from dcon.link.beats import LoopName
from dcon.link.counts import COUNTS
from dcon.link.failure import Failure
from dcon.link.news import GpsLock, LoopCounts, News, ServerWord, decode, encode

NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
WHOLE = st.integers(0, (1 << 63) - 1)
TEXTS = st.text(st.characters(codec="utf-8"), max_size=20)
NEWS = st.one_of(
    st.builds(GpsLock, st.floats(0, 1e9), TEXTS, TEXTS),
    st.builds(Pdci, WHOLE, NUMBERS, st.booleans(), st.booleans(), NUMBERS),
    st.builds(Order, TEXTS, NUMBERS, TEXTS, TEXTS, TEXTS),
    st.builds(ServerWord, *3 * [st.none() | NUMBERS]),
    st.builds(LoopCounts, st.sampled_from(LoopName), st.dictionaries(st.sampled_from(sorted(COUNTS)), WHOLE)),
    st.builds(Failure, TEXTS, st.booleans()),
)


@given(NEWS)
def test_what_is_written_is_read(news: News) -> None:
    assert decode(encode(news)) == news


def test_a_schedule_that_is_not_known_crosses() -> None:
    read = decode(encode(Pdci(5, 2000.0, True, True, math.nan)))
    assert isinstance(read, Pdci) and math.isnan(read.scheduled_mw) and read[:4] == (5, 2000.0, True, True)


@pytest.mark.parametrize("news", [GpsLock(math.nan), Pdci(5, math.inf), ServerWord(math.nan), Order("gain", math.inf)])
def test_what_no_log_takes_is_not_written(news: News) -> None:
    with pytest.raises(ValueError, match="JSON compliant"):
        encode(news)


@pytest.mark.parametrize(
    "said",
    [
        {"kind": "gps", "age_s": -1.0},
        {"kind": "gps", "age_s": True},
        {"kind": "gps", "age_s": 0.0, "source": 5},
        {"kind": "gps", "age_s": math.nan},
        {"kind": "pdci", "time_ns": 1.5, "power_mw": 1.0, "in_service": True, "dcon_enabled": True},
        {"kind": "pdci", "time_ns": 1 << 63, "power_mw": 1.0, "in_service": True, "dcon_enabled": True},
        {"kind": "order", "name": "\ud800"},
        {"kind": "order", "name": None},
        {"kind": "counts", "loop": "nobody", "counts": {}},
        {"kind": "counts", "loop": "gps", "counts": {"untold": -1}},
        {"kind": "failed", "reason": "x"},
        {"kind": "else"},
        {},
        [],
        None,
    ],
)
def test_what_makes_no_sense_is_nothing(said: object) -> None:
    assert decode(json.dumps(said).encode()) is None
