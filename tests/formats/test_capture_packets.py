"""Link layers, IPv4 and IPv6, fragments, UDP: which packets give which chunk, and what becomes of the others."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.packets import (
    A6,
    B6,
    SYN,
    T0,
    Record,
    cooked,
    ethernet,
    ipv4,
    ipv6,
    ipv6_fragment,
    pcap,
    tcp,
    tcp_frame,
    udp,
    udp_frame,
)

from pmutools.flow import Chunk, Flow
from pmutools.formats.capture import CaptureReader, Fate, Tally, ip, reader
from pmutools.formats.capture.plain import Plain, plain
from pmutools.formats.capture.records import Records

FLOW4 = Flow("udp", "192.0.2.1:4713", "192.0.2.2:50000")
FLOW6 = Flow("udp", "[2001:db8::1]:4713", "[2001:db8::2]:50000")


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("captures") / "capture"


def read(path: Path, records: Sequence[Record], linktype: int = 1) -> tuple[list[Chunk], Tally]:
    path.write_bytes(pcap(records, linktype=linktype))
    opened = CaptureReader(path)
    chunks = list(opened)
    tally = opened.tally
    assert tally.total_packets == len(records)
    assert sum(tally.nbytes.values()) == sum(len(record[1]) for record in records)
    return chunks, tally


def fate(path: Path, packet: bytes, linktype: int = 1, wire: int | None = None) -> Fate:
    """What becomes of one packet that gives no chunk."""
    chunks, tally = read(path, [(T0, packet, wire or len(packet))], linktype)
    assert chunks == []
    (only,) = (fate for fate, count in tally.packets.items() if count)
    return only


@pytest.mark.parametrize("network", [ipv4(udp(b"frame")), ipv6(udp(b"frame"))], ids=["ipv4", "ipv6"])
@pytest.mark.parametrize(
    ("linktype", "wrap"),
    [
        (1, lambda network: ethernet(network)),
        (1, lambda network: ethernet(network, vlans=[0x8100])),
        (1, lambda network: ethernet(network, vlans=[0x88A8, 0x8100])),
        (1, lambda network: ethernet(network, vlans=[0x9100, 0x8100, 0x8100])),
        (1, lambda network: ethernet(network) + bytes(40)),  # padding, trailer
        (113, lambda network: cooked(network, 1)),
        (276, lambda network: cooked(network, 2)),
        (12, bytes),
        (14, bytes),
        (101, bytes),
        (0, lambda network: struct.pack("<I", 2 if network[0] >> 4 == 4 else 30) + network),
        (0, lambda network: struct.pack(">I", 2 if network[0] >> 4 == 4 else 24) + network),
        (108, lambda network: struct.pack(">I", 2 if network[0] >> 4 == 4 else 28) + network),
        (1 | 0x2400_0000, lambda network: ethernet(network) + bytes(4)),  # frame check sequence, and its flag
    ],
)
def test_link_layers(scratch: Path, network: bytes, linktype: int, wrap: Callable[[bytes], bytes]) -> None:
    (chunk,), tally = read(scratch, [(T0, wrap(network))], linktype)
    assert chunk == Chunk(b"frame", T0, FLOW4 if network[0] >> 4 == 4 else FLOW6)
    assert tally.is_clean


@pytest.mark.parametrize(("linktype", "network"), [(228, ipv4(udp(b"x"))), (229, ipv6(udp(b"x")))])
def test_raw_ip_of_one_version(scratch: Path, linktype: int, network: bytes) -> None:
    (chunk,), _ = read(scratch, [(T0, network)], linktype)
    assert chunk.data == b"x"


@pytest.mark.parametrize(
    ("packet", "expected"),
    [
        (ethernet(bytes(28), 0x0806), Fate.NOT_IP),
        (ethernet(bytes(50), 100), Fate.NOT_IP),  # 802.3 length
        (ethernet(ipv4(b"x" * 20), vlans=[0x8100] * 9), Fate.NOT_IP),
        (ethernet(ipv4(bytes(8), 1)), Fate.OTHER_IP),
        (ethernet(ipv6(bytes(8), 58)), Fate.OTHER_IP),
        (ethernet(ipv6(b"", 59)), Fate.OTHER_IP),
        (ethernet(ipv6(bytes(40), 50)), Fate.OTHER_IP),  # encrypted
        (ethernet(b"\x45"), Fate.DAMAGED),
        (ethernet(ipv4(udp(b"abc"), total=60)), Fate.DAMAGED),
        (ethernet(ipv4(udp(b"abc"), total=19)), Fate.DAMAGED),
        (ethernet(b"\x43" + ipv4(udp(b"abc"))[1:]), Fate.DAMAGED),
        (ethernet(b"\x65" + ipv4(udp(b"abc"))[1:], 0x0800), Fate.DAMAGED),
        (ethernet(b"\x45" + ipv6(udp(b"abc"))[1:], 0x86DD), Fate.DAMAGED),
        (ethernet(ipv4(udp(b"abc", length=7))), Fate.DAMAGED),
        (ethernet(ipv4(udp(b"abc", length=12))), Fate.DAMAGED),
        (ethernet(ipv4(b"\0\0\0", 17)), Fate.DAMAGED),
        (ethernet(ipv4(b"\0" * 10, 6)), Fate.DAMAGED),
        (ethernet(ipv4(tcp(b"abc", 5)[:12] + b"\xf0" + tcp(b"abc", 5)[13:], 6)), Fate.DAMAGED),
        (ethernet(ipv4(tcp(b"abc", 5)[:12] + b"\x40" + tcp(b"abc", 5)[13:], 6)), Fate.DAMAGED),
        (ethernet(ipv6(bytes((17, 200)) + bytes(6), 0)), Fate.DAMAGED),  # hop-by-hop options longer than the packet
        (tcp_frame(b"", 5), Fate.TCP_EMPTY),
        (tcp_frame(b"", 5, SYN), Fate.TCP_EMPTY),
    ],
)
def test_what_gives_no_chunk(scratch: Path, packet: bytes, expected: Fate) -> None:
    assert fate(scratch, packet) is expected


def test_unsupported_links_are_named(scratch: Path) -> None:
    assert fate(scratch, udp_frame(b"x"), 127) is Fate.UNSUPPORTED_LINK
    _, tally = read(scratch, [(T0, udp_frame(b"x")), (T0, udp_frame(b"y"))], 105)
    assert tally.unsupported_links == {105: 2}
    assert fate(scratch, struct.pack("<I", 7) + ipv4(udp(b"x")), 0) is Fate.NOT_IP


@pytest.mark.parametrize(
    "packet",
    [
        udp_frame(bytes(50)),
        ethernet(ipv6(udp(bytes(50)))),
        ethernet(ipv4(udp(bytes(50)), options=bytes(8)), vlans=[0x8100]),
        tcp_frame(bytes(50), 5),
        ethernet(ipv4(udp(bytes(48))[:40], ident=3, more=True)),
    ],
)
def test_packets_cut_by_the_snapshot_length_are_never_taken_for_whole(scratch: Path, packet: bytes) -> None:
    for length in range(1, len(packet)):
        assert fate(scratch, packet[:length], wire=len(packet)) is Fate.TRUNCATED


def test_a_cut_that_takes_only_padding_harms_nothing(scratch: Path) -> None:
    packet = udp_frame(b"x")
    (chunk,), tally = read(scratch, [(T0, packet, 60)])
    assert (chunk.data, tally.is_clean) == (b"x", True)


def test_headers_with_options(scratch: Path) -> None:
    (chunk,), _ = read(scratch, [(T0, ethernet(ipv4(udp(b"opt"), options=b"\x94\x04\0\0" + bytes(36))))])
    assert chunk.data == b"opt"
    authentication = bytes((60, 4)) + bytes(22)
    chain = bytes((43, 0)) + bytes(6) + bytes((51, 1)) + bytes(14) + authentication + bytes((17, 0)) + bytes(6)
    (chunk,), _ = read(scratch, [(T0, ethernet(ipv6(chain + udp(b"ext"), 0)))])
    assert chunk == Chunk(b"ext", T0, FLOW6)


def test_lengths_left_to_the_network_card(scratch: Path) -> None:
    """Segmentation offload: an IPv4 total length, an IPv6 payload length or a UDP length of 0 means all there is."""
    for packet in (
        ethernet(ipv4(udp(b"offload"), total=0)),
        ethernet(ipv4(udp(b"offload", length=0))),
        ethernet(struct.pack(">IHBB", 6 << 28, 0, 17, 64) + A6 + B6 + udp(b"offload")),
    ):
        (chunk,), _ = read(scratch, [(T0, packet)])
        assert chunk.data == b"offload"


def test_an_empty_datagram_is_one(scratch: Path) -> None:
    (chunk,), tally = read(scratch, [(T0, udp_frame(b""))])
    assert (chunk.data, tally.packets[Fate.UDP]) == (b"", 1)


# Fragments


def pieces4(payload: bytes, cuts: list[int], ident: int = 77) -> list[bytes]:
    edges = [0, *cuts, len(payload)]
    return [
        ethernet(ipv4(payload[begin:end], ident=ident, offset=begin, more=end < len(payload)))
        for begin, end in pairwise(edges)
    ]


def pieces6(payload: bytes, cuts: list[int], ident: int = 77) -> list[bytes]:
    edges = [0, *cuts, len(payload)]
    return [
        ethernet(ipv6_fragment(payload[begin:end], 17, begin, end < len(payload), ident))
        for begin, end in pairwise(edges)
    ]


@settings(max_examples=80, deadline=None)
@given(
    size=st.integers(16, 4000),
    places=st.sets(st.integers(1, 500), min_size=1, max_size=12),
    pieces=st.sampled_from([pieces4, pieces6]),
    repeats=st.integers(0, 3),
    seed=st.integers(0, 1 << 32),
)
def test_fragments_in_any_order_repeated_and_interleaved(
    scratch: Path, size: int, places: set[int], pieces: Callable[..., list[bytes]], repeats: int, seed: int
) -> None:
    shuffle = random.Random(seed)
    data = shuffle.randbytes(size)
    cuts = sorted({8 * place for place in places if 8 * place < size + 8}) or [8]
    mine = pieces(udp(data), cuts)
    mine += [shuffle.choice(mine[:-1]) for _ in range(repeats)]
    shuffle.shuffle(mine)
    other = pieces(udp(data[::-1]), cuts[:1], 78)
    packets = [*mine, *other]
    shuffle.shuffle(packets)
    stamped = list(zip(range(T0, T0 + len(packets)), packets, strict=True))
    chunks, tally = read(scratch, stamped)
    assert sorted(chunk.data for chunk in chunks) == sorted([data, data[::-1]])
    for chunk, parts in ((chunk, mine if chunk.data == data else other) for chunk in chunks):
        seen: set[bytes] = set()
        done = 0
        for at, packet in stamped:
            if packet in parts and packet not in seen:
                seen.add(packet)
                done = at
        assert chunk.arrival_ns == done
    assert tally.fragments == len(packets)
    # Repeats that come after their datagram begin another, which never becomes whole.
    assert tally.packets[Fate.UDP] + tally.packets[Fate.FRAGMENT_LOST] == len(packets)
    assert tally.packets[Fate.FRAGMENT_LOST] <= repeats


def test_overlapping_fragments_join(scratch: Path) -> None:
    payload = udp(bytes(range(100)))
    spans = [(0, 40, True), (24, 64, True), (56, 108, False)]
    packets = [ethernet(ipv4(payload[a:b], ident=1, offset=a, more=more)) for a, b, more in spans]
    (chunk,), _ = read(scratch, [(T0, packet) for packet in packets])
    assert chunk.data == bytes(range(100))


def test_a_fragmented_segment_goes_to_its_connection(scratch: Path) -> None:
    segment = tcp(bytes(range(64)), 1000)
    packets = [
        ethernet(ipv4(segment[:32], 6, ident=5, more=True)),
        ethernet(ipv4(segment[32:], 6, ident=5, offset=32)),
        tcp_frame(b"next", 1064),
    ]
    chunks, tally = read(scratch, [(T0, packet) for packet in packets])
    assert b"".join(chunk.data for chunk in chunks) == bytes(range(64)) + b"next"
    assert tally.packets[Fate.TCP] == 3


def test_extension_headers_inside_fragments(scratch: Path) -> None:
    payload = bytes((17, 0)) + bytes(6) + udp(b"inside")
    atomic = struct.pack(">BBHI", 17, 0, 0b110, 4)  # whole, whatever its reserved bits
    packets = [
        ethernet(ipv6_fragment(payload[:8], 60, 0, True)),
        ethernet(ipv6_fragment(payload[8:], 17, 8, False)),  # the first fragment's next header counts
        ethernet(ipv6(atomic + udp(b"atomic"), 44)),
    ]
    chunks, tally = read(scratch, [(T0, packet) for packet in packets])
    assert [chunk.data for chunk in chunks] == [b"inside", b"atomic"]
    nested = struct.pack(">BBHI", 17, 0, 8, 4) + bytes(16)
    assert fate(scratch, ethernet(ipv6(nested[:4] * 2, 44))) is Fate.DAMAGED
    packets = [
        ethernet(ipv6_fragment(nested[:8], 44, 0, True)),
        ethernet(ipv6_fragment(nested[8:], 44, 8, False)),
    ]
    chunks, tally = read(scratch, [(T0, packet) for packet in packets])
    assert (chunks, tally.packets[Fate.DAMAGED]) == ([], 2)


@pytest.mark.parametrize(("offset", "size", "more"), [(0, 20, True), (65528, 16, False), (8, 0, False)])
def test_impossible_fragments(scratch: Path, offset: int, size: int, more: bool) -> None:
    assert fate(scratch, ethernet(ipv4(bytes(size), ident=1, offset=offset, more=more))) is Fate.DAMAGED


def test_incomplete_datagrams_are_given_up_by_age_number_bytes_and_at_the_end(
    scratch: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, last = pieces4(udp(bytes(64)), [40])
    chunks, tally = read(scratch, [(T0, first), (T0 + 31 * 10**9, last)])
    assert (chunks, tally.packets[Fate.FRAGMENT_LOST], tally.is_clean) == ([], 2, False)
    chunks, _ = read(scratch, [(T0, first), (T0 + 29 * 10**9, last)])
    assert len(chunks) == 1

    heads = [pieces4(udp(bytes(64)), [40], ident)[0] for ident in range(20)]
    tails = [pieces4(udp(bytes(64)), [40], ident)[1] for ident in reversed(range(20))]
    records: list[Record] = [(T0, packet) for packet in heads + tails]
    for limit, value in (("MAX_PARTIALS", 5), ("MAX_PARTIAL_BYTES", 5 * 40)):
        with monkeypatch.context() as patch:
            patch.setattr(ip, limit, value)
            chunks, tally = read(scratch, records)
            assert (len(chunks), tally.packets[Fate.FRAGMENT_LOST]) == (5, 30)


@settings(max_examples=150, deadline=None)
@given(
    linktype=st.sampled_from([0, 1, 101, 113, 228, 229, 276]),
    packets=st.lists(
        st.one_of(
            st.binary(max_size=80),
            st.tuples(
                st.sampled_from(
                    [
                        udp_frame(b"frame"),
                        tcp_frame(b"frame", 7),
                        ethernet(ipv6(udp(b"frame"))),
                        ethernet(ipv4(udp(b"frame")), vlans=[0x8100]),
                        cooked(ipv4(udp(b"frame")), 1),
                        pieces6(udp(bytes(40)), [16])[0],
                    ]
                ),
                st.integers(0, 60),
                st.integers(0, 255),
            ).map(lambda hit: hit[0][: hit[1]] + bytes((hit[2],)) + hit[0][hit[1] + 1 :]),
        ),
        min_size=1,
        max_size=12,
    ),
    cut=st.booleans(),
)
def test_any_packet_has_one_fate_and_the_short_way_agrees_with_the_general(
    scratch: Path, linktype: int, packets: list[bytes], cut: bool
) -> None:
    records: list[Record] = [(T0, packet or b"\0", max(1, len(packet)) + 9 * cut) for packet in packets]
    short = read(scratch, records, linktype)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reader, "plain", _none_plain)
        assert read(scratch, records, linktype) == short


def _none_plain(records: Records) -> Plain:
    found = plain(records)
    return found._replace(udp=found.udp & False, tcp=found.tcp & False)


def test_flows_are_forgotten_beyond_their_bound(scratch: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "MAX_FLOWS", 4)
    records: list[Record] = [(T0, ethernet(ipv4(udp(b"x", port)))) for port in [*range(1, 11), *range(1, 11)]]
    chunks, _ = read(scratch, records)
    assert [chunk.flow.source for chunk in chunks] == [f"192.0.2.1:{port}" for port in range(1, 11)] * 2
