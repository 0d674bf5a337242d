"""A recording as the player wants it: order, numbers, editions, windows, and other times for the same frames."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.playing import MS, START_NS, interleaved, play, recording, reel_of, stamp_ns, stream

from pmutools.c37118 import Format, FrameType, Message, PhasorChannel, Station, StreamConfig
from pmutools.clock import VirtualClock
from pmutools.parsers import parse_place
from pmutools.timebase import NS, slot
from pmutools.tools.player import reel as reel_module
from pmutools.tools.player.reel import Reel, at_interval, at_rate, without_gaps
from pmutools.tools.window import Window


def wide(idcode: int, phasors: int = 5, rate: int = 50) -> StreamConfig:
    """Frames longer than those of a :func:`stream`."""
    channels = tuple(PhasorChannel(f"V{k}", 1) for k in range(phasors))
    return StreamConfig(idcode, (Station(f"WIDE {idcode}", idcode, Format(0), channels),), rate)


def data_of(messages: list[Message]) -> list[bytes]:
    return [message.frame.data for message in messages if message.frame.type is FrameType.DATA]


def frames_of(reel: Reel) -> list[bytes]:
    """The bytes of each row."""
    ends = reel.rows.at + reel.sizes[reel.rows.edition]
    return [reel.wire[at:end].tobytes() for at, end in zip(reel.rows.at, ends, strict=True)]


def spacing(reel: Reel, track: int = 0) -> set[int]:
    return set(np.diff(reel.rows.due_ns[reel.rows.track == track]).tolist())


# --- what is read


@settings(deadline=None, max_examples=60)
@given(
    st.lists(
        st.tuples(st.sampled_from([25, 50, 60]), st.integers(1, 40), st.integers(0, 60), st.integers(1, 6)),
        min_size=1,
        max_size=4,
    ),
    st.randoms(use_true_random=False),
)
def test_rows_are_all_frames_in_order_of_their_due_times(
    streams: list[tuple[int, int, int, int]], random: object
) -> None:
    """Streams of any rate, length, begin and FRAMESIZE, their frames received in any order."""
    sources = [
        recording(wide(k + 1, phasors, rate), frames, first_slot=first, latency_ns=lambda k: k * 13 % 50 * MS)
        for k, (rate, frames, first, phasors) in enumerate(streams)
    ]
    opened = [messages[0] for messages in sources]
    received = [message for messages in sources for message in messages[1:]]
    random.shuffle(received)
    reel = reel_of([*opened, *received])
    assert np.all(np.diff(reel.rows.due_ns) >= 0)
    assert sorted(frames_of(reel)) == sorted(data_of(received))
    for frame, stamp, track in zip(frames_of(reel), reel.rows.stamp_ns, reel.rows.track, strict=True):
        assert stamp_ns(frame, reel.tracks[track].config) == stamp
    for number, track in enumerate(reel.tracks):
        mine = reel.rows.track == number
        assert sorted(reel.rows.number[mine]) == [*range(track.total)]
        assert (track.frames, track.first_ns) == (mine.sum(), reel.rows.stamp_ns[mine].min())


def test_frames_due_at_one_time_stay_as_recorded() -> None:
    reel = reel_of(interleaved(recording(stream(3), 50), recording(stream(1), 50), recording(stream(2), 50)))
    by_time = [
        [reel.tracks[t].config.idcode for t in reel.rows.track[reel.rows.due_ns == due]]
        for due in np.unique(reel.rows.due_ns)
    ]
    assert by_time == [[3, 1, 2]] * 50


def test_a_file_on_disk_serves_as_memory_does(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    source = interleaved(recording(stream(1), 300), recording(wide(2), 300), recording(stream(3, rate=60), 300))
    kept = play(source, policy="keep")
    assert not isinstance(kept.reel.wire, np.memmap)
    monkeypatch.setattr(reel_module, "SPOOL_BYTES", 1000)
    spooled = play(source, policy="keep")
    assert isinstance(spooled.reel.wire, np.memmap)
    assert [(s.at_ns, s.stream, s.frame) for s in spooled.data] == [(s.at_ns, s.stream, s.frame) for s in kept.data]


def test_windows_count_from_the_first_stamp_of_the_source() -> None:
    late = recording(stream(2), 100, first_slot=25)
    source = interleaved(recording(stream(1), 100), late)
    reel = reel_of(source, None, Window(parse_place("0.5"), parse_place("2016-09-08T17:05:12.5Z")))
    assert reel.rows.number[reel.rows.track == 0].tolist() == [*range(25, 75)]
    assert reel.rows.number[reel.rows.track == 1].tolist() == [*range(50)]
    assert [track.total for track in reel.tracks] == [100, 100]


def test_editions_are_configurations_and_one_that_comes_back_is_the_same() -> None:
    a, b = stream(7), stream(7, cfgcnt=1)
    flow = recording(a, 0)[0].flow
    reel = reel_of(
        recording(a, 10)
        + recording(b, 10, first_slot=10, flow=flow)
        + recording(a, 10, first_slot=20, flow=flow)
        + recording(wide(7), 10, first_slot=30, flow=flow)
    )
    assert reel.rows.edition.tolist() == [0] * 10 + [1] * 10 + [0] * 10 + [2] * 10
    assert reel.editions == (a, b, wide(7))
    assert reel.sizes.tolist() == [a.frame_size, b.frame_size, wide(7).frame_size]
    assert len(reel.tracks) == 1


# --- gaps


def test_of_a_silence_whole_seconds_are_left_out() -> None:
    source = recording(stream(rate=60, time_base=0xFFFFFF), 120, slots=[*range(60), *range(6007, 6067)])
    reel, count = without_gaps(reel_of(source), NS)
    (gap,) = [gap for gap in np.diff(reel.rows.due_ns) if gap > 20 * MS]
    assert count == 1
    assert NS <= gap < 2 * NS
    assert np.diff(reel.rows.stamp_ns).tolist() == np.diff(reel.rows.due_ns).tolist()
    assert set((reel.rows.source_ns - reel.rows.stamp_ns) % NS) == {0}
    assert reel.round_ns == reel.round_stamp_ns == 4 * NS
    again, none = without_gaps(reel, NS)
    assert (again is reel, none) == (True, 0) or gap - NS < NS


@pytest.mark.parametrize("latency_ns", [None, 45 * MS])
def test_what_is_left_of_a_recording_is_played_with_its_phase_and_latency(latency_ns: int | None) -> None:
    source = recording(stream(), 100, first_slot=3, slots=[*range(50), *range(5000, 5050)], latency_ns=latency_ns)
    played = play(source, skip_gaps_ns=NS // 2)
    assert {played.began_ns + t - s for t, s in zip(played.times(), played.stamps(), strict=True)} == {latency_ns or 0}
    assert [sent.frame[10:14] for sent in played.data] == [frame[10:14] for frame in data_of(source)]
    assert played.times()[-1] - played.times()[0] < 4 * NS


def test_the_ledger_of_a_shortened_recording_has_its_stamps_as_recorded(tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    source = recording(stream(), 100, slots=[*range(50), *range(5000, 5050)])
    played = play(source, skip_gaps_ns=NS, loops=2, ledger=tmp_path / "ledger.parquet")
    rows = pq.read_table(tmp_path / "ledger.parquet").to_pylist()
    recorded = [stamp_ns(message.frame.data, message.config) for message in source[1:]]
    assert [row["source_time_ns"] for row in rows] == recorded * 2
    assert [row["time_ns"] for row in rows] == played.stamps()


def test_a_silence_of_one_stream_is_none_if_another_speaks() -> None:
    source = interleaved(recording(stream(1), 100, slots=[*range(50), *range(500, 550)]), recording(stream(2), 600))
    assert without_gaps(reel_of(source), NS)[1] == 0


def test_streams_that_begin_after_a_silence_begin_sooner_at_other_times_too() -> None:
    source = interleaved(recording(stream(1), 50), recording(stream(2), 50, first_slot=5000))
    shorter, _ = without_gaps(reel_of(source), NS)
    for reel in (shorter, at_interval(shorter, 10 * MS), at_rate(shorter, 25)):
        begins = [int(reel.rows.due_ns[reel.rows.track == track].min()) for track in (0, 1)]
        assert begins[1] - begins[0] == pytest.approx(2 * NS, abs=40 * MS)


# --- other spacings


def test_frames_of_several_streams_at_an_interval() -> None:
    source = interleaved(recording(stream(1), 60), recording(wide(2, rate=25), 30, first_slot=10))
    reel = at_interval(reel_of(source), 3_000_001)
    assert (spacing(reel, 0), spacing(reel, 1)) == ({3_000_001}, {3_000_001})
    assert reel.round_ns == max(60 * 3_000_001, 400 * MS + 30 * 3_000_001)
    looped = play(source, interval_ns=3_000_001, loops=3, policy="keep")
    assert looped.numbers(0) == [*range(60)] * 3
    assert looped.times(1) == [
        400 * MS + k * 3_000_001 + loop * int(reel.round_ns) for loop in range(3) for k in range(30)
    ]


@settings(deadline=None, max_examples=40)
@given(
    st.sampled_from([1, 7, 25, 30, 50, 60, 120]),
    st.integers(1, 80),
    st.lists(st.integers(0, 300), min_size=1, max_size=80),
    st.integers(1, 3),
)
def test_no_frame_is_lost_at_any_rate_with_any_latencies(fps: int, frames: int, late: list[int], loops: int) -> None:
    """Also where the last frames of a round come later than the next round would begin."""
    source = recording(stream(), frames, latency_ns=lambda k: late[k % len(late)] * MS)
    clock = VirtualClock()
    played = play(source, fps=fps, loops=loops, clock=clock)
    assert sorted(played.numbers()) == sorted([*range(frames)] * loops)
    due = [played.began_ns + t - s for t, s in zip(played.times(), played.stamps(), strict=True)]
    expected = sorted(late[k % len(late)] * MS for k in range(frames) for _ in range(loops))
    assert all(abs(a - b) <= 600 for a, b in zip(sorted(due), expected, strict=True))
    slots = sorted(slot(stamp, Fraction(fps)) for stamp in played.stamps())
    rounds = [slots[frames * k : frames * (k + 1)] for k in range(loops)]
    for these in rounds:
        assert these == [*range(these[0], these[0] + frames)]
    if max(late) - min(late) < NS / fps / MS:
        assert slots == [*range(slots[0], slots[0] + frames * loops)], "rounds follow each other without a gap"


def test_a_loop_of_shifted_stamps_is_whole_seconds_whatever_the_streams() -> None:
    source = interleaved(recording(stream(1, rate=60), 61), recording(wide(2, rate=50), 17, first_slot=90))
    played = play(source, loops=3)
    assert played.reel.round_ns == 3 * NS
    for track, frames in ((0, 61), (1, 17)):
        rounds = [played.stamps(track)[k * frames : (k + 1) * frames] for k in range(3)]
        for one, other in pairwise(rounds):
            assert other == [stamp + 3 * NS for stamp in one]
    assert played.stamps(0)[0] % NS == START_NS % NS
