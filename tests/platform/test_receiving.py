"""From datagrams to frames of the settings' PMUs: a configuration that cannot be handed on is a refusal, no end."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from support.virtual_platform import FLOWS, STREAMS, Clock, Script

from dcon.front.receiving import Reception
from dcon.link.crossing import Item, PmuFrameIn
from pmutools.c37118 import FrameType, StreamConfig
from pmutools.c37118.checksum import chk
from pmutools.c37118.config import PhasorChannel, encode_config
from pmutools.flow import Chunk, StampSource
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.timebase import NS


def long_config(phasors: int = 300) -> StreamConfig:
    """CFG-3 of N1; each of its phasors takes more than 255 bytes of it."""
    config = STREAMS.configs["N1"]
    channels = tuple(PhasorChannel(f"{number:0255d}") for number in range(phasors))
    station = replace(config.stations[0], phasors=channels)
    return replace(config, stations=(station,), kind=FrameType.CFG3)


def fragments(config: StreamConfig) -> list[bytes]:
    """Frames of at most 50,000 bytes of it, each with CONT_IDX and CHK."""
    body = config.body[2:]
    parts = [body[at : at + 50_000] for at in range(0, len(body), 50_000)]
    out = []
    for number, part in enumerate(parts, 1):
        head = (config.kind.sync & 0xFFF0 | config.version).to_bytes(2, "big") + (18 + len(part)).to_bytes(2, "big")
        index = 0xFFFF if number == len(parts) else number
        frame = head + config.idcode.to_bytes(2, "big") + bytes(8) + index.to_bytes(2, "big") + part
        out.append(frame + chk(frame).to_bytes(2, "big"))
    return out


class Rig:
    def __init__(self) -> None:
        self.reception = Reception(Script(Clock()))  # type: ignore[arg-type]

    def __call__(self, *frames: bytes) -> list[Item]:
        found: list[Item] = []
        chunks = [Chunk(frame, 1, FLOWS["N1"], StampSource.KERNEL) for frame in frames]
        self.reception.parse(chunks, found.append)
        return found


def test_a_configuration_of_several_frames_is_handed_on_as_one() -> None:
    config = long_config(200)
    (item,) = Rig()(*fragments(config))
    assert isinstance(item, PmuFrameIn) and item.is_config and item.frame.data == encode_config(config)


def test_one_longer_than_a_frame_is_refused_and_told_and_its_data_are_no_more_read_as_another_s() -> None:
    rig = Rig()
    short, data = STREAMS.configs["N1"], STREAMS.data("N1", STREAMS.stamp_ns(0))
    assert [getattr(item, "is_config", None) for item in rig(encode_config(short), data)] == [True, False]
    (event,) = rig(*fragments(long_config()))
    assert isinstance(event, LinkEvent) and event.kind is LinkKind.NO_CONFIG and event.owners == (0,)
    assert "bytes, which is more than the 65535 of a frame; it is refused" in event.detail
    assert rig.reception.counts.undecodable == 1
    assert rig(*fragments(long_config())) == [], "said once"
    long_data = bytearray(data[:2] + long_config().frame_size.to_bytes(2, "big") + data[4:14])
    long_data += bytes(long_config().frame_size - 16)
    assert rig(bytes(long_data) + chk(bytes(long_data)).to_bytes(2, "big")) == []
    assert rig.reception.counts.undecodable == 2
    assert [getattr(item, "is_config", None) for item in rig(encode_config(short), data)] == [True, False]


def test_what_was_held_for_a_first_configuration_counts_by_a_name_of_its_own_once_it_is_old() -> None:
    rig = Rig()
    found: list[Any] = []
    data = STREAMS.data("N1", STREAMS.stamp_ns(0))
    arrivals_ns = [*range(0, 60 * NS, NS // 10), 60 * NS]
    for arrival_ns in arrivals_ns:
        frame = encode_config(STREAMS.configs["N1"]) if arrival_ns == 60 * NS else data
        chunk = Chunk(frame, arrival_ns, FLOWS["N1"], StampSource.KERNEL)
        rig.reception.parse([chunk], found.append)
    assert [item.is_config for item in found] == [True, *[False] * 10]
    assert [item.frame.arrival_ns for item in found[1:]] == arrivals_ns[-11:-1]
    assert rig.reception.counts.unreadable_yet == 590 and rig.reception.counts.undecodable == 0
