"""A ledger held to samples: every row of both accounted for, whatever the windows, the order and the copies."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.measured import MS, START_NS, batch, config, measured, stamps

from pmutools.errors import SourceError
from pmutools.impair.outgoing import LedgerRow
from pmutools.measure.stream import Identity, StreamResult
from pmutools.timebase import NS, slot_time_ns
from pmutools.tools.characterizer.truth import DAMAGED, SENT, Truth, hold_to, open_ledger

SPAN = (START_NS, START_NS + 3600 * NS)
RATE = config().rate


class Copy(NamedTuple):
    """A row of the ledger; ``sent_ms`` after the stamp, None where it was not sent."""

    stream: str
    slot: int
    sent_ms: float | None = 20.0
    fate: str = "sent"
    faults: str = ""
    stamped: bool = True


class Came(NamedTuple):
    """A row of the samples; None: lost."""

    stream: str
    slot: int
    after_ms: float | None = 25.0
    state: str = "on-time"


def stamp_ns(slot: int) -> int:
    return START_NS + slot_time_ns(slot, RATE)


def write(tmp_path: Path, copies: Sequence[Copy], frames: Sequence[Came], *, group: int = 1 << 20) -> tuple[Path, Path]:
    """Both files, with row groups of so many rows."""
    ledger, samples = tmp_path / "ledger.parquet", tmp_path / "samples.parquet"
    said = []
    for number, copy in enumerate(copies):
        time_ns = stamp_ns(copy.slot)
        sent = None if copy.sent_ms is None else time_ns + round(copy.sent_ms * MS)
        said.append(
            {
                "stream": copy.stream,
                "index": number,
                "copy": 0,
                "source_time_ns": time_ns,
                "time_ns": time_ns,
                "offset_ns": 0,
                "scheduled_ns": time_ns + 20 * MS,
                "sent_ns": None if sent is None else sent + 50_000,
                "tx_stamp_ns": sent if copy.stamped else None,
                "fate": copy.fate,
                "faults": copy.faults,
                "nbytes": 66,
            }
        )
    kinds = {name: pa.string() if name in ("stream", "fate", "faults") else pa.int64() for name in LedgerRow._fields}
    pq.write_table(pa.Table.from_pylist(said, pa.schema(list(kinds.items()))), ledger, row_group_size=group)
    seen = []
    for frame in frames:
        arrival = None if frame.after_ms is None else stamp_ns(frame.slot) + round(frame.after_ms * MS)
        state = "lost" if arrival is None else frame.state
        seen.append(
            {"stream": frame.stream, "slot": 0, "time_ns": wire_ns(frame.slot), "arrival_ns": arrival, "state": state}
        )
    word = pa.dictionary(pa.int32(), pa.string())
    table = {name: word if name in ("stream", "state") else pa.int64() for name in ("stream", "slot", "time_ns")}
    table |= {"arrival_ns": pa.int64(), "state": word}
    pq.write_table(pa.Table.from_pylist(seen, pa.schema(list(table.items()))), samples, row_group_size=group)
    return ledger, samples


def wire_ns(slot: int) -> int:
    """The stamp as FRACSEC tells it at TIME_BASE 1,000,000: not to the nanosecond."""
    return (stamp_ns(slot) + 500) // 1000 * 1000


def stream(name: str, idcode: int = 101, others: tuple[str, ...] = ()) -> StreamResult:
    of = config(idcode=idcode)
    return measured(batch(stamps([0]), of=of), identity=Identity(name, idcode, "udp", others=others))


def joined(
    tmp_path: Path, copies: Sequence[Copy], frames: Sequence[Came], names: Sequence[str] = ("A",), **options: Any
) -> Truth:
    group = options.pop("group", 1 << 20)
    ledger, samples = write(tmp_path, copies, frames, group=group)
    return hold_to(ledger, samples, [stream(name) for name in names], *SPAN, **options)


def test_every_fate_met_and_missed(tmp_path: Path) -> None:
    copies = [
        *(Copy("A", slot) for slot in range(100)),
        *(Copy("A", slot, None, "lost") for slot in range(100, 110)),
        *(Copy("A", slot, None, "dropped") for slot in range(110, 115)),
        *(Copy("A", slot, 20.0, "sent", "delay:1ms,corrupt:1bit") for slot in range(115, 118)),
        *(Copy("A", slot) for slot in range(118, 125)),
    ]
    frames = [*(Came("A", slot) for slot in range(100)), *(Came("A", slot, None) for slot in range(100, 125))]
    frames.append(Came("A", 500))
    truth = joined(tmp_path, copies, frames)
    (agreement,) = truth.agreements
    assert agreement.received == {SENT: 100}
    assert agreement.missing == {SENT: 7, "lost": 10, "dropped": 5, DAMAGED: 3}
    assert (agreement.unknown, agreement.outside) == (1, 0)
    assert agreement.one_way.min_ns == pytest.approx(5 * MS, abs=1000)
    assert agreement.at_sender.min_ns == pytest.approx(20 * MS, abs=1000)
    told = agreement.to_json()
    assert (told["lost_on_the_way"], told["contradictions"], told["departures_stamped_by_kernel"]) == (7, 0, 1.0)


def test_a_frame_that_the_ledger_says_was_never_sent(tmp_path: Path) -> None:
    (agreement,) = joined(tmp_path, [Copy("A", 1, None, "dropped")], [Came("A", 1)]).agreements
    assert agreement.received == {"dropped": 1}
    assert agreement.to_json()["contradictions"] == 1
    assert agreement.one_way.count == 0


def test_what_left_outside_of_the_measurement(tmp_path: Path) -> None:
    copies = [Copy("A", -600), Copy("A", 10), Copy("A", 60 * 3700)]
    (agreement,) = joined(tmp_path, copies, [Came("A", 10)]).agreements
    assert (agreement.outside, agreement.received, agreement.missing) == (2, {SENT: 1}, {})


@pytest.mark.parametrize(
    ("came", "one_way_ms"),
    [
        ([25.0, 47.0], [5.0, 7.0]),
        ([47.0, 25.0], [5.0, 7.0]),
        ([47.0], [7.0]),  # the first copy was lost
        ([30.0], [10.0]),  # the second was, or had not left yet
        ([25.0, 46.0, 47.0], [5.0, 6.0]),  # and one that the network made
    ],
)
def test_copies_are_told_apart_by_when_they_left(came: list[float], one_way_ms: list[float], tmp_path: Path) -> None:
    """Sent after 20 and after 40 ms."""
    copies = [Copy("A", 5, 40.0), Copy("A", 5, 20.0)]
    (agreement,) = joined(tmp_path, copies, [Came("A", 5, after) for after in came]).agreements
    assert agreement.received[SENT] == len(one_way_ms)
    assert agreement.missing.get(SENT, 0) == 2 - len(one_way_ms)
    assert agreement.unknown == len(came) - len(one_way_ms)
    low, high = agreement.one_way.min_ns, agreement.one_way.max_ns
    assert low is not None and high is not None
    assert [low / MS, high / MS] == pytest.approx([min(one_way_ms), max(one_way_ms)], abs=0.01)


def test_clocks_that_differ_leave_negative_delays(tmp_path: Path) -> None:
    copies = [Copy("A", 5, 20.0), Copy("A", 5, 20.0), Copy("A", 6, 20.0)]
    frames = [Came("A", 5, 3.0), Came("A", 5, 3.5), Came("A", 6, 4.0)]
    (agreement,) = joined(tmp_path, copies, frames).agreements
    assert agreement.received == {SENT: 3}
    assert agreement.one_way.max_ns is not None and agreement.one_way.max_ns < 0


def test_streams_are_matched_by_any_name_that_only_one_has(tmp_path: Path) -> None:
    copies = [Copy(name, slot) for name in ("N1", "300", "other") for slot in range(3)]
    frames = [Came(name, slot) for name in ("north", "PDC") for slot in range(3)]
    ledger, samples = write(tmp_path, copies, frames)
    results = [stream("north", 101, ("N1", "101")), stream("PDC", 300, ("300",))]
    truth = hold_to(ledger, samples, results, *SPAN)
    assert truth.names == ["N1", "300"]
    assert [agreement.received for agreement in truth.agreements] == [{SENT: 3}] * 2
    told = truth.to_json(ledger, results)
    assert told["not_measured"] == ["other"]
    assert told["all"]["received"] == {SENT: 6}
    assert [row["name"] for row in told["streams"]] == ["north", "PDC"]


def test_departures_by_the_call_where_no_kernel_stamped(tmp_path: Path) -> None:
    (agreement,) = joined(tmp_path, [Copy("A", 1, stamped=False)], [Came("A", 1)]).agreements
    assert agreement.stamped == 0
    assert agreement.one_way.min_ns == pytest.approx(4.95 * MS, abs=1000)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    group=st.sampled_from((1, 7, 64, 10_000)),
    rows=st.sampled_from((3, 50, 100_000)),
)
def test_every_row_is_counted_once_however_it_is_cut(
    seed: int, group: int, rows: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    rng = random.Random(seed)
    copies, frames, missing, unknown = list[Copy](), list[Came](), Counter[str](), 0
    for name in ("A", "B"):
        for slot in range(rng.randrange(60)):
            for number in range(1 + (rng.random() < 0.1)):
                sent = rng.random() < 0.9
                copies.append(Copy(name, slot, 20.0 + number if sent else None, "sent" if sent else "lost"))
                if sent and rng.random() < 0.9:
                    frames.append(Came(name, slot, 20.0 + number + rng.random() * 0.5))
                else:
                    missing["sent" if sent else "lost"] += 1
        for _ in range(rng.randrange(3)):
            frames.append(Came(name, 1000 + rng.randrange(100)))
            unknown += 1
    rng.shuffle(copies)
    rng.shuffle(frames)
    if not copies:
        return
    truth = joined(tmp_path_factory.mktemp("truth"), copies, frames, ("A", "B"), group=group, rows=rows)
    known = [name for name in truth.names if name is not None]
    received = sum(sum(agreement.received.values()) for agreement in truth.agreements)
    assert received + sum(sum(agreement.missing.values()) for agreement in truth.agreements) == len(copies)
    assert received + sum(agreement.unknown for agreement in truth.agreements) == len(frames)
    assert sum(agreement.unknown for agreement in truth.agreements) == unknown
    assert Counter[str]() + sum((Counter(a.missing) for a in truth.agreements), Counter()) == +missing
    assert set(known) == {copy.stream for copy in copies}
    for agreement in truth.agreements:
        if agreement.one_way.count:
            assert agreement.one_way.min_ns is not None and agreement.one_way.max_ns is not None
            assert -1000 <= agreement.one_way.min_ns <= agreement.one_way.max_ns <= 501_000


def test_what_is_no_ledger(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"no such ledger \(yet\)"):
        open_ledger(tmp_path / "none.parquet")
    (tmp_path / "cut.parquet").write_bytes(b"PAR1" + bytes(100))
    with pytest.raises(SourceError, match="not finished"):
        open_ledger(tmp_path / "cut.parquet")
    pq.write_table(pa.table({"stream": ["A"]}), tmp_path / "other.parquet")
    with pytest.raises(SourceError, match="lacks the column 'time_ns'"):
        open_ledger(tmp_path / "other.parquet")
