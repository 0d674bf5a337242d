"""CFG-3 of more than a frame can hold: cut into fragments (CONT_IDX), joined, and kept by every format."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from support import swing

from pmutools.c37118 import Demux, FrameType, Message, StreamConfig, decode_config, encode_config
from pmutools.c37118.checksum import chk
from pmutools.c37118.config import PhasorChannel, frames_in
from pmutools.c37118.constants import PREFIX_SIZE
from pmutools.c37118.demux import BOUNDS
from pmutools.c37118.session import Served, served
from pmutools.errors import EncodeError, WireError
from pmutools.flow import Chunk, Flow, StampSource
from pmutools.formats import open_sink, open_source
from pmutools.formats.source import Block

FLOW = Flow("udp", "192.0.2.1:4712", "192.0.2.2:4713")


def long_config(phasors: int = 300) -> StreamConfig:
    """Each of the phasors takes more than 255 bytes of it."""
    config = swing.Streams(("N1",)).configs["N1"]
    channels = tuple(PhasorChannel(f"{number:0255d}") for number in range(phasors))
    return replace(config, stations=(replace(config.stations[0], phasors=channels),), kind=FrameType.CFG3)


@pytest.mark.parametrize(("phasors", "frames"), [(200, 1), (240, 1), (250, 2), (300, 2), (600, 3)])
def test_it_is_cut_and_joined(phasors: int, frames: int) -> None:
    config = long_config(phasors)
    data = encode_config(config, soc=1_700_000_000, fracsec=5)
    parts = frames_in(data)
    indices = [int.from_bytes(part[PREFIX_SIZE : PREFIX_SIZE + 2], "big") for part in parts]
    assert indices == ([0] if frames == 1 else [*range(1, frames), 0xFFFF])
    prefix, found = decode_config(data)
    assert found == config and (prefix.soc, prefix.fracsec) == (1_700_000_000, 5)
    chunks = [Chunk(part, 1, FLOW, StampSource.KERNEL) for part in parts]
    demux = Demux()
    found_there = [item for chunk in chunks for item in demux.feed(chunk)]
    assert all(isinstance(item, Message) for item in found_there)
    assert [item.config for item in found_there if isinstance(item, Message)] == [None] * (frames - 1) + [config]


def test_of_cfg_2_there_are_no_fragments() -> None:
    config = replace(long_config(), kind=FrameType.CFG2)
    short = tuple(PhasorChannel("V") for _ in range(4000))
    stations = tuple(replace(station, phasors=short) for station in config.stations)
    with pytest.raises(EncodeError, match="FRAMESIZE ends at 65535"):
        encode_config(replace(config, stations=stations))


def test_what_is_not_whole_is_refused() -> None:
    first, second = frames_in(encode_config(long_config()))
    other = bytearray(second)
    other[4:6] = (102).to_bytes(2, "big")
    other[-2:] = chk(bytes(other[:-2])).to_bytes(2, "big")
    for data in (first, second, second + first, first + first + second, first + second[:-1], first + bytes(other), b""):
        with pytest.raises(WireError):
            decode_config(data)
    flipped = bytearray(first + second)
    for at in range(0, len(flipped), 997):
        flipped[at] ^= 1
        with pytest.raises(WireError):
            decode_config(bytes(flipped))
        flipped[at] ^= 1


@pytest.mark.parametrize("suffix", ["parquet", "arrow", "csv", "jsonl", "mcap", "pcapng", "c37118"])
def test_every_format_keeps_it(suffix: str, tmp_path: Path) -> None:
    config = long_config()
    parts = frames_in(encode_config(config, soc=1_700_000_000))
    head = config.kind.sync & 0xFF0F
    data = []
    for number in range(5):
        frame = b"".join(
            value.to_bytes(size, "big")
            for value, size in ((head, 2), (config.frame_size, 2), (101, 2), (1_700_000_000, 4), (number * 16_000, 4))
        ) + bytes(config.frame_size - 16)
        data.append(frame + chk(frame).to_bytes(2, "big"))
    raw = tmp_path / "raw.c37118"
    raw.write_bytes(b"".join(parts + data))
    path = tmp_path / f"kept.{suffix}"
    with open_sink(path) as sink:
        for item in open_source(raw).blocks() if sink.wants == "blocks" else open_source(raw).items():
            if isinstance(item, (Message, Block)):
                sink.write(item)
    batches = [block.batch for block in open_source(path).blocks() if isinstance(block, Block)]
    assert sum(map(len, batches)) == 5
    assert {len(batch.config.stations[0].phasors) for batch in batches} == {300}
    if suffix != "csv":  # which has no place for it
        assert {batch.config for batch in batches} == {config}


def test_fragments_that_never_end_take_so_much_memory_and_no_more() -> None:
    demux = Demux()
    wanted = frames_in(encode_config(long_config()))
    many = frames_in(encode_config(replace(long_config(4000))))[:-1]
    for port in range(40):  # each nearly a megabyte
        flow = Flow("udp", f"192.0.2.9:{5000 + port}", "192.0.2.2:4713")
        for part in many:
            demux.feed(Chunk(part, 1, flow, StampSource.KERNEL))
        assert (
            demux._fragment_bytes
            == sum(len(body) for _, body in demux._fragments.values())
            <= BOUNDS.all_fragment_bytes
        )
    assert demux._fragment_bytes > BOUNDS.all_fragment_bytes / 2
    found = [item for part in wanted for item in demux.feed(Chunk(part, 1, FLOW, StampSource.KERNEL))]
    assert isinstance(found[-1], Message) and found[-1].config == long_config()


def test_who_serves_it_stamps_each_of_its_frames() -> None:
    config = long_config()
    offer = Served(config.idcode, config.time_base, {FrameType.CFG3: encode_config(config)}, (FrameType.CFG3,))
    parts = offer.announcements(1_700_000_000 * 10**9)
    assert len(parts) == 2 and b"".join(parts) == offer.frame(FrameType.CFG3, 1_700_000_000 * 10**9)
    prefix, found = decode_config(b"".join(parts))
    assert found == config and prefix.soc == 1_700_000_000


def test_what_cfg_2_has_no_room_for_is_served_as_cfg_3() -> None:
    config = long_config()
    stations = tuple(
        replace(station, phasors=tuple(PhasorChannel(f"V{n}") for n in range(4000))) for station in config.stations
    )
    offer = served(replace(config, stations=stations))
    assert set(offer.frames) == {FrameType.CFG3}
    assert decode_config(b"".join(offer.announcements(0)))[1].stations[0].phasors[-1].name == "V3999"
