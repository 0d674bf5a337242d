"""A sender that comes back is the stream it was: in what is recorded, and in what is played."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.live import data_frame, stream
from support.recordings import write

from pmutools.c37118.batch import decode_batch
from pmutools.c37118.config import StreamConfig
from pmutools.errors import SourceError
from pmutools.flow import Flow
from pmutools.formats import open_sink, open_source
from pmutools.formats.source import Block
from pmutools.timebase import NS, parse_utc
from pmutools.tools.continuity import Continuity
from pmutools.tools.player.reel import record
from pmutools.tools.reader.recorder import keep_journal
from pmutools.tools.window import Window

START_NS = parse_utc("2024-06-01T00:00:00Z")
LISTENER = "127.0.0.1:4713"


def block(flow: Flow, second: float, config: StreamConfig | None = None, frames: int = 30) -> Block:
    config = config or stream()
    first_ns = START_NS + round(second * NS)
    times = [first_ns + k * NS // 60 for k in range(frames)]
    data = b"".join(data_frame(config, time_ns) for time_ns in times)
    return Block(flow, decode_batch(data, config, [time_ns + 20_000_000 for time_ns in times], 1))


def udp(port: int, host: str = "192.0.2.1") -> Flow:
    return Flow("udp", f"{host}:{port}", LISTENER)


def flows(rounds: list[list[Block]]) -> list[Flow]:
    continuity = Continuity()
    return [item.flow for found in rounds for item in continuity.settle(found)]  # type: ignore[union-attr]


def test_a_sender_that_was_started_again_goes_on() -> None:
    assert flows([[block(udp(1), 0)], [block(udp(2), 5)], [block(udp(2), 6), block(udp(3), 9)]]) == [udp(1)] * 4


def test_a_connection_made_anew_goes_on_at_once() -> None:
    one, two = (Flow("tcp", "192.0.2.1:4712", f"192.0.2.9:{port}") for port in (1000, 1001))
    assert flows([[block(one, 0)], [block(two, 0.5)]]) == [one, one]


def test_two_that_send_at_the_same_time_are_two() -> None:
    together = [[block(udp(1), second), block(udp(2), second)] for second in range(3)]
    assert flows(together) == [udp(1), udp(2)] * 3
    later = [[block(udp(1), 0)], [block(udp(2), 0.25), block(udp(1), 0.5)], [block(udp(2), 0.75)]]
    assert flows(later) == [udp(1), udp(2), udp(1), udp(2)]


def test_another_host_or_idcode_is_another_stream() -> None:
    other = udp(2, "192.0.2.2")
    assert flows([[block(udp(1), 0)], [block(other, 5)], [block(udp(3), 9, stream(8))]]) == [udp(1), other, udp(3)]


def test_one_that_comes_back_after_another_took_its_place_is_a_stream_of_its_own() -> None:
    assert flows([[block(udp(1), 0)], [block(udp(2), 5)], [block(udp(1), 6), block(udp(2), 5.5)]])[:3] == [
        udp(1),
        udp(1),
        udp(1),
    ]


def test_a_restarted_sender_and_a_changed_configuration_are_played_as_one_stream(tmp_path: Path) -> None:
    wide = stream(phasors=3, cfgcnt=1)
    parts = [block(udp(1), 0), block(udp(2), 10), block(udp(2), 20, wide)]
    for name in ("log.csv", "log.pcapng", "log.jsonl"):
        write(tmp_path / name, parts)
        place = tmp_path / name if (tmp_path / name).exists() else tmp_path / "log"
        reel = record(open_source(place).blocks(), "stamp", Window())
        assert [track.name for track in reel.tracks] == ["STATION 7"], name
        (track,) = reel.tracks
        assert track.total == track.frames == 90
        assert reel.rows.number.tolist() == list(range(90))
        assert len({reel.editions[edition].frame_size for edition in reel.rows.edition.tolist()}) == 2


def test_streams_that_overlap_stay_apart(tmp_path: Path) -> None:
    write(tmp_path / "log.pcapng", [block(udp(1), 0), block(udp(2), 0.25)])
    reel = record(open_source(tmp_path / "log.pcapng").blocks(), "stamp", Window())
    assert len(reel.tracks) == 2


def test_standard_output_goes_on_with_other_columns(capfdbinary: pytest.CaptureFixture[bytes]) -> None:
    wide = stream(phasors=2, cfgcnt=1)
    with open_sink("-", form="csv") as sink:
        sink.write(block(udp(1), 0))
        sink.write(block(udp(1), 1, wide))
    lines = capfdbinary.readouterr().out.decode().splitlines()
    headers = [number for number, line in enumerate(lines) if line.startswith("time,")]
    assert headers == [0, 31] and len(lines) == 62
    with pytest.raises(SourceError, match="several streams"), open_sink("-", form="csv") as sink:
        sink.write(block(udp(1), 0))
        sink.write(block(udp(1), 0, stream(8)))


def test_what_a_killed_run_left_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "k.parquet"
    assert keep_journal(path) is None
    for number in (1, 2):
        path.with_name("k.parquet.journal").write_bytes(b"frames")
        assert keep_journal(path) == tmp_path / f"k.left-{number}.parquet.journal"
    assert sorted(each.name for each in tmp_path.iterdir()) == ["k.left-1.parquet.journal", "k.left-2.parquet.journal"]
