"""The reader: everything that came is in the file or counted, also at the very end."""

from __future__ import annotations

import random
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import pytest
from support.frames import random_stream
from support.playing import recording, stream
from support.recordings import blocks_of

from pmutools import linux
from pmutools.c37118 import FrameType, Message
from pmutools.clock import SystemClock, VirtualClock
from pmutools.errors import SettingsError, SourceError
from pmutools.formats import open_sink, open_source
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.timebase import NS
from pmutools.tools.inventory import take_inventory
from pmutools.tools.live import LiveSource
from pmutools.tools.reader import Reading, read

pytestmark = pytest.mark.realtime


@contextmanager
def listening(source: LiveSource) -> Iterator[socket.socket]:
    """A socket whose datagrams go to the first endpoint of ``source``."""
    local = source.receivers.local(0)
    assert local is not None
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind(("127.0.0.1", 0))
        sender.connect(("127.0.0.1", local.port))
        yield sender


def frames_of(messages: list[Message]) -> list[bytes]:
    return [message.frame.data for message in messages]


def frames_in(path: Path) -> int:
    return sum(len(block.batch) for block in blocks_of(open_source(path)))


def read_all(source: LiveSource, out: Path) -> Reading:
    with source, open_sink(out) as sink:
        return read(source, sink)


def test_what_has_arrived_when_told_to_stop_is_still_logged(tmp_path: Path) -> None:
    source = LiveSource(["udp://127.0.0.1:0"], stop=lambda: True)
    with listening(source) as sender:
        for frame in frames_of(recording(stream(), 100)):
            sender.send(frame)
        reading = read_all(source, tmp_path / "log.csv")
    assert reading.frames == frames_in(tmp_path / "log.csv") == 100


def test_datagrams_that_this_machine_lost_are_counted_and_not_blamed_on_the_network(tmp_path: Path) -> None:
    """More than the buffer holds, while nobody reads; the end comes before the next regular look."""
    if not linux.NATIVE:
        pytest.skip("this system does not tell how many datagrams it drops")
    source = LiveSource(["udp://127.0.0.1:0"], stop=lambda: True, rcvbuf_bytes=16 << 10)
    frames = frames_of(recording(stream(), 2000))
    with listening(source) as sender:
        for frame in frames:
            sender.send(frame)
        reading = read_all(source, tmp_path / "log.csv")
    assert reading.own_drops > 0
    assert reading.frames + 1 + reading.own_drops == len(frames), "the configuration came first"
    assert source.defects() == {"datagrams lost in this machine's receive buffer": reading.own_drops}
    assert reading.to_json()["own_drops"] == reading.own_drops


def test_streams_that_nobody_asked_for_are_neither_logged_nor_a_loss(tmp_path: Path) -> None:
    """Also where their configurations never come."""
    news: list[LinkEvent] = []
    source = LiveSource(["udp://127.0.0.1:0?idcode=2"], stop=lambda: bool(news) and len(news) > 1, tell=news.append)
    with listening(source) as sender:
        for messages in (recording(stream(1), 20, announced=False), recording(stream(2), 20), recording(stream(3), 20)):
            for frame in frames_of(messages):
                sender.send(frame)
        reading = read_all(source, tmp_path / "log.csv")
    assert (reading.frames, dict(reading.skipped)) == (20, {})
    tally = source.tally
    assert tally.fed == tally.framed + tally.ignored + tally.skipped_bytes
    assert {event.idcode for event in news if event.kind is LinkKind.FOREIGN} == {1, 3}


def test_data_that_wait_for_a_configuration_are_logged_once_it_comes(tmp_path: Path) -> None:
    config, *data = frames_of(recording(stream(), 50))
    source = LiveSource(["udp://127.0.0.1:0"], stop=lambda: source.tally.frames.get(FrameType.DATA, 0) == 50)
    with listening(source) as sender:
        for frame in (*data[:30], config, *data[30:]):
            sender.send(frame)
        reading = read_all(source, tmp_path / "log.mcap")
    assert (reading.frames, dict(reading.skipped)) == (50, {})
    assert frames_in(tmp_path / "log.mcap") == 50


def test_the_end_comes_after_the_duration_and_progress_every_second() -> None:
    """In virtual time: the clock passes only while nothing is to be read."""
    clock, told = VirtualClock(), list[int]()
    source = LiveSource(["udp://127.0.0.1:0"], duration_ns=10 * NS, clock=clock)
    with source, open_sink("-") as sink:
        read(source, sink, lambda reading: told.append(clock.monotonic_ns()))
    assert clock.monotonic_ns() == 10 * NS
    assert len(told) == 10
    assert all(NS <= after - before <= NS + NS // 10 for before, after in pairwise(told))


def test_rows_can_be_read_while_reading_goes_on(tmp_path: Path) -> None:
    out, seen = tmp_path / "log.csv", list[int]()
    clock = VirtualClock()
    source = LiveSource(["udp://127.0.0.1:0"], duration_ns=3 * NS, clock=clock)
    with listening(source) as sender, source, open_sink(out) as sink:
        for frame in frames_of(recording(stream(), 25)):
            sender.send(frame)
        read(source, sink, lambda reading: seen.append(frames_in(out)))
    assert seen == [25, 25, 25]


def test_many_stations_and_formats_in_one_datagram_stream(tmp_path: Path) -> None:
    described = random_stream(random.Random(5), stations=3, frames=20, data_rate=50, time_base=1_000_000)
    source = LiveSource(["udp://127.0.0.1:0"], stop=lambda: source.tally.frames.get(FrameType.DATA, 0) == 20)
    with listening(source) as sender:
        sender.send(described.config() + described.data[0])  # several frames in one datagram
        for frame in described.data[1:]:
            sender.send(frame)
        reading = read_all(source, tmp_path / "log.parquet")
    assert reading.frames == 20
    (one,) = take_inventory(open_source(tmp_path / "log.parquet")).streams
    assert (one.idcode, one.frames, len(one.config.stations)) == (described.spec.idcode, 20, 3)


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".arrow", ".mcap", ".pcap", ".c37118"])
def test_nothing_is_written_where_nothing_came(suffix: str, tmp_path: Path) -> None:
    out = tmp_path / f"log{suffix}"
    reading = read_all(LiveSource(["udp://127.0.0.1:0"], stop=lambda: True), out)
    assert reading.frames == 0
    if suffix in (".csv", ".parquet", ".arrow"):
        assert not out.exists()


def test_what_cannot_be_opened_is_told_at_once(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="no port"):
        LiveSource(["udp://127.0.0.1"])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(SourceError, match="already in use"):
            LiveSource([f"udp://127.0.0.1:{taken.getsockname()[1]}"])
    for suffix in (".csv", ".parquet", ".arrow", ".mcap", ".pcap", ".pcapng", ".c37118"):
        with pytest.raises(SourceError, match=r"cannot write|No such file"), open_sink(tmp_path / "no" / f"x{suffix}"):
            pass


def test_a_reader_and_a_stream_that_comes_again_under_the_same_address(tmp_path: Path) -> None:
    """A device that starts anew with another configuration: two tables, nothing mixed."""
    first, second = stream(7), stream(7, name="NEW", cfgcnt=1)
    source = LiveSource(["udp://127.0.0.1:0"], stop=lambda: source.tally.frames.get(FrameType.DATA, 0) == 20)
    with listening(source) as sender:
        for frame in frames_of(recording(first, 10)) + frames_of(recording(second, 10)):
            sender.send(frame)
        with source, open_sink(tmp_path / "log.csv") as sink:
            reading = read(source, sink)
    assert reading.frames == 20
    assert [frames_in(path) for path in sink.paths] == [10, 10]


def test_iterating_a_live_source_gives_blocks_with_kernel_stamps() -> None:
    clock = SystemClock()
    began_ns = clock.realtime_ns()
    source = LiveSource(["udp://127.0.0.1:0"], stop=lambda: source.tally.frames.get(FrameType.DATA, 0) == 10)
    with source, listening(source) as sender:
        for frame in frames_of(recording(stream(), 10)):
            sender.send(frame)
        blocks = blocks_of(source)
    arrivals = [ns for block in blocks for ns in block.batch.arrival_ns.tolist()]
    assert len(arrivals) == 10
    assert all(began_ns - NS < ns <= clock.realtime_ns() for ns in arrivals)
