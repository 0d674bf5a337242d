"""Whole ticks from bundles: however they are cut, repeated and lost, the same ticks come out, and gaps are told."""

from __future__ import annotations

import string
from collections.abc import Iterable

from hypothesis import given
from hypothesis import strategies as st

from dcon.link.assembly import AWAY, MOST_PARTS, TOO_LARGE, UNREADABLE, Assembly, Gap, Item, Pieces, Place
from dcon.link.bundle import UNNUMBERED, Bundle, Entry, Kind, decode, pieces, shares

SESSION = 7
WHAT = st.lists(st.one_of(st.none(), st.lists(st.integers(0, 60), max_size=6)), max_size=30)
"""What a controller ships: a configuration (None), or a tick of entries of so many bytes."""


def entry(data: bytes) -> Entry:
    return Entry("Event", "", data, 1, 1)


def stream(shipped: Iterable[list[int] | None], largest: int) -> list[Bundle]:
    """The bundles of it, the end last; no two entries are alike."""
    made: list[Bundle] = []
    ticks = 0
    for number, what in enumerate(shipped):
        if what is None:
            config = (Entry("config", "N1", b"%d" % number, 1, 1),)
            made.append(Bundle(Kind.CONFIG, len(made), SESSION, 0, config, ticks))
            continue
        entries = [entry(b"%d/%d" % (number, at) + bytes(size)) for at, size in enumerate(what)]
        cut = list(shares(entries, largest))
        for at, share in enumerate(cut):
            kind = Kind.TICK if at == len(cut) - 1 else Kind.MORE
            made.append(Bundle(kind, len(made), SESSION, 1 + ticks, share, ticks, at > 0))
        ticks += 1
    made.append(Bundle(Kind.END, len(made), SESSION, 0, (), ticks))
    return made


def whole_ticks(bundles: list[Bundle]) -> dict[int, tuple[Entry, ...]]:
    """By its number, the entries of every tick of which all bundles are there; found by another way."""
    found: dict[int, tuple[Entry, ...]] = {}
    by_tick: dict[int, list[Bundle]] = {}
    for bundle in bundles:
        if bundle.kind in (Kind.TICK, Kind.MORE):
            by_tick.setdefault(bundle.tick, []).append(bundle)
    for tick, parts in by_tick.items():
        sequences = [part.sequence for part in parts]
        unbroken = sequences == list(range(sequences[0], sequences[0] + len(parts)))
        if unbroken and not parts[0].goes_on and parts[-1].kind is Kind.TICK:
            found[tick] = tuple(entry for part in parts for entry in part.entries)
    return found


@given(WHAT, st.integers(80, 300), st.data())
def test_whatever_is_cut_repeated_and_lost(shipped: list[list[int] | None], largest: int, data: st.DataObject) -> None:
    bundles = stream(shipped, largest)
    assembly = Assembly(Place(SESSION))
    came: list[Bundle] = []
    items: list[Item] = []
    for bundle in bundles:
        fate = data.draw(st.sampled_from(("comes", "comes", "comes", "lost", "again", "other")))
        if fate != "lost":
            came.append(bundle)
            items += assembly.take(bundle)
        if fate == "again":
            for old in bundles[data.draw(st.integers(0, bundle.sequence)) : bundle.sequence + 1]:
                assert assembly.take(old) == []
        if fate == "other":
            assert assembly.take(bundle._replace(session=8, sequence=bundle.sequence + 1)) == []
    expected = whole_ticks(came)
    told = 0
    got: dict[int, tuple[Entry, ...]] = {}
    for item in items:
        assert not isinstance(item, Pieces)
        if isinstance(item, Gap):
            told += item.ticks
            assert item.reason == AWAY and (item.bundles or item.ticks)
        elif item.kind is Kind.TICK:
            got[item.tick] = item.entries
            assert item.tick + 1 == told + len(got) and not item.goes_on  # every tick is whole or told, so far
    assert got == expected and list(got) == sorted(got)
    gaps = [item for item in items if isinstance(item, Gap)]
    last = came[-1].sequence if came else -1
    assert sum(gap.bundles for gap in gaps) == last + 1 - len(came)
    assert [item for item in items if isinstance(item, Bundle) and item.kind in (Kind.CONFIG, Kind.END)] == [
        bundle for bundle in came if bundle.kind in (Kind.CONFIG, Kind.END)
    ]
    if came and came[-1].kind is Kind.END:
        assert told + len(got) == came[-1].tick == assembly.place.ticks and not assembly.is_amid
    assert assembly.place.have == last and not assembly.malformed


@given(WHAT, st.integers(80, 300), st.data())
def test_lives_between_ticks_lose_nothing(shipped: list[list[int] | None], largest: int, data: st.DataObject) -> None:
    """One that dies begins again where it was between two ticks."""
    bundles = stream(shipped, largest)
    assembly, safe = Assembly(Place(SESSION)), Place(SESSION)
    items: list[Item] = []
    kept: list[Item] = []
    while safe.have < len(bundles) - 1:
        items += assembly.take(bundles[assembly.place.have + 1])
        if not assembly.is_amid:
            safe, kept = assembly.place, list(items)
        if data.draw(st.integers(0, 9)) == 0:
            assembly, items = Assembly(safe), list(kept)
    assert not any(isinstance(item, Gap) for item in items)
    ticks = {item.tick: item.entries for item in items if isinstance(item, Bundle) and item.kind is Kind.TICK}
    assert ticks == whole_ticks(bundles) and len(items) == len(shipped) + 1


ANY_ENTRY = st.builds(
    Entry,
    st.sampled_from(("Event", "PmuFrame", "Tick", "x")),
    st.text(string.ascii_letters, max_size=2),
    st.binary(max_size=3),
    st.integers(-1, 3),
    st.integers(-1, 3),
)
ANY = st.builds(
    Bundle,
    st.sampled_from(list(Kind)),
    st.one_of(st.integers(0, 8), st.just(UNNUMBERED)),
    st.sampled_from((SESSION, 8)),
    st.integers(-1, 2),
    st.lists(ANY_ENTRY, max_size=3).map(tuple),
    st.integers(0, 5),
    st.booleans(),
)


@given(st.lists(ANY, max_size=40))
def test_bundles_without_sense_raise_nothing_and_no_tick_comes_twice(bundles: list[Bundle]) -> None:
    assembly = Assembly(Place(SESSION))
    ticks: list[int] = []
    for bundle in bundles:
        before = assembly.place
        for item in assembly.take(bundle):
            if isinstance(item, Bundle) and item.kind is Kind.TICK:
                ticks.append(item.tick)
                assert item.tick_ns > 0
        after = assembly.place
        assert (after.have, after.ticks) >= (before.have, before.ticks) and after.ticks >= before.ticks
    assert ticks == sorted(set(ticks))


def test_a_tick_that_is_larger_than_is_taken_is_a_gap_and_holds_nothing() -> None:
    def tick(number: int, parts: int, first: int) -> list[Bundle]:
        kinds = [Kind.MORE] * (parts - 1) + [Kind.TICK]
        return [
            Bundle(kind, first + at, SESSION, 1, (entry(b"%d" % at),), number, at > 0) for at, kind in enumerate(kinds)
        ]

    assembly = Assembly(Place(SESSION))
    bundles = [*tick(0, MOST_PARTS, 0), *tick(1, MOST_PARTS + 50, MOST_PARTS), *tick(2, 1, 2 * MOST_PARTS + 50)]
    items: list[Item] = []
    for bundle in bundles:
        items += assembly.take(bundle)
        assert len(assembly._parts) <= MOST_PARTS
    first, gap, last = items
    assert isinstance(first, Bundle) and len(first.entries) == MOST_PARTS
    assert gap == Gap(0, 1, TOO_LARGE) and last == bundles[-1]


@given(st.lists(st.integers(0, 9), max_size=30))
def test_a_head_is_whole_or_not_told(order: list[int]) -> None:
    cut = [bundle for data in pieces(3, {}, {"a": bytes(700)}, 500) if (bundle := decode(data))]
    assembly = Assembly()
    for at in order:
        for item in assembly.take(cut[at % len(cut)]):
            assert item == Pieces(3, tuple(cut))
    (whole,) = [item for bundle in cut for item in assembly.take(bundle)]
    assert whole == Pieces(3, tuple(cut)) and assembly.take(cut[-1]) == [] and assembly.place == Place()


def test_a_head_of_another_session_or_content_begins_anew() -> None:
    first, other = (
        [bundle for data in pieces(session, {}, {"a": bytes([session]) * 700}, 500) if (bundle := decode(data))]
        for session in (3, 4)
    )
    assembly = Assembly()
    found = [item for piece in (*first[:2], *other) for item in assembly.take(piece)]
    assert found == [Pieces(4, tuple(other))] and not assembly.malformed
    again = [bundle._replace(session=3) for bundle in other]
    found = [item for piece in (*first[:2], *again) for item in assembly.take(piece)]
    assert found == [Pieces(3, tuple(again))]


def test_parts_that_do_not_fit_are_a_gap_of_their_tick() -> None:
    more = Bundle(Kind.MORE, 0, SESSION, 1, (entry(b"a"),), 0)
    tick = Bundle(Kind.TICK, 1, SESSION, 1, (entry(b"b"),), 0)
    assembly = Assembly(Place(SESSION))
    assert assembly.take(more) == [] and assembly.take(tick) == [Gap(0, 1, UNREADABLE)]  # it goes on with nothing
    assert not assembly.is_amid and assembly.malformed == 1
    assembly = Assembly(Place(SESSION))
    rest = tick._replace(sequence=0, goes_on=True)
    assert assembly.take(rest) == [Gap(0, 1, UNREADABLE)] and assembly.malformed == 1
    after = tick._replace(tick=1)
    assert assembly.take(after) == [after] and assembly.place == Place(SESSION, 1, 2)


def test_what_is_repeated_is_passed_on_without_a_number() -> None:
    assembly = Assembly(Place(SESSION))
    config = Bundle(Kind.CONFIG, UNNUMBERED, SESSION, 0, (Entry("config", "N1", b"c", 1, 1),), 5)
    assert assembly.take(config) == [config] and assembly.place == Place(SESSION)
    assert assembly.take(config._replace(kind=Kind.TICK)) == [] and assembly.malformed == 1
