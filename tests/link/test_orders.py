"""Signed orders: what the right key signs in time is taken once; anything else is refused, and says why."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from dcon.core.system import LINK_REFUSED, ORDERS
from dcon.core.values import Order
from dcon.link.keys import add_key, load_sequences, read_keys, save_sequences
from dcon.link.orders import (
    LONGEST,
    MOST_STOPS,
    REPLAYED,
    WORDS,
    Operator,
    RefusalLog,
    Refused,
    SignedOrder,
    Verifier,
    digest,
    read,
    sign,
)
from pmutools.errors import SettingsError, SourceError

NOW = 1_700_000_000_000_000_000
KEY, OTHER = b"k" * 32, b"o" * 32
OPERATORS = {
    "Ada": Operator("Ada", KEY),
    "Ben": Operator("Ben", OTHER, frozenset(("arm", "estop"))),
}
WORD = st.text(max_size=40).filter(str.isprintable)
ORDER = st.builds(
    SignedOrder,
    st.just("Ada"),
    st.integers(0, NOW + 5 * 10**9),
    st.integers(NOW - 5 * 10**9, NOW + 5 * 10**9),
    st.sampled_from([str(name) for name in ORDERS]),
    st.floats(allow_nan=False, allow_infinity=False),
    WORD,
    WORD,
)


def order(**changes: object) -> SignedOrder:
    return SignedOrder("Ada", NOW, NOW, "arm", 0.0, "", "test")._replace(**changes)


def verified(signed: bytes, **changes: object) -> SignedOrder | Refused:
    return Verifier(OPERATORS, **changes).verify(signed, NOW)  # type: ignore[arg-type]


@given(ORDER)
def test_what_is_signed_in_time_is_taken_exactly_and_once(given_: SignedOrder) -> None:
    judge, signed = Verifier(OPERATORS), sign(given_, KEY)
    assert judge.verify(signed, NOW) == given_ == read(signed)
    assert judge.verify(signed, NOW) == Refused(REPLAYED, "Ada")
    assert given_.order == Order(given_.name, given_.value, given_.text, "Ada", given_.why)


@given(ORDER, st.data())
def test_any_flipped_bit_is_refused(given_: SignedOrder, data: st.DataObject) -> None:
    signed = bytearray(sign(given_, KEY))
    bit = data.draw(st.integers(0, 8 * len(signed) - 1))
    signed[bit // 8] ^= 1 << bit % 8
    assert isinstance(verified(bytes(signed)), Refused)


@given(ORDER, st.data())
def test_any_changed_field_is_refused(given_: SignedOrder, data: st.DataObject) -> None:
    said = json.loads(sign(given_, KEY))
    other = json.loads(sign(data.draw(ORDER), KEY))
    changed = [name for name in SignedOrder._fields if said[name] != other[name]]
    assume(changed)
    name = data.draw(st.sampled_from(changed))
    said[name] = other[name]
    forged = json.dumps(said, sort_keys=True, separators=(",", ":")).encode()
    assert verified(forged) == Refused("the signature does not hold", "Ada")


@given(st.binary(max_size=300))
def test_garbage_is_refused(garbage: bytes) -> None:
    assert isinstance(verified(garbage), Refused)


def spaced(signed: bytes) -> bytes:
    return json.dumps(json.loads(signed)).encode()


def doubled(signed: bytes) -> bytes:
    return signed.replace(b'{"mac"', b'{"mac":"","mac"')


@pytest.mark.parametrize(
    ("signed", "reason"),
    [
        (sign(order(), OTHER), "the signature does not hold"),
        (sign(order(who="Eve"), KEY), "unknown operator"),
        (sign(order(who="Ben"), KEY), "the signature does not hold"),
        (sign(order(who="Ben", name="gain"), OTHER), "not allowed to this operator"),
        (sign(order(time_ns=NOW - 5 * 10**9 - 1), KEY), "too old: is the operator's clock right?"),
        (sign(order(time_ns=NOW + 5 * 10**9 + 1), KEY), "from the future: is the operator's clock right?"),
        (spaced(sign(order(), KEY)), "no signed order"),
        (doubled(sign(order(), KEY)), "no signed order"),
        (b"[]", "no signed order"),
        (b"{}", "no signed order"),
        (b"[" * LONGEST, "no signed order"),
        (b"x" * (LONGEST + 1), f"longer than {LONGEST} bytes"),
        (sign(order(), KEY).replace(b'"arm"', b'"fly"'), "no such order"),
        (sign(order(), KEY).replace(b'"value":0.0', b'"value":NaN'), "no signed order"),
        (sign(order(), KEY).replace(b'"value":0.0', b'"value":true'), "value must be a finite number"),
        (sign(order(), KEY).replace(b'"why":"test"', b'"why":5'), f"why must be at most {WORDS} characters that print"),
    ],
)
def test_refusals(signed: bytes, reason: str) -> None:
    found = verified(signed)
    assert isinstance(found, Refused) and found.reason == reason


def test_no_sequence_locks_its_operator_out() -> None:
    judge = Verifier(OPERATORS)
    ahead = "its sequence is above the time and the window"
    for sequence in (NOW + 5 * 10**9 + 1, 2**63 - 1):
        assert judge.verify(sign(order(sequence=sequence), KEY), NOW) == Refused(ahead, "Ada")
    assert isinstance(judge.verify(sign(order(sequence=NOW + 5 * 10**9), KEY), NOW), SignedOrder)


def test_an_emergency_stop_needs_no_new_sequence_but_its_time_and_counts_once() -> None:
    judge = Verifier(OPERATORS, last={"Ada": 2**62}, floor_ns=NOW + 1)
    stop, other = (sign(order(name="estop", why=why), KEY) for why in ("smoke", "fire"))
    assert isinstance(judge.verify(sign(order(), KEY), NOW), Refused)
    assert isinstance(judge.verify(stop, NOW), SignedOrder) and isinstance(judge.verify(other, NOW), SignedOrder)
    assert judge.last == {"Ada": 2**62}
    assert judge.verify(stop, NOW) == judge.verify(stop, NOW + 5 * 10**9) == Refused(REPLAYED, "Ada")
    assert judge.verify(stop, NOW + 5 * 10**9 + 1) == Refused("too old: is the operator's clock right?", "Ada")
    assert judge.verify(sign(order(name="estop"), OTHER), NOW) == Refused("the signature does not hold", "Ada")


@given(st.lists(st.tuples(st.integers(0, 20), st.integers(0, 6)), max_size=40))
def test_whatever_comes_in_between_no_emergency_stop_counts_twice(sent: list[tuple[int, int]]) -> None:
    """(which, seconds since the one before), each signed for a second of its own."""
    judge, now_ns, taken = Verifier(OPERATORS), NOW, Counter[int]()
    for which, seconds in sent:
        now_ns += seconds * 10**9
        stop = sign(order(name="estop", time_ns=NOW + which * 10**9), KEY)
        found = judge.verify(stop, now_ns)
        is_timely = abs(NOW + which * 10**9 - now_ns) <= 5 * 10**9
        assert isinstance(found, SignedOrder) == (is_timely and not taken[which])
        taken[which] += isinstance(found, SignedOrder)


def test_how_many_stops_are_remembered_is_bounded() -> None:
    judge = Verifier(OPERATORS)
    for number in range(MOST_STOPS + 10):
        assert isinstance(judge.verify(sign(order(name="estop", sequence=number), KEY), NOW), SignedOrder)
    assert len(judge._stops) == MOST_STOPS


def test_a_refused_order_does_not_use_up_a_sequence() -> None:
    judge = Verifier(OPERATORS)
    assert isinstance(judge.verify(sign(order(sequence=2**62), OTHER), NOW), Refused)
    assert isinstance(judge.verify(sign(order(sequence=5), KEY), NOW), SignedOrder)
    assert isinstance(judge.verify(sign(order(sequence=4), KEY), NOW), Refused)
    assert isinstance(judge.verify(sign(order(sequence=6), KEY), NOW), SignedOrder)
    assert isinstance(judge.verify(sign(order(who="Ben", sequence=1), OTHER), NOW), SignedOrder)


def test_what_is_remembered_of_an_earlier_life() -> None:
    assert isinstance(verified(sign(order(sequence=7), KEY), last={"Ada": 7}), Refused)
    assert isinstance(verified(sign(order(sequence=8), KEY), last={"Ada": 7}), SignedOrder)
    assert isinstance(verified(sign(order(time_ns=NOW), KEY), floor_ns=NOW), Refused)
    assert isinstance(verified(sign(order(time_ns=NOW + 1), KEY), floor_ns=NOW), SignedOrder)


@pytest.mark.parametrize(
    "bad", [order(name="fly"), order(value=float("nan")), order(who="a\nb"), order(why="x" * 201), order(sequence=-1)]
)
def test_what_nobody_would_take_is_not_signed(bad: SignedOrder) -> None:
    with pytest.raises(ValueError, match=r"must be|no such"):
        sign(bad, KEY)


def test_a_flood_of_refusals_is_ten_inputs_a_second_and_a_count() -> None:
    log, signed = RefusalLog(), b"forged"
    taken = [log.order(Refused("no", "Eve"), signed, NOW + number * 10**6) for number in range(1500)]
    inputs = [given for given in taken if given is not None]
    assert len(inputs) == 20
    assert inputs[0] == Order(LINK_REFUSED, text="no", who="Eve", why=digest(signed))
    assert inputs[10].text == "no; and 990 more were refused"


def test_keys_are_made_read_and_kept_from_others(tmp_path: Path) -> None:
    path = tmp_path / "operators.ini"
    add_key(path, "Ada")
    add_key(path, "Ben B.", ("arm", "estop"))
    assert path.stat().st_mode & 0o777 == 0o600
    keys = read_keys(path)
    assert [keys["Ada"].may, keys["Ben B."].may] == [None, {"arm", "estop"}]
    assert len({operator.key for operator in keys.values()}) == 2 and all(len(o.key) == 32 for o in keys.values())
    signed = sign(order(), keys["Ada"].key)
    assert Verifier(keys).verify(signed, NOW) == order()
    with pytest.raises(SettingsError, match="has an operator 'Ada' already"):
        add_key(path, "Ada")
    with pytest.raises(SettingsError, match="no order"):
        add_key(path, "Cyd", ("fly",))
    for name in ("", "a]b", " a", "a\n"):
        with pytest.raises(SettingsError, match="is no name of an operator"):
            add_key(path, name)
    path.chmod(0o640)
    with pytest.raises(SourceError, match=r"others may read or write these keys; chmod 600"):
        read_keys(path)


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("", "no \\[operator NAME\\]; dcon keys adds one"),
        ("[operator A]\nmay = all\n", "key is missing"),
        ("[operator A]\nkey = 00ff\n", "must be at least 32 hexadecimal digits"),
        ("[operator A]\nkey = " + "zz" * 32 + "\n", "must be at least 32 hexadecimal digits"),
        ("[operator A]\nkey = " + "ab" * 32 + "\nmay = fly\n", "'fly' is no order"),
        ("[other]\n", "unknown section"),
    ],
)
def test_mistakes_in_a_key_file_name_the_line_and_no_key(text: str, wrong: str, tmp_path: Path) -> None:
    path = tmp_path / "keys"
    path.write_text(text)
    path.chmod(0o600)
    with pytest.raises(SettingsError, match=wrong) as raised:
        read_keys(path)
    assert "zz" not in str(raised.value) and "abab" not in str(raised.value)


@pytest.mark.parametrize("content", [None, b"", b"[]", b'{"Ada": "x"}', b'{"Ada": 1', b"\xff"])
def test_a_sequence_file_that_is_missing_or_damaged_is_known_as_such(content: bytes | None, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "operators.seq").write_bytes(content)
    assert load_sequences(tmp_path) is None
    assert save_sequences(tmp_path, {"Ada": 2**62}) and load_sequences(tmp_path) == {"Ada": 2**62}
    assert not save_sequences(tmp_path / "nowhere", {})
