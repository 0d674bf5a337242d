"""Bundles: what one process encodes another decodes, and nothing else is taken for one."""

from __future__ import annotations

import string

from hypothesis import given
from hypothesis import strategies as st

from dcon.link.bundle import LARGEST, Bundle, Entry, Kind, decode, encode, joined, pieces, shares, unnumbered
from dcon.session.head import Head, head_of

INT64 = st.integers(-(2**63), 2**63 - 1)
ENTRY = st.builds(
    Entry, st.text(string.ascii_letters, max_size=20), st.text(max_size=30), st.binary(max_size=50), INT64, INT64
)
BUNDLE = st.builds(
    Bundle,
    st.sampled_from(list(Kind)),
    st.integers(0, 2**64 - 1),
    st.integers(0, 2**32 - 1),
    INT64,
    st.lists(ENTRY, max_size=5).map(tuple),
    st.integers(0, 2**64 - 1),
    st.booleans(),
)


@given(BUNDLE)
def test_round_trip(bundle: Bundle) -> None:
    assert decode(encode(bundle)) == bundle
    again = decode(unnumbered(encode(bundle)))
    assert again is not None and not again.is_numbered
    assert again._replace(sequence=bundle.sequence) == bundle


@given(BUNDLE, st.data())
def test_what_is_cut_or_longer_is_no_bundle(bundle: Bundle, data: st.DataObject) -> None:
    whole = encode(bundle)
    assert decode(whole[: data.draw(st.integers(0, len(whole) - 1))]) is None
    assert decode(whole + b"x") is None


@given(st.binary(max_size=200), st.booleans())
def test_garbage_raises_nothing(garbage: bytes, looks_right: bool) -> None:
    decode(b"DCL2" + garbage if looks_right else garbage)


@given(st.lists(ENTRY, max_size=30), st.integers(400, 1000))
def test_shares_are_all_of_a_tick_in_order(entries: list[Entry], largest: int) -> None:
    parts = list(shares(entries, largest))
    assert [entry for part in parts for entry in part] == entries
    assert all(len(encode(Bundle(Kind.TICK, 0, 0, 1, part))) <= largest for part in parts)


def test_an_entry_larger_than_a_bundle_is_seen_as_damage() -> None:
    large = Entry("PmuFrame", "N1", bytes(LARGEST), 1, 1)
    assert list(shares([large])) == [(large._replace(data=b"\xff"),)]


@given(st.binary(max_size=300), st.text(max_size=300), st.integers(80, 200))
def test_a_head_in_pieces(probe: bytes, ini: str, largest: int) -> None:
    head = Head(ini, ("N1",), ("N1-S1",), ("voltage", "frozen"), {"start_ns": "5"}, probe)
    assert head_of([bundle for data in head.pieces(3) if (bundle := decode(data))]) == head
    cut = [bundle for data in pieces(3, {}, {"a": probe}, largest) if (bundle := decode(data))]
    assert joined(cut) == ({}, {"a": probe})
    assert joined(cut[:-1]) is None and joined(cut[1:]) is None and joined(cut[::-1]) in (None, joined(cut))


def test_a_head_of_nonsense_is_none() -> None:
    for values in ({}, {"names": 1, "metadata": {}}, {"names": {"pmus": "["}, "metadata": {}}):
        assert head_of([bundle for data in pieces(1, values, {}) if (bundle := decode(data))]) is None
    huge = Bundle(Kind.HEAD, 0, 0, 0, (Entry("head", "values", b"", 0, 2**62),))
    assert head_of([huge]) is None
