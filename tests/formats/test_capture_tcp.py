"""TCP reassembly: whatever the order, overlap and number of segments, the bytes of each direction come out once, in
order, with the stamp of the segment that completed them; what is missing is said to be."""

from __future__ import annotations

import random
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.packets import ACK, FIN, PSH, RST, SYN, T0, Record, ethernet, ipv4, pcap, tcp_frame
from support.packets import tcp as segment

from pmutools.flow import Chunk, Flow
from pmutools.formats.capture import CaptureReader, Fate, Tally, tcp

FORTH = Flow("tcp", "192.0.2.1:4713", "192.0.2.2:50000")
BACK = Flow("tcp", "192.0.2.2:50000", "192.0.2.1:4713")
MS = 1_000_000
ISN = 1000


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("captures") / "capture"


def read(path: Path, records: Sequence[Record]) -> tuple[list[Chunk], Tally]:
    path.write_bytes(pcap(records))
    reader = CaptureReader(path)
    chunks = list(reader)
    assert reader.tally.total_packets == len(records)
    assert reader.tally.lost_bytes >= sum(chunk.lost_before for chunk in chunks)
    return chunks, reader.tally


def every(step_ns: int, packets: Sequence[bytes]) -> list[Record]:
    return [(T0 + index * step_ns, packet) for index, packet in enumerate(packets)]


def handshake(isn: int = ISN, other: int = 9000) -> list[bytes]:
    return [
        tcp_frame(b"", isn, SYN),
        tcp_frame(b"", other, SYN | ACK, isn + 1, back=True),
        tcp_frame(b"", isn + 1, ACK, other + 1),
    ]


def stream(chunks: Sequence[Chunk], flow: Flow = FORTH) -> bytes:
    return b"".join(chunk.data for chunk in chunks if chunk.flow == flow)


def cut_up(rng: random.Random, size: int, extra: int) -> list[tuple[int, int]]:
    """Spans that cover [0, size), and ``extra`` spans anywhere in it."""
    edges = sorted({0, size, *(rng.randrange(size) for _ in range(rng.randrange(12)))})
    spans = list(pairwise(edges))
    for _ in range(extra):
        begin = rng.randrange(size)
        spans.append((begin, min(size, begin + rng.randint(1, size))))
    return spans


@settings(max_examples=200, deadline=None)
@given(
    seed=st.integers(0, 1 << 32),
    size=st.integers(1, 3000),
    isn=st.one_of(st.integers(0, 0xFFFFFFFF), st.integers(0xFFFFFFFF - 3000, 0xFFFFFFFF)),
    extra=st.integers(0, 6),
)
def test_segments_split_repeated_overlapping_and_in_any_order(
    scratch: Path, seed: int, size: int, isn: int, extra: int
) -> None:
    rng = random.Random(seed)
    data = rng.randbytes(size)
    spans = cut_up(rng, size, extra)
    rng.shuffle(spans)
    packets = handshake(isn) + [tcp_frame(data[begin:end], isn + 1 + begin) for begin, end in spans]
    chunks, tally = read(scratch, every(MS, packets))
    assert stream(chunks) == data
    assert {(chunk.flow, chunk.lost_before) for chunk in chunks} == {(FORTH, 0)}
    assert tally.is_clean
    assert tally.payload_bytes + tally.repeated_bytes == sum(end - begin for begin, end in spans)
    # A byte is there once it and all before it are.
    first = [min(T0 + (3 + i) * MS for i, (a, b) in enumerate(spans) if a <= at < b) for at in range(size)]
    due = [max(first[: at + 1]) for at in range(size)]
    assert [chunk.arrival_ns for chunk in chunks for _ in chunk.data] == due


@settings(max_examples=200, deadline=None)
@given(seed=st.integers(0, 1 << 32), size=st.integers(2, 3000), lost=st.integers(1, 5), acknowledges=st.booleans())
def test_missing_segments_are_holes_of_the_right_size(
    scratch: Path, seed: int, size: int, lost: int, acknowledges: bool
) -> None:
    rng = random.Random(seed)
    data = rng.randbytes(size)
    spans = cut_up(rng, size, rng.randrange(4))
    rng.shuffle(spans)
    kept = spans[lost:]
    packets = handshake()
    for begin, end in kept:
        packets.append(tcp_frame(data[begin:end], ISN + 1 + begin))
        if acknowledges:
            packets.append(tcp_frame(b"", 9001, ACK, ISN + 1 + rng.randint(0, size), back=True))
    chunks, tally = read(scratch, every(rng.choice([MS, 40 * MS, 4000 * MS]), packets))
    at = 0
    for chunk in chunks:
        at += chunk.lost_before
        assert data[at : at + len(chunk.data)] == chunk.data
        at += len(chunk.data)
    assert tally.lost_bytes == sum(chunk.lost_before for chunk in chunks)
    assert tally.payload_bytes + tally.repeated_bytes == sum(end - begin for begin, end in kept)
    assert sum(tally.packets[fate] for fate in (Fate.TCP, Fate.TCP_REPEATED)) == len(kept)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 1 << 32))
def test_many_connections_at_once_both_ways(scratch: Path, seed: int) -> None:
    """Two directions, the ports used again three times over, each connection's segments in any order."""
    rng = random.Random(seed)
    packets: list[bytes] = []
    expected: dict[Flow, bytes] = {}
    for connection in range(3):
        isns = {False: rng.randrange(1 << 32), True: rng.randrange(1 << 32)}
        packets += handshake(isns[False], isns[True])
        segments = []
        for back, flow in ((False, FORTH), (True, BACK)):
            data = rng.randbytes(rng.randint(1, 500))
            expected[flow._replace(connection=connection)] = data
            segments += [tcp_frame(data[a:b], isns[back] + 1 + a, back=back) for a, b in cut_up(rng, len(data), 2)]
        rng.shuffle(segments)
        packets += segments
        packets.append(tcp_frame(b"", 1, rng.choice([FIN | ACK, RST, ACK])))
    chunks, tally = read(scratch, every(MS, packets))
    assert {flow: stream(chunks, flow) for flow in expected} == expected
    assert tally.lost_bytes == 0


def test_a_capture_that_begins_in_mid_stream(scratch: Path) -> None:
    packets = [
        tcp_frame(b"", 4999, ACK),  # a keep-alive is one below, and says nothing of where the data begin
        tcp_frame(b"one", 5000),
        tcp_frame(b"two", 5003),
        tcp_frame(b"early", 4995),  # from before the first that was seen
    ]
    chunks, tally = read(scratch, every(MS, packets))
    assert stream(chunks) == b"onetwo"
    assert (tally.repeated_bytes, tally.is_clean) == (5, True)


def test_a_syn_captured_after_the_first_data_opens_no_second_connection(scratch: Path) -> None:
    packets = [tcp_frame(b"one", ISN + 1), *handshake(), tcp_frame(b"two", ISN + 4)]
    packets += [*handshake(), tcp_frame(b"three", ISN + 7)]  # nor does the same handshake again
    chunks, _ = read(scratch, every(MS, packets))
    assert stream(chunks) == b"onetwothree"


@pytest.mark.parametrize("captured", [3, 1])
def test_a_syn_after_an_unfinished_capture_of_the_same_ports(scratch: Path, captured: int) -> None:
    """Mid-stream data one way only, then a handshake from the other side: connection 1 in both directions."""
    packets = [
        tcp_frame(b"old", 77_000, back=True),
        *handshake(ISN, 9000)[:captured],
        tcp_frame(b"new", ISN + 1),
        tcp_frame(b"answer", 9001, back=True),
    ]
    chunks, _ = read(scratch, every(MS, packets))
    assert [(chunk.data, chunk.flow) for chunk in chunks] == [
        (b"old", BACK),
        (b"new", FORTH._replace(connection=1)),
        (b"answer", BACK._replace(connection=1)),
    ]


def test_data_on_the_syn(scratch: Path) -> None:
    packets = [tcp_frame(b"fast", ISN, SYN), tcp_frame(b"open", ISN + 5)]
    chunks, _ = read(scratch, every(MS, packets))
    assert stream(chunks) == b"fastopen"


def test_keep_alives_and_zero_window_probes_add_nothing(scratch: Path) -> None:
    packets = [
        *handshake(),
        tcp_frame(b"abc", ISN + 1),
        tcp_frame(b"", ISN + 3, ACK),  # keep-alive without and with its byte of garbage
        tcp_frame(b"\0", ISN + 3, ACK),
        tcp_frame(b"d", ISN + 4, ACK),  # zero-window probe: the next byte, then sent again with what follows
        tcp_frame(b"def", ISN + 4, PSH | ACK),
        tcp_frame(b"", ISN + 7, FIN | ACK),
    ]
    chunks, tally = read(scratch, every(MS, packets))
    assert stream(chunks) == b"abcdef"
    assert (tally.packets[Fate.TCP], tally.packets[Fate.TCP_REPEATED], tally.packets[Fate.TCP_EMPTY]) == (3, 1, 5)
    assert tally.repeated_bytes == 2


def hole(after: Sequence[Record]) -> list[Record]:
    """A connection in which the segment "lost" (4 bytes) is missing between "abc" and "def", then ``after``."""
    packets = [*handshake(), tcp_frame(b"abc", ISN + 1), tcp_frame(b"def", ISN + 8)]
    return [*every(MS, packets), *after]


DEF_AT = T0 + 4 * MS


def test_a_hole_waits_for_its_retransmission(scratch: Path) -> None:
    chunks, _ = read(scratch, hole([(T0 + 3000 * MS, tcp_frame(b"lost", ISN + 4))]))
    assert [(chunk.data, chunk.arrival_ns, chunk.lost_before) for chunk in chunks[1:]] == [
        (b"lost", T0 + 3000 * MS, 0),
        (b"def", T0 + 3000 * MS, 0),
    ]


def test_a_hole_is_given_up_at_the_end_of_the_file(scratch: Path) -> None:
    chunks, tally = read(scratch, hole([]))
    assert [(chunk.data, chunk.arrival_ns, chunk.lost_before) for chunk in chunks[1:]] == [(b"def", DEF_AT, 4)]
    assert (tally.lost_bytes, tally.is_clean) == (4, False)


@pytest.mark.parametrize(
    ("sign", "patience_ns"),
    [
        (tcp_frame(b"", 9001, ACK, ISN + 8, back=True), tcp.ACKNOWLEDGED_HOLE_NS),
        (tcp_frame(b"", 9001, ACK, ISN + 7, back=True), tcp.HOLE_NS),  # not past the hole
        (tcp_frame(b"", 9001, RST, back=True), tcp.ACKNOWLEDGED_HOLE_NS),
        (tcp_frame(b"", 9001, FIN | ACK, back=True), tcp.HOLE_NS),
    ],
)
def test_a_hole_is_given_up_in_time(scratch: Path, sign: bytes, patience_ns: int) -> None:
    """An acknowledgement past it or a reset shortens the patience. What follows comes out in file order."""
    records = hole(
        [
            (DEF_AT + 1, sign),
            (DEF_AT + patience_ns, tcp_frame(b"ghi", ISN + 11)),
            (DEF_AT + patience_ns, tcp_frame(b"before", 9001, back=True)),
            (DEF_AT + patience_ns + 1, tcp_frame(b"jkl", ISN + 14)),
            (DEF_AT + patience_ns + 2, tcp_frame(b"after", 9007, back=True)),
        ]
    )
    chunks, tally = read(scratch, records)
    assert [(chunk.data, chunk.arrival_ns, chunk.lost_before) for chunk in chunks[1:]] == [
        (b"before", DEF_AT + patience_ns, 0),
        (b"def", DEF_AT, 4),
        (b"ghi", DEF_AT + patience_ns, 0),
        (b"jkl", DEF_AT + patience_ns + 1, 0),
        (b"after", DEF_AT + patience_ns + 2, 0),
    ]
    assert tally.lost_bytes == 4


@pytest.mark.parametrize(
    ("name", "value"), [("MAX_WAITING_SEGMENTS", 9), ("MAX_WAITING_BYTES", 99), ("MAX_WAITING_BYTES_ALL", 99)]
)
def test_the_bounds_of_what_waits(scratch: Path, monkeypatch: pytest.MonkeyPatch, name: str, value: int) -> None:
    monkeypatch.setattr(tcp, name, value)
    packets = [*handshake(), *(tcp_frame(bytes(10), ISN + 1 + at) for at in range(10, 200, 10))]
    late = tcp_frame(bytes(10), ISN + 1)
    chunks, tally = read(scratch, every(MS, [*packets, late]))
    assert chunks[0].lost_before == 10
    assert len(chunks) == 19
    assert (tally.lost_bytes, tally.packets[Fate.TCP_REPEATED]) == (10, 1)


@pytest.mark.parametrize("name", ["MAX_WAITING_BYTES", "MAX_WAITING_BYTES_ALL"])
def test_holes_that_are_filled_free_their_room(scratch: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(tcp, name, 30)
    packets = handshake()
    for at in range(0, 400, 20):
        packets += [tcp_frame(bytes(10), ISN + 1 + at + 10), tcp_frame(bytes(10), ISN + 1 + at)]
    chunks, tally = read(scratch, every(MS, packets))
    assert (len(stream(chunks)), tally.lost_bytes) == (400, 0)


def test_segments_cut_by_the_snapshot_length_are_holes_at_once(scratch: Path) -> None:
    cut = tcp_frame(bytes(500), ISN + 4)
    records: list[Record] = [
        *every(MS, [*handshake(), tcp_frame(b"abc", ISN + 1)]),
        (T0 + 4 * MS, cut[:96], len(cut)),
        (T0 + 5 * MS, tcp_frame(b"def", ISN + 504)),
        (T0 + 6 * MS, cut[:96], len(cut)),
    ]
    chunks, tally = read(scratch, records)
    assert [(chunk.data, chunk.lost_before, chunk.arrival_ns) for chunk in chunks] == [
        (b"abc", 0, T0 + 3 * MS),
        (b"def", 500, T0 + 5 * MS),
    ]
    assert (tally.packets[Fate.TRUNCATED], tally.lost_bytes) == (2, 500)


def test_one_sequence_number_out_of_range_harms_nothing_else(scratch: Path) -> None:
    packets = [
        *handshake(),
        tcp_frame(b"abc", ISN + 1),
        tcp_frame(b"bad", ISN + 4 + (1 << 30)),
        tcp_frame(b"def", ISN + 4),
    ]
    chunks, tally = read(scratch, every(MS, packets))
    assert stream(chunks) == b"abcdef"
    assert (tally.packets[Fate.TCP_STRAY], tally.lost_bytes) == (1, 0)
    packets.append(tcp_frame(b"bad", ISN + 7 + (1 << 30)))  # follows on from the other, but not at once
    chunks, tally = read(scratch, every(MS, packets))
    assert stream(chunks) == b"abcdef"
    assert tally.packets[Fate.TCP_STRAY] == 2


def test_a_connection_whose_syn_is_not_in_the_file(scratch: Path) -> None:
    """Two segments that fit each other, but not the connection, are another one."""
    packets = [*handshake(), tcp_frame(b"old", ISN + 1)]
    packets += [tcp_frame(b"new1", 1 << 31), tcp_frame(b"new2", (1 << 31) + 4), tcp_frame(b"new3", (1 << 31) + 8)]
    chunks, _ = read(scratch, every(MS, packets))
    assert stream(chunks) == b"old"
    assert stream(chunks, FORTH._replace(connection=1)) == b"new1new2new3"
    assert [chunk.arrival_ns for chunk in chunks[1:]] == [T0 + at * MS for at in (4, 5, 6)]


def test_connections_beyond_the_bound_are_forgotten_idle_ones_first(
    scratch: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tcp, "MAX_DIRECTIONS", 8)
    packets = [*handshake()]
    for index in range(50):
        packets.append(tcp_frame(bytes((index,)), ISN + 1 + index))
        packets.append(ethernet(ipv4(segment(b"scan", 5, source=index + 1), 6)))
    packets.insert(4, tcp_frame(b"zz", ISN + 60))  # waits, and is flushed at the end
    chunks, _ = read(scratch, every(MS, packets))
    assert stream(chunks) == bytes(range(50)) + b"zz"
    assert len(chunks) == 101


@settings(max_examples=150, deadline=None)
@given(
    steps=st.lists(
        st.tuples(
            st.one_of(st.integers(0, 200), st.integers(0, 0xFFFFFFFF)),
            st.integers(0, 30),
            st.sampled_from([0, ACK, SYN, SYN | ACK, RST, FIN | ACK, 0x3F]),
            st.integers(0, 0xFFFFFFFF),
            st.booleans(),
        ),
        max_size=40,
    )
)
def test_any_segments_at_all_are_counted(scratch: Path, steps: list[tuple[int, int, int, int, bool]]) -> None:
    packets = [tcp_frame(bytes(size), seq, flags, ack, back=back) for seq, size, flags, ack, back in steps]
    chunks, tally = read(scratch, every(30 * MS, packets))
    tcp_packets = sum(tally.packets[fate] for fate in (Fate.TCP, Fate.TCP_REPEATED, Fate.TCP_STRAY, Fate.TCP_EMPTY))
    assert tcp_packets == len(steps)
    assert all(chunk.data for chunk in chunks)
    assert tally.payload_bytes + tally.repeated_bytes <= sum(size for _, size, *_ in steps)
