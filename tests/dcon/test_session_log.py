"""Session logs: what a tick was given and decided comes back bit for bit, or its loss is said."""

from __future__ import annotations

import errno
import io
import os
import random
import signal
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from support.random_sessions import FOUR
from support.sessions import (
    CONFIGS,
    FLAGS,
    HEAD,
    INI,
    INSTANCES,
    METADATA,
    PERIOD_NS,
    PMUS,
    T0,
    bits,
    log_tick,
    log_watchdog,
    open_session,
    random_ticks,
    write_session,
    write_tick,
)

import pmutools
from dcon.core.state import initial_state
from dcon.core.values import Inputs, Sample
from dcon.engine import Memory
from dcon.link.bundle import Entry
from dcon.session.checkpoint import encode_checkpoint
from dcon.session.codec import Watchdog
from dcon.session.encode import tick_entries
from dcon.session.reader import LoggedTick, SessionReader
from dcon.session.writer import SessionWriter
from pmutools.errors import SourceError
from pmutools.schema.log_writer import LogWriter
from pmutools.schema.messages import MESSAGES
from pmutools.schema.pmu_log import PmuFrame, PmuTopics


def strip(tick: LoggedTick) -> object:
    """The logged tick as :class:`support.sessions.Tick` has it, floats as bits."""
    return bits((tick.record, tick.frames, tick.orders, tick.timing, tick.pdci, tick.surroundings))


def test_round_trip_bit_for_bit(tmp_path: Path) -> None:
    ticks = random_ticks(300)
    reader = SessionReader(write_session(tmp_path / "s.mcap", ticks))
    back = list(reader.ticks())
    assert [strip(tick) for tick in back] == [bits(tuple(tick)) for tick in ticks]
    assert not any(tick.after_loss for tick in back)
    assert not reader.damage and not reader.incomplete_ticks
    for tick in back:
        assert type(tick.record.state).__name__ == "SystemState"
        assert type(tick.record.instances[0].state).__name__ == "InstanceState"


def test_head(tmp_path: Path) -> None:
    reader = SessionReader(write_session(tmp_path / "s.mcap", random_ticks(3)))
    assert (reader.pmus, reader.instances, reader.flags) == (PMUS, INSTANCES, FLAGS)
    assert reader.ini_text == INI
    assert reader.configs == CONFIGS
    assert METADATA.items() <= reader.metadata.items()
    assert reader.metadata["version"] == pmutools.__version__


def test_inputs_are_grouped_by_tick_and_pmu_in_order_of_arrival(tmp_path: Path) -> None:
    ticks = random_ticks(100)
    reader = SessionReader(write_session(tmp_path / "s.mcap", ticks))
    for tick, logged in zip(ticks, reader.ticks(), strict=True):
        expected = tuple(
            tuple(
                Sample(f.time_ns, f.arrival_ns or 0, f.v1, f.frequency_hz, f.stat, f.time_quality, f.time_base)
                for f in tick.frames
                if f.name == name
            )
            for name in PMUS
        )
        assert bits(logged.inputs(PMUS)) == bits(Inputs(expected, tick.orders, tick.surroundings))
        assert logged.inputs(("S2", "absent")).samples[1] == ()


def test_frames_that_no_tick_consumed_are_not_inputs(tmp_path: Path) -> None:
    ticks = random_ticks(2)
    path = tmp_path / "s.mcap"
    with open_session(path) as session:
        log_tick(session, ticks[0].record, ticks[0].frames)
        stray = PmuFrame("N9", b"", T0, T0, ticks[0].frames[0].stamp_source, 0, 0, 60.0)
        session._pmus.write(stray)
        log_tick(session, ticks[1].record, ticks[1].frames)
    assert [len(tick.frames) for tick in SessionReader(path).ticks()] == [len(tick.frames) for tick in ticks]


def test_every_topic_is_decoded_by_any_mcap_reader(tmp_path: Path) -> None:
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    path = tmp_path / "s.mcap"
    ticks = random_ticks(200)
    with open_session(path) as session:
        log_watchdog(session, Watchdog(T0, False, estop=True, reason="E-stop", heartbeats=(("control", 3.5),)))
        memory = encode_checkpoint(T0, Memory(initial_state(FOUR), (), ()))
        session.write([Entry("Checkpoint", "", memory or b"", T0, T0)], T0)
        for tick in ticks:
            write_tick(session, tick)
    seen: dict[str, int] = {}
    with path.open("rb") as file:
        for schema, channel, message, proto in make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages(log_time_order=False):
            assert schema is not None and schema.encoding == channel.message_encoding == "protobuf"
            seen[channel.topic] = seen.get(channel.topic, 0) + 1
            if channel.topic.startswith("/pmu/"):
                assert (message.log_time, message.publish_time) == (proto.arrival_ns, proto.time_ns)
            elif channel.topic == "/dcon/watchdog":
                assert (proto.estop, list(proto.heartbeat), list(proto.heartbeat_age_ms)) == (True, ["control"], [3.5])
            else:
                assert message.log_time == proto.tick_ns
    topics = {message.topic for message in MESSAGES.values() if message.topic.startswith("/dcon/")}
    assert set(seen) == topics | {f"/pmu/{name}/frame" for name in PMUS}
    assert seen["/dcon/tick"] == seen["/dcon/instance"] == len(ticks)
    assert seen["/dcon/setting"] == sum(len(tick.orders) for tick in ticks)
    assert seen["/dcon/event"] == sum(len(tick.record.events) for tick in ticks)


def test_a_cut_anywhere_loses_the_end_only_and_says_so(tmp_path: Path) -> None:
    """To the last tick of the last whole chunk, which spans a second."""
    from mcap.records import ChunkIndex
    from mcap.stream_reader import StreamReader

    ticks = random_ticks(150)
    path = write_session(tmp_path / "s.mcap", ticks)
    data = path.read_bytes()
    expected = [bits(tuple(tick)) for tick in ticks]
    index = [record for record in StreamReader(io.BytesIO(data)).records if isinstance(record, ChunkIndex)]
    ends = [record.chunk_start_offset + record.chunk_length for record in index]
    cuts = {end + by for end in ends for by in range(-3, 4)} | set(random.Random(1).sample(range(len(data)), 40))
    counts: dict[int, set[int]] = {}
    for cut in sorted(cuts):
        path.write_bytes(data[:cut])
        try:
            reader = SessionReader(path)
        except SourceError:
            assert cut < data.index(INI.encode())  # not even the metadata are whole
            continue
        back = list(reader.ticks())
        assert [strip(tick) for tick in back] == expected[: len(back)], cut
        counts.setdefault(sum(end <= cut for end in ends), set()).add(len(back))
        assert reader.damage.cut and not any(tick.after_loss for tick in back)
        assert reader.incomplete_ticks == 0, "chunks end between ticks"
    of_chunks = [counts[number].pop() for number in range(len(ends) + 1)]
    assert not any(counts.values()), "what is read depends on the whole chunks alone"
    assert of_chunks[0] == 0 and of_chunks[-1] == 150
    assert all(58 <= b - a <= 60 for a, b in pairwise(of_chunks[:-1]))


def test_rot_loses_whole_ticks_and_marks_the_first_after_them(tmp_path: Path) -> None:
    ticks = random_ticks(240)
    path = write_session(tmp_path / "s.mcap", ticks)
    data = path.read_bytes()
    at = data.index(b"\x04\x00\x00\x00zstd", len(data) // 4) + 500  # inside a chunk of the middle
    path.write_bytes(data[:at] + b"rot" + data[at + 3 :])
    reader = SessionReader(path)
    back = list(reader.ticks())
    assert 178 <= len(back) <= 182, "a chunk is a second"
    after = [tick.record.tick_ns for tick in back if tick.after_loss]
    assert len(after) == 1
    gaps = [b.record.tick_ns for a, b in pairwise(back) if b.record.tick_ns - a.record.tick_ns > PERIOD_NS]
    assert gaps == after
    assert reader.damage.records == 1 and not reader.damage.cut


TIMES = range(9, 25)
"""Bytes of a chunk that hold the times of its first and last message, which a reader of all of it has no use for."""


def test_a_flipped_bit_in_a_log_of_a_killed_process_loses_the_chunk_it_hits_and_no_more(tmp_path: Path) -> None:
    from mcap.records import ChunkIndex
    from mcap.stream_reader import StreamReader

    ticks = random_ticks(60 * 13)
    path = write_session(tmp_path / "s.mcap", ticks)
    data = path.read_bytes()
    index = [record for record in StreamReader(io.BytesIO(data)).records if isinstance(record, ChunkIndex)]
    spans = [(record.chunk_start_offset, record.chunk_start_offset + record.chunk_length) for record in index]
    starts = [range(record.message_start_time, record.message_end_time + 1) for record in index]
    killed = data[: spans[-1][1]]
    chosen = random.Random(4)
    early = [chosen.randrange(*spans[0]), chosen.randrange(*spans[1])]
    for at in (*early, *(chosen.randrange(8, len(killed)) for _ in range(98))):
        rotten = bytearray(killed)
        rotten[at] ^= 1 << chosen.randrange(8)
        path.write_bytes(rotten)
        reader = SessionReader(path)
        seen = {message.tick_ns for message in reader.groups({"Tick"}) if message.one("Tick") is not None}
        hit = [span for (start, end), span in zip(spans, starts, strict=True) if start <= at < end]
        missing = {tick.record.tick_ns for tick in ticks} - seen
        assert all(any(tick_ns in span for span in hit) for tick_ns in missing), at
        told = any(start <= at < end and at - start not in TIMES for start, end in spans)
        assert not reader.damage.orphans and told <= bool(reader.damage.losses)
        assert bool(missing) <= bool(reader.damage.losses)


def test_a_damaged_head_does_not_hide_the_session(tmp_path: Path) -> None:
    ticks = random_ticks(120)
    path = write_session(tmp_path / "s.mcap", ticks)
    data = bytearray(path.read_bytes())
    at = data.index(b"dcon.ini")  # metadata, INI and configurations lie between the header and the first chunk
    data[40:at] = bytes(at - 40)
    path.write_bytes(bytes(data))
    reader = SessionReader(path)
    assert (reader.pmus, reader.instances, reader.flags) == (PMUS, INSTANCES, FLAGS)
    assert [strip(tick) for tick in reader.ticks()] == [bits(tuple(tick)) for tick in ticks]
    assert reader.damage


def test_a_tick_of_which_a_part_is_missing_is_counted_and_left_out(tmp_path: Path) -> None:

    ticks = random_ticks(3)
    path = tmp_path / "s.mcap"
    with open_session(path) as session:
        log_tick(session, ticks[0].record)
        whole = tick_entries(INSTANCES, ticks[1].record)
        session.write([entry for entry in whole if entry.message == "Tick"], ticks[1].record.tick_ns)
        log_tick(session, ticks[2].record)
    reader = SessionReader(path)
    assert [(tick.record.tick_ns, tick.after_loss) for tick in reader.ticks()] == [
        (T0, False),
        (T0 + 2 * PERIOD_NS, True),
    ]
    assert reader.incomplete_ticks == 1


def test_a_state_of_a_newer_version_is_counted_and_left_out(tmp_path: Path) -> None:
    record = random_ticks(1)[0].record
    path = tmp_path / "s.mcap"
    with open_session(path) as session:
        log_tick(session, record._replace(state="HIBERNATING"))  # type: ignore[arg-type]
    reader = SessionReader(path)
    assert list(reader.ticks()) == []
    assert reader.incomplete_ticks == 1


def test_files_that_are_no_session(tmp_path: Path) -> None:
    path = tmp_path / "pmu.mcap"
    with LogWriter(path) as log:
        PmuTopics(log).config("N1", b"\xaa\x31")
    with pytest.raises(SourceError, match=r"pmu\.mcap: not a session log"):
        SessionReader(path)
    path.write_bytes(b"time,f\n")
    with pytest.raises(SourceError, match="not an MCAP file"):
        SessionReader(path)


def test_a_session_that_ended_before_its_first_tick(tmp_path: Path) -> None:
    reader = SessionReader(write_session(tmp_path / "s.mcap", []))
    assert (reader.pmus, reader.ini_text) == (PMUS, INI)
    assert list(reader.ticks()) == []


def test_a_configuration_that_comes_later(tmp_path: Path) -> None:
    ticks = random_ticks(4)
    path = tmp_path / "s.mcap"
    with open_session(path) as session:
        for tick in ticks[:2]:
            log_tick(session, tick.record, tick.frames)
        session.config("N1", b"\xaa\x31 new", ticks[2].record.tick_ns)
        for tick in ticks[2:]:
            log_tick(session, tick.record, tick.frames)
    reader = SessionReader(path)
    assert reader.configs["N1"] == CONFIGS["N1"]
    assert [tick.record.tick_ns for tick in reader.ticks()] == [tick.record.tick_ns for tick in ticks]


def test_a_tick_before_1970_is_our_callers_mistake(tmp_path: Path) -> None:
    with open_session(tmp_path / "s.mcap") as session, pytest.raises(ValueError, match="tick_ns is 0"):
        log_tick(session, random_ticks(1)[0].record._replace(tick_ns=0))


class FullDisk(io.BytesIO):
    def write(self, data: Any, /) -> int:
        if self.tell() + len(data) > 50_000:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(data)


def test_a_full_disk_is_one_line_and_leaves_what_was_flushed(tmp_path: Path) -> None:
    disk = FullDisk()
    ticks = random_ticks(600)
    session = SessionWriter(disk, HEAD, CONFIGS)
    with pytest.raises(SourceError, match="cannot write: No space left on device"), session:
        for tick in ticks:
            log_tick(session, tick.record, tick.frames)
    path = tmp_path / "s.mcap"
    path.write_bytes(disk.getvalue())
    reader = SessionReader(path)
    back = list(reader.ticks())
    assert 0 < len(back) < 600 and reader.incomplete_ticks == 0
    assert [tick.record.tick_ns for tick in back] == [tick.record.tick_ns for tick in ticks[: len(back)]]
    assert reader.damage.cut


_KILLED = """
import sys, time
from pathlib import Path
from support.sessions import open_session, random_ticks, write_tick
session = open_session(Path(sys.argv[1]))
ticks = random_ticks(200)
for tick in ticks[:130]:
    write_tick(session, tick)
session.flush()
for tick in ticks[130:]:
    write_tick(session, tick)
print("flushed", flush=True)
time.sleep(60)
"""


@pytest.mark.realtime
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL here")
def test_kill_9_leaves_everything_up_to_the_flush(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    tests = Path(__file__).parents[1]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(tests), str(tests.parent)))}
    command = [sys.executable, "-c", _KILLED, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as writer:
        try:
            assert writer.stdout is not None and writer.stdout.readline() == "flushed\n"
        finally:
            writer.kill()
    reader = SessionReader(path)
    back = [strip(tick) for tick in reader.ticks()]
    assert len(back) >= 130
    assert back == [bits(tuple(tick)) for tick in random_ticks(200)[: len(back)]]
    assert reader.damage.cut
