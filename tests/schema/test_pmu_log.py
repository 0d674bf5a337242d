"""PMU frames through a log: wire bytes, arrivals and values, and the way back to what plays."""

from __future__ import annotations

import random
import struct
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from support.frames import Described, random_stream, streams

from pmutools.c37118 import Demux, Frame, Message, decode_config, decode_data
from pmutools.flow import Chunk, Flow, StampSource
from pmutools.schema.log_reader import LogMessage, LogReader
from pmutools.schema.log_writer import LogWriter
from pmutools.schema.pmu_log import PmuFrame, PmuTopics, WireFrame, from_message, iter_pmu_frames, name_of, pmu_frame
from pmutools.timebase import NS

ARRIVAL = 1_473_354_311 * NS


def frames_of(stream: Described, name: str) -> list[PmuFrame]:
    _, config = decode_config(stream.config("cfg2"))
    return [
        pmu_frame(
            name,
            Frame(wire, ARRIVAL + k, StampSource.KERNEL, 0),
            decode_data(wire, config),
            v1=complex(k, -0.0),
        )
        for k, wire in enumerate(stream.data)
    ]


def write(path: Path, name: str, stream: Described, frames: list[PmuFrame]) -> None:
    with LogWriter(path) as log:
        pmus = PmuTopics(log)
        pmus.config(name, stream.config("cfg2"), ARRIVAL)
        for frame in frames:
            pmus.write(frame)


def packed(frame: PmuFrame) -> tuple[object, ...]:
    """The frame with every float as its bits."""

    def bits(value: object) -> object:
        if isinstance(value, float):
            return struct.pack(">d", value)
        if isinstance(value, complex):
            return struct.pack(">dd", value.real, value.imag)
        return tuple(map(bits, value)) if isinstance(value, tuple) else value

    return tuple(map(bits, frame))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(stream=streams())
def test_frames_come_back_bit_for_bit(stream: Described, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.getbasetemp() / "pmu.mcap"
    name = "A/B c"
    frames = frames_of(stream, name)
    write(path, name, stream, frames)

    reader = LogReader(path)
    messages = [record for record in reader.records() if isinstance(record, LogMessage)]
    back = [from_message(name_of(message.channel.topic), reader.decode(message)) for message in messages]
    assert [packed(frame) for frame in back] == [packed(frame) for frame in frames]
    assert [message.log_time_ns for message in messages] == [frame.arrival_ns for frame in frames]
    assert [message.publish_time_ns for message in messages] == [max(frame.time_ns, 0) for frame in frames]

    config = WireFrame(name, stream.config("cfg2"), ARRIVAL, StampSource.CAPTURE)
    wires = [WireFrame(name, wire, ARRIVAL + k, StampSource.KERNEL) for k, wire in enumerate(stream.data)]
    assert list(iter_pmu_frames(path)) == [config, *wires]


def test_what_is_read_back_plays(tmp_path: Path) -> None:
    """Configurations, old and new, come before the data they explain: a demultiplexer wants nothing else."""
    old, new = (random_stream(random.Random(seed), frames=5) for seed in (1, 2))
    path = tmp_path / "two.mcap"
    with LogWriter(path) as log:
        pmus = PmuTopics(log)
        for stream in (old, new):
            pmus.config("N1", stream.config("cfg2"), ARRIVAL)
            for frame in frames_of(stream, "N1"):
                pmus.write(frame)
    demux = Demux()
    flow = Flow("file", str(path))
    items = [
        item
        for frame in iter_pmu_frames(path)
        for item in demux.feed(Chunk(frame.wire, frame.arrival_ns, flow, frame.stamp_source))
    ] + demux.close()
    assert all(isinstance(item, Message) for item in items)
    data = [item for item in items if isinstance(item, Message) and item.frame.type == 0]
    assert [bytes(item.frame.data) for item in data] == [*old.data, *new.data]
    assert [item.config for item in data] == [decode_config(old.config("cfg2"))[1]] * 5 + [
        decode_config(new.config("cfg2"))[1]
    ] * 5


def test_a_frame_without_an_arrival(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with LogWriter(path) as log:
        PmuTopics(log).write(PmuFrame("N1", b"\xaa\x01", NS, None, StampSource.CAPTURE, 0, 0, 60.0))
    (record,) = LogReader(path).records()
    assert isinstance(record, LogMessage) and record.log_time_ns == NS
    assert list(iter_pmu_frames(path)) == [WireFrame("N1", b"\xaa\x01", None, StampSource.CAPTURE)]


def test_channel_metadata_names_the_places_in_the_lists(tmp_path: Path) -> None:
    stream = random_stream(random.Random(3), frames=1)
    write(tmp_path / "a.mcap", "N1", stream, frames_of(stream, "N1"))
    (message,) = (r for r in LogReader(tmp_path / "a.mcap").records() if isinstance(r, LogMessage))
    _, config = decode_config(stream.config("cfg2"))
    channels = [
        f"{station.name}.{phasor.name} [{phasor.kind}]" for station in config.stations for phasor in station.phasors
    ]
    assert message.channel.topic == "/pmu/N1/frame"
    assert message.channel.metadata["idcode"] == str(config.idcode)
    assert message.channel.metadata["phasors"] == ", ".join(channels)


def test_any_reader_decodes_the_frames(tmp_path: Path) -> None:
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    stream = random_stream(random.Random(4), frames=8)
    path = tmp_path / "a.mcap"
    write(path, "N1", stream, frames_of(stream, "N1"))
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        decoded = [proto for _, _, _, proto in reader.iter_decoded_messages()]
        assert [proto.wire for proto in decoded] == list(stream.data)
        assert [attachment.data for attachment in reader.iter_attachments()] == [stream.config("cfg2")]
