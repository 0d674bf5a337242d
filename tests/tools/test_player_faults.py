"""What becomes of each frame: faults, refusals, absent clients, changed configurations; and the ledger that says so."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.playing import (
    MS,
    START_NS,
    Loaded,
    Played,
    Stage,
    config_of,
    faults,
    interleaved,
    number,
    play,
    recording,
    stamp_ns,
    stream,
)

from pmutools.c37118 import Format, FrameType, Message, PhasorChannel, Station, StreamConfig, decode_prefix
from pmutools.c37118.checksum import chk
from pmutools.clock import VirtualClock
from pmutools.impair.outgoing import UNREPEATABLE, LedgerRow
from pmutools.impair.profile import Profile, parse_profile
from pmutools.net.cargo import I64, Frames
from pmutools.parsers import parse_place
from pmutools.tools.window import Window

Row = dict[str, Any]


def rows_of(path: Path) -> list[Row]:
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    assert table.column_names == list(LedgerRow._fields)
    return list(table.to_pylist())


def repeated(row: Row) -> Row:
    """What the same seed gives again."""
    return {name: value for name, value in row.items() if name not in UNREPEATABLE}


def with_ledger(tmp_path: Path, messages: list[Message], **options: Any) -> tuple[Played, list[Row]]:
    path = tmp_path / "ledger.parquet"
    played = play(messages, ledger=path, **options)
    return played, rows_of(path)


# --- faults


def test_a_clean_run_has_one_sent_row_a_frame(tmp_path: Path) -> None:
    source = recording(stream(), 100, latency_ns=lambda k: (5 + k % 4) * MS)
    played, rows = with_ledger(tmp_path, source)
    assert [row["index"] for row in rows] == [*range(100)]
    assert {(row["stream"], row["copy"], row["fate"], row["faults"]) for row in rows} == {("PMU 7", 0, "sent", "")}
    assert {row["nbytes"] for row in rows} == {played.reel.tracks[0].config.frame_size}
    assert [row["source_time_ns"] for row in rows] == [stamp_ns(m.frame.data, m.config) for m in source[1:]]
    assert [row["time_ns"] for row in rows] == played.stamps()
    assert [row["sent_ns"] for row in rows] == [played.began_ns + time for time in played.times()]
    assert [row["scheduled_ns"] for row in rows] == [row["sent_ns"] for row in rows]
    assert {row["scheduled_ns"] - row["offset_ns"] for row in rows} == {rows[0]["scheduled_ns"]}
    assert {row["tx_stamp_ns"] for row in rows} == {None}


def test_drop_list_counts_the_data_frames_of_each_stream(tmp_path: Path) -> None:
    source = interleaved(recording(stream(1), 300), recording(stream(2), 300))
    played, rows = with_ledger(tmp_path, source, profile=faults("drop=10,50-59,every 100 offset 3"))
    gone = {10, *range(50, 60), 3, 103, 203}
    for place in (0, 1):
        assert played.numbers(place) == [k for k in range(300) if k not in gone]
    assert Counter(row["fate"] for row in rows) == {"sent": 2 * (300 - len(gone)), "dropped": 2 * len(gone)}
    assert {row["index"] for row in rows if row["fate"] == "dropped"} == gone
    assert all(row["sent_ns"] is None for row in rows if row["fate"] == "dropped")


def test_drop_list_is_not_reset_by_loops_and_counts_over_the_source() -> None:
    window = Window(parse_place("1"), parse_place("2"))  # frames 50 to 99 of 150
    played = play(recording(stream(), 150), window=window, loops=2, profile=faults("drop=3,60,210"))
    assert played.numbers() == [*(k for k in range(50, 100) if k != 60), *(k for k in range(50, 100) if k != 60)]


def test_drop_never_touches_configuration_frames() -> None:
    source = changing()
    assert play(source, profile=faults("drop=every 1")).stage.sent == []
    played = play(source, profile=faults("drop=0-49"))
    assert [sent.type for sent in played.stage.sent[:1]] == [FrameType.CFG2]


def test_disable_by_name_and_stream_time_whatever_the_speed(tmp_path: Path) -> None:
    source = interleaved(recording(stream(1, name="N1"), 500), recording(stream(2, name="S1"), 500))
    played, rows = with_ledger(tmp_path, source, profile=faults("disable=N1@5..8"), speed="4")
    assert played.numbers(0) == [*range(250), *range(400, 500)]
    assert played.numbers(1) == [*range(500)]
    assert Counter(row["fate"] for row in rows if row["stream"] == "N1") == {"sent": 350, "disabled": 150}


def test_loss_and_delay_are_in_the_ledger_as_they_were_on_the_wire(tmp_path: Path) -> None:
    source = recording(stream(), 2000)
    played, rows = with_ledger(tmp_path, source, profile=faults("loss=5%", "delay=normal(30,8)"), seed=3)
    lost = [row for row in rows if row["fate"] == "lost"]
    start_ns = rows[0]["scheduled_ns"] - rows[0]["offset_ns"]
    assert 50 <= len(lost) <= 150
    assert sorted(played.numbers()) == [row["index"] for row in sorted(rows, key=by_index) if row["fate"] == "sent"]
    for sent, row in zip(played.data, [row for row in rows if row["fate"] == "sent"], strict=True):
        assert number(sent.frame) == row["index"]
        assert played.began_ns + sent.at_ns == row["sent_ns"]
        told_ms = float(row["faults"].removeprefix("delay:").removesuffix("ms")) if row["faults"] else 0.0
        assert abs(row["offset_ns"] + start_ns - row["time_ns"] - told_ms * MS) < 1000
        assert row["sent_ns"] == row["scheduled_ns"]
    assert [row["offset_ns"] for row in rows] == sorted(row["offset_ns"] for row in rows)


def by_index(row: Row) -> int:
    return int(row["index"])


def test_delays_are_added_after_speed_unscaled() -> None:
    plain, late = (
        play(recording(stream(), 20), speed="10", **options)
        for options in ({}, {"profile": faults("delay=constant(16)")})
    )
    assert [b - a for a, b in zip(plain.times(), late.times(), strict=True)] == [16 * MS] * 20


def test_frames_held_back_to_be_overtaken_keep_their_own_stamps(tmp_path: Path) -> None:
    source = recording(stream(), 500)
    played, rows = with_ledger(tmp_path, source, profile=faults("reorder=20% depth=3"), seed=1)
    recorded = {k: stamp_ns(message.frame.data, message.config) for k, message in enumerate(source[1:])}
    assert played.numbers() != sorted(played.numbers())
    assert sorted(played.numbers()) == [*range(500)]
    assert {row["index"]: row["source_time_ns"] for row in rows} == recorded
    assert [row["time_ns"] for row in rows] == played.stamps()
    assert len({row["time_ns"] - row["source_time_ns"] for row in rows}) == 1


def test_a_burst_after_a_silence_brings_all_frames_with_their_own_stamps(tmp_path: Path) -> None:
    source = recording(stream(), 300)
    played, rows = with_ledger(tmp_path, source, profile=faults("disable=1..3 release=burst"), loops=2)
    assert played.numbers() == [*range(300)] * 2
    assert [row["index"] for row in rows] == [*range(600)]
    assert len(set(played.times()[50:151])) == 1, "all at once, when the stream came back"
    assert [row["time_ns"] for row in rows] == played.stamps()


def test_what_is_held_at_the_end_leaves_then(tmp_path: Path) -> None:
    _, rows = with_ledger(tmp_path, recording(stream(), 50), profile=faults("reorder=100% depth=1000"))
    assert Counter(row["fate"] for row in rows) == {"sent": 50}
    _, rows = with_ledger(tmp_path, recording(stream(), 100), profile=faults("disable=1..60 release=burst"))
    assert Counter(row["fate"] for row in rows) == {"sent": 50, "disabled": 50}
    assert [row["source_time_ns"] for row in rows] == [START_NS + k * 20 * MS for k in range(100)]


def test_duplicates_have_rows_of_their_own(tmp_path: Path) -> None:
    played, rows = with_ledger(tmp_path, recording(stream(), 400), profile=faults("duplicate=25%"), seed=5)
    assert Counter(row["index"] for row in rows) == Counter(played.numbers())
    assert {row["copy"] for row in rows} == {0, 1}
    assert len(rows) > 450


def test_corruption_is_on_the_wire_and_in_the_ledger(tmp_path: Path) -> None:
    played, rows = with_ledger(tmp_path, recording(stream(), 400), profile=faults("corrupt=10%"), seed=2)
    bad = [chk(sent.frame) != 0 for sent in played.stage.sent]
    assert bad == ["corrupt" in row["faults"] for row in rows]
    assert 20 <= sum(bad) <= 70


def test_a_profile_acts_by_its_timeline(tmp_path: Path) -> None:
    profile = parse_profile(
        "[run]\nseed = 4\n[stream N*]\ndelay = constant(3)\n[at 2]\ndo = disable N1\n[at 4]\ndo = enable N1", "x.ini"
    )
    source = interleaved(recording(stream(1, name="N1"), 300), recording(stream(2, name="S1"), 300))
    played, rows = with_ledger(tmp_path, source, profile=profile)
    assert played.numbers(0) == [*range(100), *range(200, 300)]
    assert played.times(0)[0] - played.times(1)[0] == 3 * MS
    assert {row["faults"] for row in rows if row["stream"] == "S1"} == {""}


@pytest.mark.parametrize("cost_ns", [0, 33 * MS])
def test_the_same_seed_repeats_every_column_but_the_clocks(tmp_path: Path, cost_ns: int) -> None:
    """Also where the second player is slow, late and begins at another time."""
    profile = faults("loss=gemodel(2%,20%)", "delay=normal(60,30)", "duplicate=5%", "corrupt=3%", "reorder=2%")
    source = interleaved(recording(stream(1), 600), recording(stream(2, rate=30), 360))

    def run(seed: int, clock: VirtualClock, stage: Stage) -> list[Row]:
        return with_ledger(tmp_path, source, profile=profile, seed=seed, loops=2, clock=clock, stage=stage)[1]

    first_clock, second_clock = VirtualClock(), VirtualClock(1_800_000_000_987_654_321, 5)
    first = run(11, first_clock, Stage(first_clock))
    second = run(11, second_clock, Stage(second_clock, cost_ns=cost_ns))
    assert [repeated(row) for row in first] == [repeated(row) for row in second]
    assert first != second
    third_clock = VirtualClock()
    assert run(12, third_clock, Stage(third_clock)) != first


def test_faults_of_one_stream_do_not_depend_on_the_others(tmp_path: Path) -> None:
    profile = faults("loss=10%", "delay=normal(30,10)")
    alone = with_ledger(tmp_path, recording(stream(1), 300), profile=profile, seed=1)[1]
    source = interleaved(recording(stream(1), 300), recording(stream(2), 300))
    together = with_ledger(tmp_path, source, profile=profile, seed=1)[1]
    assert [repeated(row) for row in alone] == [repeated(row) for row in together if row["stream"] == "PMU 1"]


# --- fates that the world decides


def test_frames_that_nobody_listens_to_are_skipped(tmp_path: Path) -> None:
    clock = VirtualClock()
    played, rows = with_ledger(tmp_path, recording(stream(), 50), clock=clock, stage=Stage(clock, listeners=0))
    assert Counter(row["fate"] for row in rows) == {"skipped": 50} == played.fates
    assert {row["sent_ns"] for row in rows} == {None}
    assert played.player.results[0].late.frames == 0


def test_a_frame_has_failed_if_no_destination_took_it(tmp_path: Path) -> None:
    clock = VirtualClock()
    stage = Stage(clock, listeners=2, refuses={5: 1, 9: 2})
    _, rows = with_ledger(tmp_path, recording(stream(), 20), clock=clock, stage=stage)
    assert [row["index"] for row in rows if row["fate"] == "failed"] == [9]
    assert [row["index"] for row in rows if row["sent_ns"] is None] == [9]


class Tardy(Stage):
    """Its kernel stamps what has left only some time after the call."""

    def load(self, frames: Frames) -> Loaded:
        self.loaded = [*getattr(self, "loaded", []), *frames.marks.tolist()]
        return super().load(frames)

    def departures(self) -> tuple[I64, I64]:
        ready, self.ready = getattr(self, "ready", []), self.loaded
        self.loaded = []
        return np.array(ready, np.int64), np.full(len(ready), 17, np.int64)


def test_stamps_of_departures_that_come_at_the_very_end_are_in_the_ledger(tmp_path: Path) -> None:
    clock = VirtualClock()
    _, rows = with_ledger(tmp_path, recording(stream(), 20), clock=clock, stage=Tardy(clock))
    assert [row["tx_stamp_ns"] for row in rows] == [17] * 20


# --- configurations


def changing(profile: Profile | None = None) -> list[Message]:
    """A second of a stream, then another configuration, then the first again."""
    plain, other = stream(), stream(cfgcnt=1, name="RENAMED")
    flow = recording(plain, 0)[0].flow
    return [
        *recording(plain, 50),
        *recording(other, 50, first_slot=50, flow=flow),
        *recording(plain, 50, first_slot=100, flow=flow),
    ]


def test_a_changed_configuration_is_announced_before_its_data() -> None:
    played = play(changing(), loops=2)
    seen = [(sent.type, number(sent.frame) if sent.type is FrameType.DATA else None) for sent in played.stage.sent]
    one = [(FrameType.CFG2, None)]
    fifty = [(FrameType.DATA, k) for k in range(50)]
    assert seen == fifty + one + fifty + one + fifty + fifty + one + fifty + one + fifty
    names = [config_of(sent).stations[0].name for sent in played.stage.sent if sent.type is FrameType.CFG2]
    assert names == ["RENAMED", "PMU 7"] * 2
    stamps = [decode_prefix(sent.frame).soc for sent in played.stage.sent if sent.type is FrameType.CFG2]
    assert stamps == [(played.began_ns + s.at_ns) // 10**9 for s in played.stage.sent if s.type is FrameType.CFG2]


def test_a_change_stays_in_its_place_when_frames_leave_together() -> None:
    """Behind by seconds, many frames leave with one call: the announcement is between the right two of them."""
    clock = VirtualClock()
    played = play(changing(), clock=clock, stage=Stage(clock, cost_ns=700 * MS), speed="1000")
    kinds = "".join("d" if sent.type is FrameType.DATA else "c" for sent in played.stage.sent)
    assert kinds == "d" * 50 + "c" + "d" * 50 + "c" + "d" * 50


def test_a_change_is_announced_at_the_new_rate() -> None:
    played = play(changing(), fps=30)
    assert {config_of(sent).data_rate for sent in played.stage.sent if sent.type is FrameType.CFG2} == {30}


def test_the_same_configuration_said_again_is_not_announced_again() -> None:
    config = stream()
    flow = recording(config, 0)[0].flow
    source = recording(config, 50) + recording(stream(), 50, first_slot=50, flow=flow)
    assert {sent.type for sent in play(source).stage.sent} == {FrameType.DATA}


def test_faults_in_fields_follow_the_layout_of_the_frame_at_hand(tmp_path: Path) -> None:
    plain = stream()
    wide = StreamConfig(7, (Station("PMU 7", 7, Format(0), tuple(PhasorChannel(f"V{k}", 1) for k in range(5))),), 50)
    flow = recording(plain, 0)[0].flow
    source = recording(plain, 50) + recording(wide, 50, first_slot=50, flow=flow)
    played, rows = with_ledger(tmp_path, source, profile=faults("corrupt=bits(1) field=freq"))
    assert len(rows) == 100
    recorded = [message.frame.data for message in source if message.frame.type is FrameType.DATA]
    for sent, then in zip(played.data, recorded, strict=True):
        assert sent.frame[14:-6] == then[14:-6], "only FREQ, six bytes from the end, and CHK differ"
        assert sent.frame[-6:-4] != then[-6:-4]


def test_a_configuration_known_to_all_is_announced_once_at_the_start() -> None:
    played = play(interleaved(recording(stream(1), 5), recording(stream(2), 5)))
    assert [handle for _, handle in played.stage.announced] == [0, 1]
    assert played.stage.announced[0][0] == 0
