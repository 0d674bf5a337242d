"""What a tick is told, as a function of news and time: at the edges, and whatever comes."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from dcon.control.heard import GPS_NS, SERVER_NS, Heard, counted, hear, is_healthy, is_there, surroundings, watchdog_of
from dcon.core.values import Order, Pdci, Surroundings
from dcon.link.beats import UNHEARD, Readback, WatchdogState, encode_readback
from dcon.link.counts import COUNTS
from dcon.session.codec import Watchdog, encode_counts, encode_order, encode_pdci, encode_surroundings
from dcon.watchdog.codec import encode_status
from pmutools.errors import SettingsError, SourceError

T0 = 10**12
STATUS_NS = 100_000_000
MS, S = 10**6, 10**9


def told(*news: tuple[int, bytes | dict[str, Any]], at: int, sent: int = 0) -> Surroundings:
    return surroundings(heard(*news), at, sent)


def heard(*news: tuple[int, bytes | dict[str, Any]]) -> Heard:
    now = Heard(T0)
    for at, said in news:
        now = hear(now, said if isinstance(said, bytes) else json.dumps(said).encode(), at).heard
    return now


def status(at: int, *, healthy: bool = True, estop: int = 7, state: int = 0, relays: int = 0, causes: int = 0) -> bytes:
    return encode_status(1, at, relays, estop, state, healthy, causes)


def test_at_the_start_nothing_is_known_and_the_watchdog_is_not_healthy() -> None:
    assert told(at=T0) == Surroundings(watchdog_healthy=False, server_age_s=0.0)


@pytest.mark.parametrize(("after_ns", "healthy"), [(0, True), (STATUS_NS, True), (STATUS_NS + 1, False)])
def test_a_watchdog_is_healthy_for_100_ms_after_its_word(after_ns: int, healthy: bool) -> None:
    assert told((T0, status(T0)), at=T0 + after_ns).watchdog_healthy is healthy


@pytest.mark.parametrize(
    ("state", "ages_ms", "there"),
    [
        (WatchdogState.OPEN, (), True),
        (WatchdogState.TRIPPED, (), False),
        (WatchdogState.TRIPPED, (0, 20, 20, 100, 100, 249), True),
        (WatchdogState.TRIPPED, (0, 20, 20, 100, 100, 250), False),
        (WatchdogState.TRIPPED, (0, 20, 20, 100, 100, UNHEARD), False),
        (WatchdogState.TRIPPED, (0, 2000, 20, 100, 100, 100), False),
    ],
)
def test_the_first_tick_waits_for_all_that_may_not_start(
    state: WatchdogState, ages_ms: tuple[int, ...], there: bool
) -> None:
    """A latched trip is no reason to begin before it is known that ports and places can be had."""
    ages = (*ages_ms, *[UNHEARD] * (8 - len(ages_ms)))
    news = heard((T0, encode_status(1, T0, 0, 7, state, state is WatchdogState.OPEN, 0, ages)))
    assert is_there(news, T0 + MS) is there


@pytest.mark.parametrize(
    ("said", "healthy", "released"),
    [
        ({}, True, True),
        ({"healthy": False}, False, True),
        ({"state": WatchdogState.CLOSED}, True, True),
        ({"state": WatchdogState.TRIPPED}, False, True),
        *(({"estop": 7 & ~(1 << bit), "healthy": False}, False, False) for bit in range(3)),
    ],
)
def test_what_the_watchdog_says(said: dict[str, Any], healthy: bool, released: bool) -> None:
    now = told((T0, status(T0, **said)), at=T0 + MS)
    assert (now.watchdog_healthy, now.estop_released) == (healthy, released)


def test_the_newest_word_counts_and_a_pressed_stop_stays_known_when_the_watchdog_dies() -> None:
    now = told((T0, status(T0)), (T0, status(T0 + MS, estop=0, healthy=False)), at=T0 + 3600 * S)
    assert (now.watchdog_healthy, now.estop_released) == (False, False)


@pytest.mark.parametrize(
    ("after_ns", "age_s"), [(0, 0.5), (GPS_NS, 0.5), (GPS_NS + 1, 3.500000001), (10 * S, 10.5), (3600 * S, 3600.5)]
)
def test_a_lock_that_nobody_speaks_of_grows_old(after_ns: int, age_s: float) -> None:
    now = told((T0, {"kind": "gps", "age_s": 0.5, "source": "chrony", "detail": ""}), at=T0 + after_ns)
    assert now.gps_age_s == pytest.approx(age_s, abs=1e-9)


@pytest.mark.parametrize(("stamp_ns", "counts"), [(-1, False), (0, True), (1, True)])
def test_a_readback_counts_where_it_was_taken_after_the_last_command(stamp_ns: int, counts: bool) -> None:
    answer = encode_readback(Readback(4_000_000_000, T0 + stamp_ns, -3.25))
    assert told((T0, answer), at=T0 + MS, sent=T0).readback_v == (-3.25 if counts else None)


def test_the_line_s_status_is_handed_on_with_its_own_time() -> None:
    said = {"kind": "pdci", "time_ns": 7, "power_mw": -1500, "in_service": True, "dcon_enabled": False}
    assert told((T0, {**said, "scheduled_mw": 1400.5}), at=T0).pdci == Pdci(7, -1500.0, True, False, 1400.5)
    unknown = told((T0, {**said, "scheduled_mw": None}), at=T0).pdci
    assert unknown is not None and math.isnan(unknown.scheduled_mw)
    assert told((T0, {**said, "in_service": 1}), at=T0).pdci == unknown._replace(in_service=False)


SERVER: dict[str, Any] = {"kind": "server", "disk_free_percent": 40.0, "response_gain": 0.9, "response_lag_ms": 20}


@pytest.mark.parametrize(("after_ns", "known"), [(0, True), (SERVER_NS, True), (SERVER_NS + 1, False)])
def test_the_server_s_findings_are_told_for_three_seconds_and_its_silence_for_ever(after_ns: int, known: bool) -> None:
    now = told((T0, SERVER), at=T0 + after_ns)
    assert now.server_age_s == after_ns / S
    found = (now.disk_free_percent, now.response_gain, now.response_lag_ms)
    assert found == ((40.0, 0.9, 20.0) if known else (None, None, None))


def test_a_server_that_never_spoke_is_silent_since_the_start() -> None:
    assert told(at=T0 + 5 * S).server_age_s == 5.0


def test_an_order_is_handed_on_once_with_who_ordered_it() -> None:
    said = {"kind": "order", "name": "gain", "value": 12.5, "text": "", "who": "ann", "why": "test"}
    after, order = hear(Heard(T0), json.dumps(said).encode(), T0)
    assert order == Order("gain", 12.5, "", "ann", "test")
    assert hear(after, status(T0), T0).order is None
    refused = hear(after, json.dumps({"kind": "order", "name": "link_refused", "text": "bad mac"}).encode(), T0).order
    assert refused == Order("link_refused", 0.0, "bad mac", "")


def test_the_watchdog_s_state_as_the_log_has_it() -> None:
    assert watchdog_of(heard(), 5, T0) is None
    tripped = status(T0, estop=6, healthy=False, state=WatchdogState.TRIPPED, relays=1, causes=1 | 1 << 17)
    assert watchdog_of(heard((T0, tripped)), 5, T0) == Watchdog(5, False, True, True, "control estop_software")
    closed = status(T0, state=WatchdogState.CLOSED, relays=3)
    assert watchdog_of(heard((T0, closed)), 5, T0 + STATUS_NS) == Watchdog(5, True)
    assert watchdog_of(heard((T0, closed)), 5, T0 + STATUS_NS + 1) == Watchdog(5, True, silent=True)


@pytest.mark.parametrize(("relays", "closed"), [(0, False), (1, False), (2, False), (3, True)])
def test_the_relays_are_as_the_watchdog_says_as_long_as_it_speaks(relays: int, closed: bool) -> None:
    said = (T0, status(T0, relays=relays))
    assert told(said, at=T0 + STATUS_NS).relays_closed is closed
    assert told(said, at=T0 + STATUS_NS + 1).relays_closed is None


LINE = {"kind": "pdci", "power_mw": 0, "in_service": True, "dcon_enabled": True}
BAD = [
    *(
        json.dumps({**LINE, "time_ns": time_ns}).encode()
        for time_ns in (1 << 63, -1, -(1 << 80), 1e18, "7", True, None)
    ),
    *(json.dumps({"kind": "order", "name": "arm", word: "\ud800"}).encode() for word in ("name", "text", "who", "why")),
    encode_readback(Readback(1, T0, math.nan)),
    json.dumps({"kind": "gps", "age_s": -1.0}).encode(),
    *(
        json.dumps({"kind": "counts", **said}).encode()
        for said in (
            {"loop": "gui"},
            {"loop": "nobody", "counts": {}},
            {"loop": "gui", "counts": {"untold": -1}},
            {"loop": "gui", "counts": {"untold": True}},
            {"loop": "gui", "counts": {"untold": 1 << 63}},
            {"loop": "gui", "counts": [1]},
        )
    ),
    json.dumps({"kind": "failed", "reason": "\ud800", "is_mistake": True}).encode(),
    json.dumps({"kind": "failed", "reason": "why"}).encode(),
    b'{"kind":"order","name":"gain","value":1' + 400 * b"0" + b"}",
    b"",
    b"{}",
    b"[]",
    b"null",
    b'"gps"',
    b"\xff\xfe",
    b'{"kind":"gps"}',
    b'{"kind":"gps","age_s":NaN}',
    b'{"kind":"gps","age_s":true}',
    b'{"kind":"gps","age_s":"0"}',
    b'{"kind":"pdci","time_ns":"x","power_mw":0}',
    b'{"kind":"order","name":5}',
    b'{"kind":"order","name":"gain","value":"12"}',
    b'{"kind":["gps"]}',
    b'{"kind":"nothing"}',
    b"[" * 100_000,
    b"DCW1" + bytes(24),
    status(T0)[:-1],
    status(T0, state=9),
]


@pytest.mark.parametrize("datagram", BAD)
def test_what_makes_no_sense_is_counted_and_changes_nothing(datagram: bytes) -> None:
    before = heard((T0, status(T0)), (T0, SERVER))
    after, order = hear(before, datagram, T0)
    assert after == before._replace(ignored=1) and order is None


def test_counts_are_the_newest_of_each_loop_added_up() -> None:
    def said(loop: str, **counts: int) -> tuple[int, dict[str, Any]]:
        return T0, {"kind": "counts", "loop": loop, "counts": counts}

    now = heard((T0, b""), said("gui", untold=7), said("gui", untold=1, orders_lost=3, what=9), said("pdci", untold=2))
    assert counted(now) == {**dict.fromkeys(COUNTS, 0), "news_ignored": 1, "untold": 3, "orders_lost": 3}
    encode_counts(T0, counted(now))


def test_the_aides_say_why_they_have_ended() -> None:
    now = heard((T0, {"kind": "failed", "reason": "keys.ini:2: key: too short", "is_mistake": True}))
    assert now.failed is not None and isinstance(now.failed.error, SettingsError)
    assert str(now.failed.error) == "keys.ini:2: key: too short"
    other = heard((T0, {"kind": "failed", "reason": "a port", "is_mistake": False})).failed
    assert other is not None and isinstance(other.error, SourceError)


VALUES = st.integers() | st.floats() | st.text() | st.booleans() | st.none() | st.sampled_from([1 << 63, (1 << 63) - 1])
KEYS = ("time_ns", "power_mw", "scheduled_mw", "in_service", "dcon_enabled", "age_s", "name", "value", "text", "who")
SAID = st.builds(
    lambda kind, said: {"kind": kind, **said},
    st.sampled_from(["gps", "pdci", "order", "server"]),
    st.fixed_dictionaries({}, optional=dict.fromkeys((*KEYS, *SERVER), VALUES)),
)


@given(SAID)
@example({**LINE, "time_ns": (1 << 63) - 1})
def test_whatever_is_taken_in_can_be_logged(said: dict[str, Any]) -> None:
    now, order = hear(Heard(T0), json.dumps(said).encode(), T0)
    around = surroundings(now, T0 + S, 0)
    encode_surroundings(T0, around)
    if around.pdci is not None:
        encode_pdci(T0, around.pdci)
    if order is not None:
        encode_order(T0, order)


@given(
    st.binary(max_size=200)
    | st.recursive(st.none() | st.floats() | st.text(), st.lists).map(json.dumps).map(str.encode)
)
def test_nothing_that_comes_raises(datagram: bytes) -> None:
    now, _ = hear(Heard(T0), datagram, T0)
    surroundings(now, T0, 0)
    assert not is_healthy(now, T0)
