"""The log survives what happens to logs: kills, full disks, cuts, rot, foreign hands and newer programs."""

from __future__ import annotations

import errno
import io
import os
import signal
import subprocess
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmutools.errors import SourceError
from pmutools.schema.descriptors import message_class
from pmutools.schema.log_reader import LogAttachment, LogMessage, LogMetadata, LogReader, LogRecord
from pmutools.schema.log_writer import LogWriter
from pmutools.timebase import NS

T0 = 1_473_354_311 * NS


def event(tick_ns: int, detail: str = "") -> bytes:
    return bytes(message_class("Event")(tick_ns=tick_ns, name="gain", detail=detail).SerializeToString())


def small_log(target: Any) -> None:
    """Five chunks of three messages, with an attachment and a metadata record between them."""
    with LogWriter(target) as log:
        log.metadata("session", {"seed": "1"})
        log.attach("dcon.ini", b"[controller]\n", T0, "text/plain")
        channel = log.channel("/dcon/event", "Event", {"unit": "none"})
        for k in range(15):
            now_ns = T0 + k * NS // 3
            log.boundary(now_ns)
            log.write(channel, event(now_ns, "x" * k), now_ns, now_ns - 1)
            if k == 7:
                log.attach("N1.cfg2", b"\xaa\x31 bytes", now_ns)


def ticks_of(records: list[LogRecord]) -> list[int]:
    return [record.log_time_ns for record in records if isinstance(record, LogMessage)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("log") / "small.mcap"
    small_log(path)
    return path.read_bytes()


def chunk_spans(data: bytes) -> list[tuple[int, int, list[int]]]:
    """(start, end, log times) of each chunk, by the mcap library's own reader."""
    from mcap.records import Chunk, ChunkIndex, Message
    from mcap.stream_reader import StreamReader, breakup_chunk

    records = list(StreamReader(io.BytesIO(data), emit_chunks=True).records)
    chunks = [record for record in records if isinstance(record, Chunk)]
    index = [record for record in records if isinstance(record, ChunkIndex)]
    return [
        (
            place.chunk_start_offset,
            place.chunk_start_offset + place.chunk_length,
            [record.log_time for record in breakup_chunk(chunk) if isinstance(record, Message)],
        )
        for chunk, place in zip(chunks, index, strict=True)
    ]


def index_end(data: bytes, chunk_end: int) -> int:
    """Where the message indexes that follow a chunk end."""
    at = chunk_end
    while data[at] == 0x07:
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    return at


def read(path: Path, data: bytes) -> tuple[list[LogRecord], LogReader]:
    path.write_bytes(data)
    reader = LogReader(path)
    records = list(reader.records())
    for record in records:
        if isinstance(record, LogMessage):
            reader.decode(record)
    return records, reader


def test_round_trip(tmp_path: Path, whole: bytes) -> None:
    records, reader = read(tmp_path / "a.mcap", whole)
    assert not reader.damage and reader.damage.lines() == []
    messages = [record for record in records if isinstance(record, LogMessage)]
    assert ticks_of(records) == [T0 + k * NS // 3 for k in range(15)]
    assert [message.publish_time_ns for message in messages] == [T0 + k * NS // 3 - 1 for k in range(15)]
    assert messages[0].channel == ("/dcon/event", "pmutools.Event", "Event", {"unit": "none"})
    decoded: list[Any] = [reader.decode(message) for message in messages]
    assert [proto.detail for proto in decoded] == ["x" * k for k in range(15)]
    rest = [(at, record) for at, record in enumerate(records) if not isinstance(record, LogMessage)]
    assert rest == [
        (0, LogMetadata("session", {"seed": "1"})),
        (1, LogAttachment("dcon.ini", "text/plain", T0, b"[controller]\n")),
        (10, LogAttachment("N1.cfg2", "application/octet-stream", T0 + 7 * NS // 3, b"\xaa\x31 bytes")),
    ]


def test_chunks_span_a_second(whole: bytes) -> None:
    assert [len(times) for _, _, times in chunk_spans(whole)] == [3, 3, 2, 3, 3, 1]


def test_wanted_messages_only(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(whole)
    reader = LogReader(path)
    assert [type(record) for record in reader.records({"Tick"})] == [LogMetadata, LogAttachment, LogAttachment]
    assert not reader.damage


def test_cut_at_every_byte(tmp_path: Path, whole: bytes) -> None:
    """Everything before the last complete chunk is read, nothing is raised, and the cut is said."""
    spans = chunk_spans(whole)
    for cut in range(8, len(whole)):
        records, reader = read(tmp_path / "cut.mcap", whole[:cut])
        assert ticks_of(records) == [time for _, end, times in spans if end <= cut for time in times], cut
        assert reader.damage.cut
        assert not reader.damage.records, cut
        assert 0 <= reader.damage.lost_bytes < cut
        assert reader.damage.lines()


def test_a_cut_inside_the_magic_is_a_one_line_error(tmp_path: Path, whole: bytes) -> None:
    for cut in range(8):
        with pytest.raises(SourceError, match="empty file" if cut == 0 else "not an MCAP file"):
            read(tmp_path / "cut.mcap", whole[:cut])


@settings(max_examples=400, deadline=None)
@given(data=st.data())
def test_rot_costs_no_more_than_the_chunk_it_hits(
    data: st.DataObject, whole: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    at = data.draw(st.integers(8, len(whole) - 1), label="at")
    flip = data.draw(st.integers(1, 255), label="flip")
    rotten = whole[:at] + bytes([whole[at] ^ flip]) + whole[at + 1 :]
    records, reader = read(tmp_path_factory.getbasetemp() / "rot.mcap", rotten)
    read_times = ticks_of(records)
    sound = [time for start, end, times in chunk_spans(whole) if not start <= at < end for time in times]
    hit = [time for start, end, times in chunk_spans(whole) if start <= at < end for time in times]
    assert [time for time in read_times if time not in hit] == sound
    if len(read_times) < 15:
        assert reader.damage.losses
        assert reader.damage.lines()


@settings(max_examples=150, deadline=None)
@given(
    holes=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 200), st.binary(max_size=60)), min_size=1, max_size=4),
    cut=st.floats(0.2, 1),
)
def test_any_damage_is_survived(
    holes: list[tuple[float, int, bytes]], cut: float, whole: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Pieces replaced by others of any length: nothing is raised, and what is read was written, in order."""
    data = whole
    for where, length, junk in holes:
        at = 8 + int(where * (len(data) - 8))
        data = data[:at] + junk + data[at + length :]
    records, _ = read(tmp_path_factory.getbasetemp() / "holes.mcap", data[: max(8, int(cut * len(data)))])
    times = ticks_of(records)
    assert set(times) <= {T0 + k * NS // 3 for k in range(15)}
    assert times == sorted(set(times))


def test_a_lost_first_chunk_takes_no_other_with_it(tmp_path: Path, whole: bytes) -> None:
    """Channels are announced in the first chunk; the second, every tenth, and the summary repeat them."""
    (_, end, times), *_ = chunk_spans(whole)
    records, reader = read(tmp_path / "a.mcap", whole[: end - 9] + bytes(9) + whole[end:])
    assert ticks_of(records) == [T0 + k * NS // 3 for k in range(len(times), 15)]
    assert reader.damage.records == 1 and reader.damage.missing == len(times) and not reader.damage.cut

    *_, (_, last_end, _) = chunk_spans(whole)
    records, reader = read(tmp_path / "b.mcap", whole[: end - 9] + bytes(9) + whole[end:last_end])
    assert ticks_of(records) == [T0 + k * NS // 3 for k in range(len(times), 15)]
    assert reader.damage.records == 1 and not reader.damage.orphans and reader.damage.cut


def long_log(path: Path) -> tuple[bytes, bytes]:
    """Forty chunks of two channels: whole, and as it was when its writer might have been killed."""
    log = LogWriter(path)
    channels = [log.channel("/dcon/event", "Event"), log.channel("/dcon/setting", "Setting")]
    for k in range(80):
        now_ns = T0 + k * NS // 2
        log.boundary(now_ns)
        log.write(channels[k % 2], event(now_ns, "x" * 400), now_ns, now_ns)
    log.flush()
    killed = path.read_bytes()
    log.close()
    return path.read_bytes(), killed


def test_announcements_are_repeated_and_any_reader_takes_them(tmp_path: Path) -> None:
    from mcap.records import Channel, Chunk
    from mcap.stream_reader import StreamReader, breakup_chunk

    data, killed = long_log(tmp_path / "a.mcap")
    chunks = [each for each in StreamReader(io.BytesIO(data), emit_chunks=True).records if isinstance(each, Chunk)]
    announcing = [
        number
        for number, chunk in enumerate(chunks)
        if [each.topic for each in breakup_chunk(chunk) if isinstance(each, Channel)]
    ]
    assert announcing == [0, 1, 10, 20, 30]
    records, reader = read(tmp_path / "a.mcap", killed)
    assert len(ticks_of(records)) == 80 and not reader.damage.losses


def test_what_lies_before_the_first_announcement_left_is_read_too(tmp_path: Path) -> None:
    data, killed = long_log(tmp_path / "a.mcap")
    spans = chunk_spans(data)
    for lost, kept in (({0, 1}, 76), (set(range(10)), 60), ({0, 1, 10, 20}, 72)):
        rotten = bytearray(killed)
        for number in lost:
            rotten[spans[number][1] - 9] ^= 1
        records, reader = read(tmp_path / "b.mcap", bytes(rotten))
        assert len(ticks_of(records)) == kept
        assert reader.damage.records == len(lost) and not reader.damage.orphans
    for number in (0, 1, 10, 20, 30):
        rotten[spans[number][1] - 9] ^= number not in {0, 1, 10, 20}
    records, reader = read(tmp_path / "c.mcap", bytes(rotten))
    assert ticks_of(records) == [] and reader.damage.orphans == 70
    assert any("unknown channel" in line for line in reader.damage.lines())


def test_flush_makes_the_log_readable_so_far(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    log = LogWriter(path)
    channel = log.channel("/dcon/event", "Event")
    log.write(channel, event(T0), T0, T0)
    log.flush()
    log.write(channel, event(T0 + 1), T0 + 1, T0 + 1)
    reader = LogReader(path)
    assert ticks_of(list(reader.records())) == [T0]
    assert reader.damage.cut and not reader.damage.losses
    log.close()
    log.close()
    assert ticks_of(list(reader.records())) == [T0, T0 + 1]
    assert not reader.damage


_KILLED = """
import sys, time
from pmutools.schema.log_writer import LogWriter
log = LogWriter(sys.argv[1])
channel = log.channel("/dcon/event", "Event")
for k in range(100):
    log.write(channel, b"", 10**9 + k, 10**9 + k)
log.flush()
log.write(channel, b"", 2 * 10**9, 2 * 10**9)
print("flushed", flush=True)
time.sleep(60)
"""


@pytest.mark.realtime
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL here")
def test_kill_9_after_a_flush_loses_nothing_before_it(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    with subprocess.Popen([sys.executable, "-c", _KILLED, str(path)], stdout=subprocess.PIPE, text=True) as writer:
        try:
            assert writer.stdout is not None and writer.stdout.readline() == "flushed\n"
        finally:
            writer.kill()
    reader = LogReader(path)
    assert ticks_of(list(reader.records())) == [NS + k for k in range(100)]
    assert reader.damage.cut and not reader.damage.losses


class FullDisk(io.BytesIO):
    """Takes ``capacity`` bytes and not one more."""

    name = "session.mcap"

    def __init__(self, capacity: int) -> None:
        super().__init__()
        self.capacity = capacity

    def write(self, data: Any, /) -> int:
        room = self.capacity - self.tell()
        super().write(bytes(data)[:room])
        if room < len(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return len(data)


def test_full_disk_anywhere_is_one_line_and_what_was_flushed_is_readable(tmp_path: Path, whole: bytes) -> None:
    spans = chunk_spans(whole)
    ends = [index_end(whole, end) for _, end, _ in spans]
    for capacity in range(0, len(whole), 7):
        disk = FullDisk(capacity)
        with pytest.raises(SourceError, match=r"^session\.mcap: cannot write: No space left on device$"):
            small_log(disk)
        if disk.getvalue():  # else not even the header found room
            records, _ = read(tmp_path / "full.mcap", disk.getvalue())
            expected = [t for end, (_, _, times) in zip(ends, spans, strict=True) if end <= capacity for t in times]
            assert ticks_of(records) == expected


def test_after_a_failure_the_log_takes_nothing_more() -> None:
    log = LogWriter(FullDisk(200))
    channel = log.channel("/dcon/event", "Event")
    log.write(channel, event(T0), T0, T0)
    with pytest.raises(SourceError):
        log.flush()
    with pytest.raises(SourceError):
        log.write(channel, event(T0), T0, T0)
    with pytest.raises(SourceError):
        log.attach("a", b"")
    log.close()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_full_device() -> None:
    with pytest.raises(SourceError, match="No space left on device"):
        small_log("/dev/full")


def test_unwritable_path_is_a_one_line_error(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"nowhere/a\.mcap: cannot write: No such file or directory"):
        LogWriter(tmp_path / "nowhere" / "a.mcap")
    with pytest.raises(SourceError, match="cannot write: Is a directory"):
        LogWriter(tmp_path)


def test_files_that_are_no_log(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="No such file"):
        LogReader(tmp_path / "none.mcap")
    (tmp_path / "empty.mcap").touch()
    with pytest.raises(SourceError, match=r"empty\.mcap: empty file"):
        LogReader(tmp_path / "empty.mcap")
    (tmp_path / "a.mcap").write_bytes(b"\xd4\xc3\xb2\xa1" * 10)
    with pytest.raises(SourceError, match="not an MCAP file"):
        LogReader(tmp_path / "a.mcap")


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
@pytest.mark.parametrize("chunked", [True, False])
def test_foreign_logs(tmp_path: Path, compression: str, chunked: bool) -> None:
    """Other tools' schemas, encodings and chunking: passed through undecoded."""
    from mcap.writer import CompressionType, Writer

    path = tmp_path / "foreign.mcap"
    with path.open("wb") as file:
        writer: Any = Writer(file, compression=CompressionType[compression], use_chunking=chunked)
        writer.start(profile="ros2")
        image = writer.register_schema("pmutools.Tick", "ros2msg", b"uint8 x")
        for number, (topic, schema) in enumerate((("/camera", image), ("/raw", 0))):
            channel = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channel, number + 5, b"\x00\x01", number)
        writer.finish()
    reader = LogReader(path)
    messages = [record for record in reader.records() if isinstance(record, LogMessage)]
    assert [(message.channel.topic, message.channel.schema) for message in messages] == [
        ("/camera", "ros2msg:pmutools.Tick"),
        ("/raw", ""),
    ]
    assert [reader.decode(message) for message in messages] == [None, None]
    assert not reader.damage
    assert list(reader.records({"Tick"})) == []


def test_a_newer_log_is_read_as_far_as_it_is_known(tmp_path: Path) -> None:
    """Unknown topics, fields appended to known messages, unknown record types."""
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
    from mcap.writer import Writer

    from pmutools.schema.descriptors import file_descriptor_set

    newer = FileDescriptorSet.FromString(file_descriptor_set())
    tick = next(message for message in newer.file[0].message_type if message.name == "Event")
    tick.field.add(name="added", number=99, type=FieldDescriptorProto.TYPE_STRING, label=1)
    path = tmp_path / "newer.mcap"
    with path.open("wb") as file:
        writer: Any = Writer(file)
        writer.start()
        schema = writer.register_schema("pmutools.Event", "protobuf", newer.SerializeToString())
        novel = writer.register_schema("pmutools.Novelty", "protobuf", newer.SerializeToString())
        data = event(T0) + b"\x9a\x06\x03new"  # field 99, length-delimited
        writer.add_message(writer.register_channel("/dcon/event", "protobuf", schema), T0, data, T0)
        writer.add_message(writer.register_channel("/dcon/novelty", "protobuf", novel), T0, b"\x08\x01", T0)
        writer.flush()
        file.write(b"\x90" + (3).to_bytes(8, "little") + b"own")  # a private record
        writer.finish()
    reader = LogReader(path)
    known, unknown = [record for record in reader.records() if isinstance(record, LogMessage)]
    decoded: Any = reader.decode(known)
    assert decoded.tick_ns == T0
    assert (unknown.channel.topic, unknown.channel.message) == ("/dcon/novelty", None)
    assert reader.decode(unknown) is None
    assert not reader.damage


def test_a_message_that_is_not_what_its_schema_says_is_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with LogWriter(path) as log:
        log.write(log.channel("/dcon/event", "Event"), b"\xff\xff\xff", T0, T0)
    reader = LogReader(path)
    (message,) = reader.records()
    assert isinstance(message, LogMessage)
    assert reader.decode(message) is None
    assert reader.damage.undecodable == 1 and "do not decode" in reader.damage.lines()[0]


def test_memory_is_bounded_by_a_chunk(tmp_path: Path) -> None:
    path = tmp_path / "long.mcap"
    chunk = bytes(range(256)) * (1 << 12)
    tracemalloc.start()
    try:
        with LogWriter(path) as log:
            channel = log.channel("/dcon/event", "Event")
            for k in range(40):
                log.write(channel, chunk + bytes([k]), T0 + k * NS, T0)
                log.boundary(T0 + (k + 1) * NS)
        assert sum(1 for _ in LogReader(path).records()) == 40
        assert tracemalloc.get_traced_memory()[1] < 8 * len(chunk)
    finally:
        tracemalloc.stop()


def test_the_mcap_library_reads_it(tmp_path: Path, whole: bytes) -> None:
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    reader = make_reader(io.BytesIO(whole), decoder_factories=[DecoderFactory()])
    decoded = [(channel.topic, proto.tick_ns) for _, channel, _, proto in reader.iter_decoded_messages()]
    assert decoded == [("/dcon/event", T0 + k * NS // 3) for k in range(15)]
    assert [attachment.name for attachment in reader.iter_attachments()] == ["dcon.ini", "N1.cfg2"]
    assert [metadata.metadata for metadata in reader.iter_metadata()] == [{"seed": "1"}]
    summary = reader.get_summary()
    assert summary is not None and summary.statistics is not None
    assert summary.statistics.message_count == 15 and summary.statistics.chunk_count == 6
