"""Frame bytes plus skipped bytes equal input bytes, however the input is cut, damaged or forged."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmutools.c37118 import Frame, Framer, Skipped, SkipReason, encode_command, encode_header
from pmutools.c37118 import framer as framer_module
from pmutools.c37118.checksum import chk
from pmutools.flow import StampSource

FRAMES = [encode_command(7, 2), encode_header(7, "a device"), encode_command(7, 8, extended=b"\xaa\x01\xff\xff" * 9)]


def drain(framer: Framer, pieces: list[bytes]) -> list[Frame | Skipped]:
    out = [item for piece in pieces for item in framer.feed(piece)]
    return out + framer.close()


def accounted(items: list[Frame | Skipped]) -> int:
    at = 0
    for item in items:
        assert item.offset == at, "items are contiguous and in order"
        at += item.nbytes if isinstance(item, Skipped) else len(item.data)
    return at


def frames_of(items: list[Frame | Skipped]) -> list[bytes]:
    return [item.data for item in items if isinstance(item, Frame)]


def cut(data: bytes, sizes: list[int]) -> list[bytes]:
    pieces, at = [], 0
    for size in sizes:
        pieces.append(data[at : at + size])
        at += size
    return [*pieces, data[at:]]


@given(st.lists(st.sampled_from(FRAMES), max_size=6), st.lists(st.integers(1, 40), max_size=30))
def test_clean_stream_survives_any_cut(frames: list[bytes], sizes: list[int]) -> None:
    items = drain(Framer(streaming=True), cut(b"".join(frames), sizes))
    assert frames_of(items) == frames


@given(st.lists(st.one_of(st.sampled_from(FRAMES), st.binary(max_size=50)), max_size=8), st.lists(st.integers(1, 60)))
def test_every_byte_is_in_exactly_one_item(parts: list[bytes], sizes: list[int]) -> None:
    data = b"".join(parts)
    items = drain(Framer(streaming=True), cut(data, sizes))
    assert accounted(items) == len(data)
    assert all(not chk(frame) for frame in frames_of(items))


@given(st.integers(0, 10_000), st.integers(0, 7))
def test_flipped_bit_costs_at_most_its_own_frame(position: int, bit: int) -> None:
    stream = bytearray(b"".join(FRAMES[:2] * 4))
    position %= len(stream)
    stream[position] ^= 1 << bit
    items = drain(Framer(streaming=True), [bytes(stream)])
    assert accounted(items) == len(stream)
    assert len(frames_of(items)) == 7


def test_resync_goes_on_just_past_the_false_sync() -> None:
    lying = b"\xaa\x01\x00\x40"  # claims 64 bytes, which reach into the good frame behind it
    items = drain(Framer(streaming=True), [lying + FRAMES[0] + FRAMES[1] + bytes(40)])
    assert frames_of(items) == FRAMES[:2]
    assert items[0] == Skipped(SkipReason.BAD_CHK, 0, 4, int.from_bytes(FRAMES[0][:2], "big"))


def test_absurd_framesize_does_not_hold_back_a_known_stream() -> None:
    framer = Framer(streaming=True)
    assert frames_of(framer.feed(FRAMES[0])) == FRAMES[:1]
    assert frames_of(framer.feed(b"\xaa\x01\xff\xff" + FRAMES[0])) == FRAMES[:1]
    assert framer.pending == 0


def test_frame_of_2024_is_skipped_by_its_size() -> None:
    body = b"\xaa\x83\x00\x14" + bytes(14)
    newer = body + chk(body).to_bytes(2, "big")
    items = drain(Framer(streaming=True), [newer * 2 + FRAMES[0]])
    assert [item.reason for item in items if isinstance(item, Skipped)] == [SkipReason.UNSUPPORTED] * 2
    assert frames_of(items) == FRAMES[:1]


def test_datagrams_carry_nothing_over() -> None:
    framer = Framer(streaming=False)
    first, second = FRAMES[1][:10], FRAMES[1][10:]
    items = framer.feed(first) + framer.feed(second)
    assert not frames_of(items)
    assert accounted(items) == len(FRAMES[1])


@pytest.mark.parametrize("bad", [FRAMES[1][:-1] + b"?", b"\xaa\x01\x00\x03" + FRAMES[0][4:], b"\xaa\x71" + bytes(40)])
def test_good_frames_behind_a_bad_one_of_their_datagram_are_found(bad: bytes) -> None:
    items = Framer(streaming=False).feed(bad + FRAMES[0] + FRAMES[1])
    assert frames_of(items) == FRAMES[:2] and accounted(items) == len(bad + FRAMES[0] + FRAMES[1])


@pytest.mark.parametrize("shape", [b"\xaa\x01\x40\x00", b"\xaa\x01\xff\xff", b"\xaa\x01\x00\x00", b"\xaa", b"\xaa\x71"])
def test_a_datagram_of_false_frames_costs_a_few_checks(monkeypatch: pytest.MonkeyPatch, shape: bytes) -> None:
    """Of 65,507 bytes, where each few may begin a frame: not as many checks as there are places."""
    checks = 0

    def counted(data: bytes) -> int:
        nonlocal checks
        checks += 1
        return chk(data)

    monkeypatch.setattr(framer_module, "chk", counted)
    hostile = (shape * 65_507)[:65_507]
    framer = Framer(streaming=False)
    items = framer.feed(FRAMES[0] + hostile) + framer.feed(FRAMES[1])
    assert frames_of(items) == FRAMES[:2] and len(items) == 3, "one run of bytes, and the next datagram is read"
    assert accounted(items) == len(FRAMES[0] + hostile + FRAMES[1])
    assert checks <= 2 + framer_module.TRIES


def test_a_hole_ends_what_was_pending() -> None:
    framer = Framer(streaming=True)
    items = framer.feed(FRAMES[1][:10]) + framer.feed(FRAMES[0], lost_before=100)
    assert [item.reason for item in items if isinstance(item, Skipped)] == [SkipReason.TRUNCATED]
    assert frames_of(items) == FRAMES[:1]


def test_arrival_is_that_of_the_last_byte() -> None:
    framer = Framer(streaming=True)
    assert framer.feed(FRAMES[0][:5], 100) == []
    (frame,) = framer.feed(FRAMES[0][5:], 200)
    assert isinstance(frame, Frame)
    assert frame.arrival_ns == 200


@pytest.mark.parametrize("hostile", [b"\xaa\x01\xff\xff" * 4000, b"\xaa" * 20000, bytes(100000)])
def test_hostile_input_is_bounded_in_memory(hostile: bytes) -> None:
    framer = Framer(streaming=True)
    items = framer.feed(hostile)
    assert framer.pending <= 0xFFFF
    assert accounted(items + framer.close()) == len(hostile)


LONG = encode_header(7, "x" * 3000)
LYING = b"\xaa\x01\xff\xff"


@pytest.mark.parametrize("piece", [1, 7, 1400, 1 << 20])
@pytest.mark.parametrize(
    "hostile",
    [
        pytest.param(LYING + LONG[:6] * 1500, id="beginnings of a known frame behind a false SYNC"),
        pytest.param(LYING + LONG[:-1] * 3, id="known frames without their end"),
        pytest.param(b"\xaa\x01\x10\x00" * 2000, id="a SYNC every four bytes"),
        pytest.param(b"\xaa" * 8000, id="half a SYNC every byte"),
    ],
)
def test_no_byte_begins_more_than_two_checks(monkeypatch: pytest.MonkeyPatch, hostile: bytes, piece: int) -> None:
    """However the input is cut: once as it is looked for behind an unproven candidate, once as its turn comes."""
    checks = 0

    def counted(data: bytes) -> int:
        nonlocal checks
        checks += 1
        return chk(data)

    framer = Framer(streaming=True)
    assert frames_of(framer.feed(LONG)) == [LONG]
    monkeypatch.setattr(framer_module, "chk", counted)
    items = [item for at in range(0, len(hostile), piece) for item in framer.feed(hostile[at : at + piece])]
    items += framer.close()
    assert sum(item.nbytes if isinstance(item, Skipped) else len(item.data) for item in items) == len(hostile)
    assert checks <= 2 * (hostile.count(b"\xaa\x01") + hostile.count(LONG[:2]))


@given(st.binary(max_size=300).map(lambda noise: noise.replace(b"\x00", b"\xaa").replace(b"\x01", b"\xaa\x83")))
def test_a_frame_behind_half_syncs_is_found(noise: bytes) -> None:
    framer = Framer(streaming=True)
    framer.feed(FRAMES[0])
    items = framer.feed(noise + FRAMES[0]) + framer.close()
    assert frames_of(items)[-1:] == FRAMES[:1]


@pytest.mark.parametrize("source", StampSource)
def test_frames_that_share_a_read_share_a_stamp_that_is_too_late_for_all_but_the_last(source: StampSource) -> None:
    """In a capture each packet has its own, and what user space stamps is late anyway."""
    framer = Framer(streaming=True)
    items = framer.feed(b"".join(FRAMES) + FRAMES[0][:5], 1, source) + framer.feed(FRAMES[0][5:], 2, source)
    batched = StampSource.KERNEL_BATCHED if source in (StampSource.KERNEL, StampSource.HARDWARE) else source
    expected = [(1, batched)] * 3 + [(2, source)]
    assert [(item.arrival_ns, item.stamp_source) for item in items if isinstance(item, Frame)] == expected
    whole = Framer(streaming=False).feed(b"".join(FRAMES), 1, source)
    assert {item.stamp_source for item in whole if isinstance(item, Frame)} == {source}
