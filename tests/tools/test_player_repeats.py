"""What the ledger promises to repeat, over real sockets: one source, profile and seed, at another time, another pace.

Columns that depend on when a run took place are left out of every comparison, and those only.
"""

from __future__ import annotations

import random
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from support.chain import EarlyClock
from support.playing import MS, interleaved, recording, reel_of, stream

from pmutools import linux
from pmutools.c37118 import Message
from pmutools.impair.outgoing import UNREPEATABLE
from pmutools.impair.profile import parse_profile
from pmutools.net.endpoint import parse_endpoint
from pmutools.timebase import NS
from pmutools.tools.player.cast import Cast, Spread, as_recorded, emulated
from pmutools.tools.player.ledger import LedgerWriter
from pmutools.tools.player.play import Options, Player
from pmutools.tools.player.reel import Reel

pytestmark = pytest.mark.realtime

Row = dict[str, Any]
DAY_NS = 86_400 * NS
EVERYTHING = """
[run]
seed = 11
[stream *]
corrupt = 5%
  3% stat(not_synchronised) when=second 12
  2% truncate
config = add(2) announce=0.2 when=0.6..0.8
  rename(OTHER) notice=no when=1.5..1.6
disable = 0.3..0.4
  1..1.2 release=burst tcp=rst
drop = every 17 offset 3
loss = gemodel(3%, 30%)
  list(0-999) when=2%
  onoff(1, 0.02)
duplicate = 10% count=2
delay = normal(20, 8) + pareto(3, 1, max=50) corr=40%
  sinusoid(5, 5, 0.7) order=keep when=every 2
reorder = 10% depth=2
rate = 200k overhead=28 queue=40
slot = constant(2)
segment = 5% split(parts=3, gap=1)
  2% stall(20)
[at 0.5]
do = pause 0.1
     fault * loss=+4%
[at 0.9]
do = disable 1 release=burst
     speed 5
[at 1.3]
do = enable *
     speed 8
"""


class LaggingClock(EarlyClock):
    """Another day, and it often oversleeps by some milliseconds."""

    def __init__(self, first_due_ns: int) -> None:
        super().__init__(first_due_ns)
        self.moved_ns += 1234 * DAY_NS
        self._rng = random.Random(3)

    def sleep_until(self, deadline_ns: int, /) -> None:
        super().sleep_until(deadline_ns + self._rng.choice((0, 0, 0, 5 * MS)))


def source(*idcodes: int, frames: int = 100) -> list[Message]:
    """Streams of several rates, with recorded latencies."""
    return interleaved(
        *(
            recording(stream(n, rate=(50, 40, 60)[n % 3]), frames, latency_ns=lambda k, n=n: (n + k * 7 % 13) * MS)  # type: ignore[misc]
            for n in idcodes
        )
    )


@contextmanager
def anyone() -> Iterator[str]:
    """A bound port whose datagrams nobody reads."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sink:
        sink.bind(("127.0.0.1", 0))
        yield f"udp://127.0.0.1:{sink.getsockname()[1]}"


def ledger_of(
    path: Path,
    messages: list[Message],
    profile: str,
    *,
    cast: Callable[[Reel], Cast] = as_recorded,
    clock: type[EarlyClock] = EarlyClock,
    native: bool = linux.NATIVE,
    seed: int | None = None,
    **options: Any,
) -> list[Row]:
    """Every row of a run, as it stands in the file."""
    import pyarrow.parquet as pq

    reel = reel_of(messages)
    with anyone() as url:
        chosen = Options(
            to=[parse_endpoint(url)],
            profile=parse_profile(profile, "profile.ini"),
            seed=seed,
            **({"speed": Fraction(8)} | options),
        )
        playing = Player(cast(reel), chosen, clock(reel.first_due_ns), native=native, stamp_departures=True)
        with playing, LedgerWriter(path) as rows:
            playing.play(rows)
    return list(pq.read_table(path).to_pylist())


def repeatable(rows: list[Row]) -> list[Row]:
    return [{name: value for name, value in row.items() if name not in UNREPEATABLE} for row in rows]


def five(reel: Reel) -> Cast:
    return emulated(reel, 5, 11, spread=Spread(mag=1, deg=5, mhz=2))


@pytest.mark.parametrize("cast", [as_recorded, five])
def test_a_run_repeats_another_day_late_and_portably(cast: Callable[[Reel], Cast], tmp_path: Path) -> None:
    messages, path = source(1, 2, 3, frames=60), tmp_path / "ledger.parquet"
    first = ledger_of(path, messages, EVERYTHING, cast=cast, loops=2)
    second = ledger_of(path, messages, EVERYTHING, cast=cast, loops=2, clock=LaggingClock)
    third = ledger_of(path, messages, EVERYTHING, cast=cast, loops=2, native=False)
    assert repeatable(first) == repeatable(second)
    assert repeatable(first) == repeatable(third)
    assert {row["time_ns"] for row in first}.isdisjoint(row["time_ns"] for row in second)
    assert {row["fate"] for row in first} >= {"sent", "lost", "dropped", "disabled"}
    told = ",".join(row["faults"] for row in first)
    for mark in ("corrupt:", "config:", "burst", "delay:", "reorder:", "rate:", "slot:", "segment:"):
        assert mark in told, "all stages were at work"
    assert max(row["copy"] for row in first) == 2
    if linux.NATIVE:
        assert all((row["tx_stamp_ns"] is None) is (row["sent_ns"] is None) for row in first)
    assert {row["tx_stamp_ns"] for row in third} == {None}, "the portable path has no stamps"


MEMORYLESS = """
[run]
seed = 5
[stream *]
corrupt = 20%
loss = {loss}
duplicate = 20%
delay = normal(30, 10) corr=50%
"""
"""Without the stages that follow the frames as they come."""


def by_copy(rows: list[Row], fate: str = "sent") -> dict[tuple[str, int, int], Row]:
    found = repeatable(rows)
    return {(row["stream"], row["index"], row["copy"]): row for row in found if row["fate"] == fate}


def test_another_loss_ratio_leaves_the_draws_of_all_other_stages(tmp_path: Path) -> None:
    path, messages = tmp_path / "ledger.parquet", source(1, 2)
    few = by_copy(ledger_of(path, messages, MEMORYLESS.format(loss="5%")))
    many = by_copy(ledger_of(path, messages, MEMORYLESS.format(loss="40%")))
    both = few.keys() & many.keys()
    assert many.keys() < few.keys(), "what a small ratio loses, a greater one loses too"
    assert len(both) > 80
    assert [few[key] for key in both] == [many[key] for key in both]
    assert sum("corrupt" in few[key]["faults"] for key in both) > 10
    assert len({few[key]["faults"].split(",")[0] for key in both}) > 80


def test_a_stage_that_is_added_leaves_the_draws_of_those_there(tmp_path: Path) -> None:
    path, messages = tmp_path / "ledger.parquet", source(1, 2)
    plain = by_copy(ledger_of(path, messages, MEMORYLESS.format(loss="10%")))
    more = by_copy(ledger_of(path, messages, MEMORYLESS.format(loss="10%") + "segment = 50% split(parts=2, gap=1)\n"))
    assert plain.keys() == more.keys()
    for key, row in plain.items():
        marks = [mark for mark in more[key]["faults"].split(",") if not mark.startswith("segment:")]
        assert row == more[key] | {"faults": ",".join(marks)}


def test_a_stream_that_is_added_changes_no_row_of_the_others(tmp_path: Path) -> None:
    path = tmp_path / "ledger.parquet"
    profile = EVERYTHING.partition("[at 0.5]")[0]
    alone = ledger_of(path, source(1, 2), profile)
    together = ledger_of(path, source(1, 2, 4), profile)
    names = {row["stream"] for row in alone}
    assert {row["stream"] for row in together} > names
    for name in names:
        ours = [row for row in repeatable(alone) if row["stream"] == name]
        assert ours == [row for row in repeatable(together) if row["stream"] == name]
