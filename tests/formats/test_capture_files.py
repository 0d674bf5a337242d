"""The two file grammars: variants, compression, cut and damaged files, and an account that adds up."""

from __future__ import annotations

import gzip
import random
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from support.packets import (
    T0,
    block,
    enhanced,
    interface,
    ipv4,
    obsolete,
    option,
    pcap,
    pcapng,
    section,
    simple,
    udp,
    udp_frame,
)

from pmutools.errors import SourceError
from pmutools.flow import Chunk, Flow, StampSource
from pmutools.formats.capture import CaptureReader, Fate, Tally, is_capture

Container = Callable[..., bytes]

FLOW = Flow("udp", "192.0.2.1:4713", "192.0.2.2:50000")
STEP = 20_000_000


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("captures") / "capture"


def records(count: int = 40) -> list[tuple[int, bytes]]:
    """Datagrams of differing sizes, their number in front."""
    return [(T0 + i * STEP, udp_frame(struct.pack(">I", i) + bytes(30 + i % 7))) for i in range(count)]


def read(path: Path, content: bytes) -> tuple[list[Chunk], Tally]:
    path.write_bytes(content)
    reader = CaptureReader(path)
    chunks = list(reader)
    tally = reader.tally
    assert tally.file_bytes == tally.overhead_bytes + sum(tally.nbytes.values()) + tally.skipped_bytes + tally.cut_bytes
    assert tally.chunks == len(chunks)
    assert tally.payload_bytes == sum(len(chunk.data) for chunk in chunks)
    return chunks, tally


def numbers(chunks: list[Chunk]) -> list[int]:
    return [int.from_bytes(chunk.data[:4], "big") for chunk in chunks]


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("nanoseconds", "modified"), [(True, False), (False, False), (False, True)])
def test_pcap_variants(scratch: Path, order: str, nanoseconds: bool, modified: bool) -> None:
    written = [(at + 123_456_789, packet) for at, packet in records()]
    content = pcap(written, order=order, nanoseconds=nanoseconds, modified=modified)
    chunks, tally = read(scratch, content)
    unit = 1 if nanoseconds else 1000
    assert [chunk.arrival_ns for chunk in chunks] == [at // unit * unit for at, _ in written]
    assert [chunk.data for chunk in chunks] == [packet[42:] for _, packet in written]
    assert {(chunk.flow, chunk.stamp_source, chunk.lost_before) for chunk in chunks} == {(FLOW, StampSource.CAPTURE, 0)}
    assert tally.is_clean
    assert tally.packets[Fate.UDP] == tally.total_packets == len(written)
    assert tally.file_bytes == len(content)


@pytest.mark.parametrize("order", ["<", ">"])
def test_pcapng_blocks_that_carry_packets(scratch: Path, order: str) -> None:
    packet = udp_frame(b"frame")
    content = section(order) + interface(order, snaplen=100, tsresol=9)
    content += enhanced(packet, T0 + 1, 0, order) + simple(packet, order) + obsolete(packet, T0 + 2, 0, order)
    chunks, tally = read(scratch, content)
    assert [(chunk.data, chunk.arrival_ns) for chunk in chunks] == [
        (b"frame", T0 + 1),
        (b"frame", None),
        (b"frame", T0 + 2),
    ]
    assert tally.is_clean


def test_a_simple_packet_is_cut_at_the_snapshot_length(scratch: Path) -> None:
    packet = udp_frame(bytes(100))
    chunks, tally = read(scratch, section() + interface(snaplen=60) + simple(packet[:60], wire=len(packet)))
    assert (chunks, tally.packets[Fate.TRUNCATED]) == ([], 1)


@pytest.mark.parametrize(
    ("tsresol", "offset_s", "ticks", "arrival_ns"),
    [
        (None, None, 1_700_000_000_123_456, 1_700_000_000_123_456_000),
        (3, None, 1_700_000_000_123, 1_700_000_000_123_000_000),
        (9, 3600, 1_700_000_000_000_000_001, 1_700_003_600_000_000_001),
        (9, -3600, 1_700_000_000_000_000_001, 1_699_996_400_000_000_001),
        (
            12,
            None,
            1_700_000_000_000_000_000_999 & (1 << 64) - 1,
            (1_700_000_000_000_000_000_999 & (1 << 64) - 1) // 1000,
        ),
        (0x80 | 10, None, 1_700_000_000 * 1024 + 1, 1_700_000_000_000_976_562),
        (0, 1 << 33, 5, ((1 << 33) + 5) * 10**9),
    ],
)
def test_interface_time_scales(
    scratch: Path, tsresol: int | None, offset_s: int | None, ticks: int, arrival_ns: int
) -> None:
    content = section() + interface(tsresol=tsresol, offset_s=offset_s) + enhanced(udp_frame(b"x"), ticks)
    (chunk,), _ = read(scratch, content)
    assert chunk.arrival_ns == arrival_ns


def test_sections_and_interfaces_are_kept_apart(scratch: Path) -> None:
    raw_ip = ipv4(udp(b"raw"))
    content = section("<") + interface("<", tsresol=9) + interface("<", linktype=101, tsresol=6)
    content += enhanced(raw_ip, 2_000_000, 1) + enhanced(udp_frame(b"ether"), 5, 0)
    content += section(">", option(">", 1, b"second")) + interface(">", linktype=228, tsresol=9)
    content += enhanced(raw_ip, 7, 0, ">") + enhanced(raw_ip, 8, 1, ">")
    chunks, tally = read(scratch, content)
    assert [(chunk.data, chunk.arrival_ns) for chunk in chunks] == [(b"raw", 2 * 10**9), (b"ether", 5), (b"raw", 7)]
    assert tally.packets[Fate.UNSUPPORTED_LINK] == 1  # the second section describes one interface only
    assert tally.unsupported_links == {-1: 1}


def test_other_blocks_are_passed_over(scratch: Path) -> None:
    content = section() + block("<", 4, bytes(20)) + interface(tsresol=9)
    for kind in (5, 10, 0xBAD, 0x4321, 0x7777_7777):
        content += block("<", kind, bytes(kind % 64)) + enhanced(udp_frame(b"x"), kind)
    chunks, tally = read(scratch, content)
    assert len(chunks) == 5
    assert tally.unknown_blocks == 2
    assert tally.is_clean


def test_a_block_longer_than_a_block_of_reading(scratch: Path) -> None:
    content = section() + interface(tsresol=9) + enhanced(udp_frame(b"a"), 1)
    content += block("<", 0xBAD, bytes(9 << 20)) + enhanced(udp_frame(b"b"), 2)
    chunks, tally = read(scratch, content)
    assert [chunk.data for chunk in chunks] == [b"a", b"b"]
    assert tally.is_clean


@pytest.mark.parametrize("container", [pcap, pcapng])
def test_files_longer_than_a_block_of_reading(scratch: Path, container: Container) -> None:
    written = [(T0 + i * 1000, udp_frame(struct.pack(">I", i) + bytes(1200 + i % 5))) for i in range(6000)]
    chunks, tally = read(scratch, container(written))
    assert numbers(chunks) == list(range(6000))
    assert tally.is_clean


@pytest.mark.parametrize("container", [pcap, pcapng])
@pytest.mark.parametrize("squeeze", [gzip.compress, zstandard.compress])
def test_compression_is_seen_from_the_content(
    scratch: Path, container: Container, squeeze: Callable[[bytes], bytes]
) -> None:
    content = container(records())
    chunks, tally = read(scratch, squeeze(content[:500]) + squeeze(content[500:]))  # also of several members
    assert numbers(chunks) == list(range(40))
    assert (tally.is_clean, tally.file_bytes) == (True, len(content))


@pytest.mark.parametrize("squeeze", [gzip.compress, zstandard.compress])
def test_a_cut_or_damaged_compression_layer_is_reported(scratch: Path, squeeze: Callable[[bytes], bytes]) -> None:
    noise = random.Random(1)
    written = [(T0 + i, udp_frame(struct.pack(">I", i) + noise.randbytes(1000))) for i in range(600)]
    squeezed = squeeze(pcap(written))
    chunks, tally = read(scratch, squeezed[: len(squeezed) * 2 // 3])
    assert tally.decompression_failed
    assert not tally.is_clean
    assert numbers(chunks) == list(range(len(chunks)))
    assert 250 < len(chunks) < 450
    middle = len(squeezed) // 2  # of noise zstd notices nothing, gzip has its CRC
    chunks, tally = read(scratch, squeezed[:middle] + bytes(64) + squeezed[middle + 64 :])
    assert tally.decompression_failed == (squeeze is gzip.compress)
    assert numbers(chunks)[:290] == list(range(290))


@pytest.mark.parametrize("container", [pcap, pcapng])
def test_a_cut_file_at_every_length(scratch: Path, container: Container) -> None:
    content = container(records(3))
    whole = [len(container(records(count))) for count in range(4)]
    for length in range(12, len(content) + 1):
        chunks, tally = read(scratch, content[:length])
        assert numbers(chunks) == list(range(sum(length >= end for end in whole[1:])))
        assert tally.cut_bytes == length - max((end for end in whole if end <= length), default=0) or length < whole[0]
        assert (tally.skipped_bytes, tally.is_clean) == (0, tally.cut_bytes == 0)


@pytest.mark.parametrize("container", [pcap, pcapng])
@pytest.mark.parametrize("victim", [0, 20, 38, 39])
@pytest.mark.parametrize("byte", range(16))
def test_a_damaged_header_costs_its_record_only(scratch: Path, container: Container, victim: int, byte: int) -> None:
    """Whichever byte of a record's or block's header is hit, all other packets are read."""
    start = len(container(records(victim)))
    damaged = bytearray(container(records()))
    damaged[start + byte] ^= 0xA5
    chunks, _ = read(scratch, bytes(damaged))
    assert set(range(40)) - set(numbers(chunks)) <= {victim}


@pytest.mark.parametrize("container", [pcap, pcapng])
@pytest.mark.parametrize("filler", [b"", b"\x00", b"\xff", b"text"])
def test_an_overwritten_stretch_is_skipped_once(scratch: Path, container: Container, filler: bytes) -> None:
    ends = [len(container(records(count))) for count in range(41)]
    content = container(records())
    begin, end = ends[10] + 5, ends[20] + 7  # hits records 10 to 20
    content = content[:begin] + (filler * (end - begin))[: end - begin] + content[end:]
    chunks, tally = read(scratch, content)
    assert numbers(chunks) == [*range(10), *range(21, 40)]
    assert tally.gaps == 1
    assert tally.cut_bytes == 0
    assert ends[21] - ends[10] == tally.skipped_bytes + (0 if filler else end - begin)


def test_a_long_stretch_of_noise_is_searched_through(scratch: Path) -> None:
    noise = random.Random(2).randbytes(7 << 20)
    for container in (pcap, pcapng):
        content = container(records())
        middle = len(container(records(20)))
        chunks, tally = read(scratch, content[:middle] + noise + content[middle:])
        assert numbers(chunks) == list(range(40))
        assert (tally.gaps, tally.skipped_bytes) == (1, len(noise))


def test_a_lying_length_does_not_swallow_the_rest_of_the_file(scratch: Path) -> None:
    """A length that reaches beyond the file's end is damage, not a cut tail."""
    content = bytearray(pcap(records()))
    content[24 + 8 : 24 + 16] = struct.pack("<II", 500_000, 500_000)
    chunks, tally = read(scratch, bytes(content))
    assert numbers(chunks) == list(range(1, 40))
    assert (tally.cut_bytes, tally.gaps) == (0, 1)


def test_one_implausible_stamp_is_damage_and_a_step_of_the_clock_is_not(scratch: Path) -> None:
    stamped = records(9)
    stamped[4] = (T0 + 30 * 86_400 * 10**9, stamped[4][1])
    chunks, tally = read(scratch, pcap(stamped))
    assert numbers(chunks) == [0, 1, 2, 3, 5, 6, 7, 8]
    assert (tally.gaps, tally.skipped_bytes) == (1, 16 + len(stamped[4][1]))
    stepped = [(at if i < 5 else at - T0 + 10**9, packet) for i, (at, packet) in enumerate(records(9))]
    chunks, tally = read(scratch, pcap(stepped))
    assert [chunk.arrival_ns for chunk in chunks] == [at for at, _ in stepped]
    assert tally.is_clean


def test_a_stamp_beyond_int64_is_damage(scratch: Path) -> None:
    content = section() + interface(tsresol=0) + enhanced(udp_frame(b"x"), 1 << 60) + enhanced(udp_frame(b"y"), 5)
    chunks, tally = read(scratch, content)
    assert [chunk.data for chunk in chunks] == [b"y"]
    assert tally.gaps == 1


def test_an_impossible_captured_length_is_damage(scratch: Path) -> None:
    content = bytearray(pcapng(records(3)))
    struct.pack_into("<I", content, len(pcapng(records(1))) + 20, 5000)
    chunks, tally = read(scratch, bytes(content))
    assert numbers(chunks) == [0, 2]
    assert tally.gaps == 1
    for short in (2, 3, 6):
        chunks, tally = read(scratch, pcapng(records(1)) + block("<", short, b"") + pcapng(records(1)))
        assert (numbers(chunks), tally.gaps, tally.skipped_bytes) == ([0, 0], 1, 12)


@settings(max_examples=150, deadline=None)
@given(
    container=st.sampled_from([pcap, pcapng]),
    seed=st.integers(0, 1 << 32),
    hits=st.lists(st.tuples(st.integers(0, 1 << 16), st.integers(0, 4), st.binary(max_size=40)), max_size=6),
)
def test_any_damage_is_counted_and_raises_nothing(
    scratch: Path, container: Container, seed: int, hits: list[tuple[int, int, bytes]]
) -> None:
    """Bits flipped, stretches removed, replaced and inserted anywhere behind the magic."""
    noise = random.Random(seed)
    written = [(T0 + i * STEP, udp_frame(struct.pack(">I", i) + noise.randbytes(60))) for i in range(60)]
    content = bytearray(container(written))
    headers = len(container([]))
    all_hangs_on_it = False
    for place, removed, inserted in hits:
        at = 12 + place % (len(content) - 12)
        all_hangs_on_it |= at < headers
        content[at : at + removed * removed * 10] = inserted
    chunks, tally = read(scratch, bytes(content))
    assert tally.file_bytes == len(content)
    if not hits:
        assert numbers(chunks) == list(range(60))
    # Each hit spoils at most what it touches and the record before, whose follower it was.
    intact = sum(packet[42:] in {chunk.data for chunk in chunks} for _, packet in written)
    assert intact >= 60 - sum(3 + removed * removed * 10 // 90 for _, removed, _ in hits) or all_hangs_on_it


@settings(max_examples=100, deadline=None)
@given(
    magic=st.sampled_from(["d4c3b2a1", "a1b23c4d", "34cdb2a1", "0a0d0d0a1c0000004d3c2b1a"]),
    rest=st.binary(max_size=4000),
)
def test_garbage_behind_a_magic_is_counted(scratch: Path, magic: str, rest: bytes) -> None:
    content = bytes.fromhex(magic) + rest
    _, tally = read(scratch, content)
    assert tally.file_bytes == len(content)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b"\xaa\x01\x00\x22 raw frames", "is no capture"),
        (b"time,freq\n", "is no capture"),
        (b"\x0a\x0d\x0d\x0a\x00\x00\x00\x00no magic", "is no capture"),
        (gzip.compress(b"", mtime=0), "holds nothing"),
        (gzip.compress(b"text, and no capture", mtime=0), "is no capture"),
        (b"\x1f\x8b\x08\x00 not really gzip", "holds nothing"),
    ],
)
def test_what_is_no_capture_is_one_line_that_names_the_file(scratch: Path, content: bytes, words: str) -> None:
    scratch.write_bytes(content)
    with pytest.raises(SourceError, match=words) as caught:
        CaptureReader(scratch)
    assert str(scratch) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_a_folder(tmp_path: Path) -> None:
    for path in (tmp_path / "absent.pcap", tmp_path):
        with pytest.raises(SourceError, match="check the path"):
            CaptureReader(path)


def test_each_iteration_reads_anew(scratch: Path) -> None:
    scratch.write_bytes(pcap(records()))
    reader = CaptureReader(scratch)
    assert reader.progress == 0.0
    assert list(reader) == list(reader)
    assert (reader.tally.packets[Fate.UDP], reader.progress) == (40, 1.0)
    assert next(iter(reader)).flow == FLOW  # and may be left early
    assert is_capture(scratch.read_bytes()[:12])
    assert not is_capture(b"")
