"""What is written is read back: same bytes, arrivals and flows; and tshark finds nothing wrong with the packets."""

from __future__ import annotations

import subprocess
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.captures import REAL_CAPTURES, capture_path

from pmutools.errors import EncodeError, SourceError
from pmutools.flow import Chunk, Flow
from pmutools.formats.capture import CaptureReader, CaptureWriter, Fate
from pmutools.formats.capture.build import checksum

SUFFIXES = [".pcap", ".pcapng", ".pcap.gz", ".pcapng.gz", ".pcap.zst", ".PCAPNG.ZST"]
T0 = 1_700_000_000_123_456_789
UDP4 = Flow("udp", "192.0.2.1:4713", "192.0.2.2:4713")
UDP6 = Flow("udp", "[2001:db8::1]:4713", "[ff15::1]:4713")
TCP4 = Flow("tcp", "192.0.2.1:4712", "192.0.2.2:50000")
TCP6 = Flow("tcp", "[2001:db8::2]:50000", "[2001:db8::1]:4712")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("written")


def write(path: Path, chunks: Sequence[Chunk]) -> Path:
    with CaptureWriter(path) as writer:
        for chunk in chunks:
            writer.write(chunk)
    return path


def back(flow: Flow) -> Flow:
    return flow._replace(source=flow.destination, destination=flow.source)


def as_streams(chunks: Sequence[Chunk]) -> dict[Flow, list[object]]:
    """By flow: of UDP the chunks, of TCP each byte with its arrival, and None for each lost one."""
    streams: dict[Flow, list[object]] = defaultdict(list)
    for chunk in chunks:
        if chunk.flow.transport == "udp":
            streams[chunk.flow].append(chunk)
        else:
            streams[chunk.flow] += [None] * chunk.lost_before
            streams[chunk.flow] += [(byte, chunk.arrival_ns) for byte in chunk.data]
    return {flow: content for flow, content in streams.items() if content}


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_datagrams_and_segments_come_back_one_by_one(folder: Path, suffix: str) -> None:
    first = [UDP4, TCP4, back(TCP4), UDP6, TCP6, back(TCP6)]
    second = [flow._replace(connection=int(flow.is_stream)) for flow in first]
    chunks = [Chunk(bytes((i,)) * (i + 1), T0 + i * 1_000_001, flow) for i, flow in enumerate(2 * first + 2 * second)]
    reader = CaptureReader(write(folder / f"all{suffix}", chunks))
    assert list(reader) == chunks
    assert reader.tally.is_clean
    assert reader.kind == suffix.lower()[1:].partition(".")[0]


flows = st.sampled_from([UDP4, back(UDP4), UDP6, TCP4, back(TCP4), TCP6, back(TCP6)])
sizes = st.one_of(st.integers(0, 200), st.sampled_from([1400, 1401, 1448, 1472, 1473, 2800, 2960, 9000, 65507]))


@settings(max_examples=80, deadline=None)
@given(
    steps=st.lists(
        st.tuples(flows, sizes, st.integers(0, 10**10), st.integers(0, 2), st.sampled_from([0, 0, 0, 1, 5000])),
        max_size=12,
    ),
    suffix=st.sampled_from(SUFFIXES),
)
def test_round_trip(folder: Path, steps: list[tuple[Flow, int, int, int, int]], suffix: str) -> None:
    """Any sizes, flows and gaps; connection numbers only grow, as a reader counts them."""
    chunks: list[Chunk] = []
    at, numbers = T0, dict.fromkeys((TCP4, TCP6), 0)
    for flow, size, step, new, lost in steps:
        at += step
        pair = flow if flow in numbers else back(flow)
        if pair in numbers:
            if new == 2 and any(chunk.flow.source in pair[1:] for chunk in chunks):
                numbers[pair] += 1
            flow = flow._replace(connection=numbers[pair])
        else:
            lost = 0
        chunks.append(Chunk(bytes(at % 251 + i & 0xFF for i in range(size)), at, flow, lost_before=lost if size else 0))
    reader = CaptureReader(write(folder / f"any{suffix}", chunks))
    got = list(reader)
    opened = {chunk.flow[:4] for chunk in chunks if chunk.flow.is_stream and not chunk.data}
    if not opened:  # a connection opened by a chunk without bytes is none to a reader
        assert as_streams(got) == as_streams(chunks)
    tally = reader.tally
    assert tally.file_bytes == tally.overhead_bytes + sum(tally.nbytes.values())
    assert tally.lost_bytes == sum(chunk.lost_before for chunk in chunks)
    assert not tally.packets[Fate.DAMAGED] + tally.packets[Fate.FRAGMENT_LOST] + tally.packets[Fate.TCP_STRAY]


def test_a_hole_keeps_its_place_and_the_arrivals_behind_it(folder: Path) -> None:
    chunks = [
        Chunk(b"abc", T0, TCP4),
        Chunk(b"def", T0 + 20_000_000, TCP4, lost_before=100),
        Chunk(b"ghi", T0 + 40_000_000, TCP4),
        Chunk(b"jkl", T0 + 90_000_000, TCP4),
    ]
    for suffix in (".pcap", ".pcapng"):
        assert list(CaptureReader(write(folder / f"hole{suffix}", chunks))) == chunks


def test_files_become_datagrams_between_loopback_addresses(folder: Path) -> None:
    chunks = [Chunk(b"one", T0, Flow("file", "a.c37118")), Chunk(b"two", T0, Flow("file", "b.c37118"))]
    got = list(CaptureReader(write(folder / "files.pcap", [*chunks, *chunks])))
    names = ["127.0.0.1:4713", "127.0.0.2:4713"]
    assert [chunk.flow for chunk in got] == [Flow("udp", name, name) for name in names] * 2


def test_chunks_without_arrival(folder: Path) -> None:
    chunks = [Chunk(b"a", None, UDP4), Chunk(b"b", T0, UDP4), Chunk(b"c", None, UDP4)]
    assert [chunk.arrival_ns for chunk in CaptureReader(write(folder / "n.pcapng", chunks))] == [None, T0, None]
    assert [chunk.arrival_ns for chunk in CaptureReader(write(folder / "n.pcap", chunks))] == [0, T0, T0]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_file_is_valid_up_to_the_last_flush_and_repeatable(folder: Path, suffix: str) -> None:
    path = folder / f"flushed{suffix}"
    writer = CaptureWriter(path)
    for index in range(100):
        writer.write(Chunk(b"frame %d" % index, T0 + index, UDP4))
        if index == 59:
            writer.flush()
            snapshot = path.read_bytes()
    writer.close()
    writer.close()
    whole = path.read_bytes()
    assert len(list(CaptureReader(path))) == 100
    again = folder / f"again{suffix}"
    with CaptureWriter(again) as writer:
        for index in range(100):
            writer.write(Chunk(b"frame %d" % index, T0 + index, UDP4))
            if index == 59:
                writer.flush()
    assert again.read_bytes() == whole
    path.write_bytes(snapshot)
    reader = CaptureReader(path)
    assert len(list(reader)) == 60
    assert (reader.tally.skipped_bytes, reader.tally.cut_bytes) == (0, 0)


@pytest.mark.parametrize(
    ("chunk", "words"),
    [
        (Chunk(bytes(65508), T0, UDP4), "65507 at most"),
        (Chunk(bytes(65528), T0, UDP6), "65527 at most"),
        (Chunk(b"", -1, UDP4), "1970"),
        (Chunk(b"", 1 << 63, UDP4), "1970..2106"),
        (Chunk(b"", T0, Flow("udp", "pmu.example:4713", "192.0.2.1:1")), "pmu.example:4713"),
        (Chunk(b"", T0, Flow("udp", "192.0.2.1:70000", "192.0.2.1:1")), "192.0.2.1:70000"),
        (Chunk(b"", T0, Flow("tcp", "192.0.2.1", "192.0.2.1:1")), "numeric ADDRESS:PORT"),
        (Chunk(b"", T0, Flow("udp", "192.0.2.1:1", "[::1]:1")), "mixes"),
    ],
)
def test_what_packets_cannot_carry(folder: Path, chunk: Chunk, words: str) -> None:
    good = Chunk(b"good", T0, UDP4)
    with CaptureWriter(folder / "refused.pcap") as writer:
        writer.write(good)
        with pytest.raises(EncodeError, match=words):
            writer.write(chunk)
    assert list(CaptureReader(folder / "refused.pcap")) == [good]


def test_names_that_tell_no_format_and_folders_that_are_not_there(tmp_path: Path) -> None:
    for name in ("x.csv", "x", "x.pcap.bz2", "x.gz"):
        with pytest.raises(SourceError, match=r"end it in \.pcap"):
            CaptureWriter(tmp_path / name)
    with pytest.raises(SourceError, match="cannot write"):
        CaptureWriter(tmp_path / "absent" / "x.pcap")


def test_checksum_of_rfc_1071() -> None:
    assert checksum(bytes.fromhex("0001f203f4f5f6f7")) == 0xFFFF - 0xDDF2
    assert checksum(b"\xff\xff") == 0


@pytest.mark.peer
@pytest.mark.parametrize("suffix", [".pcap", ".pcapng", ".pcap.gz"])
def test_tshark_finds_nothing_wrong(folder: Path, suffix: str, requires: Callable[[str], Path]) -> None:
    sizes = [0, 1, 2, 99, 1400, 1401, 1473, 9001, 65507]
    every = [UDP4, UDP6, TCP4, back(TCP4), TCP6, back(TCP6), TCP4._replace(connection=1), Flow("file", "x")]
    chunks = [Chunk(bytes((size & 0xFF,)) * size, T0 + i, flow) for flow in every for i, size in enumerate(sizes)]
    path = write(folder / f"tshark{suffix}", chunks)
    checks = [f"-o{layer}.check_checksum:TRUE" for layer in ("ip", "udp", "tcp")]
    fields = ["_ws.malformed", "_ws.expert.message", "ip.checksum.status", "udp.checksum.status", "tcp.checksum.status"]
    command = [str(requires("tshark")), "-n", "-r", str(path), *checks, "--disable-protocol", "synphasor"]
    command += ["--disable-protocol", "data", "-Tfields", *(f"-e{field}" for field in fields)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    rows = [line.split("\t") for line in done.stdout.splitlines()]
    good = "1"
    for malformed, expert, *statuses in rows:
        assert malformed == ""
        assert set(",".join(statuses).split(",")) <= {"", good}
        assert not any(
            word in expert.lower() for word in ("bad", "retrans", "unseen", "lost", "out-of-order", "illegal")
        )
    assert any(row[4] == good for row in rows)
    assert any(row[3] == good for row in rows)


@pytest.mark.peer
@pytest.mark.parametrize("name", REAL_CAPTURES)
@pytest.mark.parametrize("suffix", [".pcap", ".pcapng.zst"])
def test_tshark_dissects_the_same_frames_from_a_rewritten_capture(
    folder: Path, name: str, suffix: str, requires: Callable[[str], Path]
) -> None:
    source = capture_path(name)
    written = write(folder / f"rewritten{suffix}", list(CaptureReader(source)))
    plain = folder / "rewritten-plain.pcap"
    write(plain, list(CaptureReader(written)))
    assert _synphasor(source, requires) == _synphasor(plain, requires)


def _synphasor(path: Path, requires: Callable[[str], Path]) -> list[str]:
    """IDCODE, FRAMESIZE, FRACSEC and CHK of every C37.118 frame that tshark finds, in order."""
    fields = [f"synphasor.{name}" for name in ("idcode_stream_source", "frsize", "fracsec_raw", "checksum")]
    fields.append("_ws.malformed")
    command = [str(requires("tshark")), "-n", "-r", str(path), "-Y", "synphasor", "-Tfields"]
    command += [f"-e{field}" for field in fields]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    frames = []
    for line in done.stdout.splitlines():
        *columns, malformed = line.split("\t")
        assert malformed == ""
        frames += ["\t".join(frame) for frame in zip(*(column.split(",") for column in columns), strict=True)]
    return frames
