"""What the front tells the control process: items in, the same items out, in messages that a socket takes."""

from __future__ import annotations

import socket
from contextlib import suppress
from dataclasses import fields

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcon.core.values import DETAIL
from dcon.link.counts import FrontCounts
from dcon.link.crossing import MESSAGE_BYTES, Item, PmuFrameIn, decode, encode
from dcon.link.failure import Failure
from pmutools.c37118 import Frame
from pmutools.flow import StampSource
from pmutools.net.dialogue import LinkEvent, LinkKind

FRAMES = st.builds(
    PmuFrameIn,
    st.integers(0, 65535),
    st.builds(
        Frame, st.binary(max_size=65535), st.integers(0, 1 << 62), st.sampled_from(list(StampSource)), st.just(0)
    ),
    st.booleans(),
)
WORDS = st.text(max_size=50)
NEWS = st.builds(
    LinkEvent, st.sampled_from(list(LinkKind)), WORDS, st.just(()), WORDS, st.none(), st.none(), st.integers(0, 99)
)
COUNTS = st.builds(FrontCounts, **{item.name: st.integers(0, 1 << 40) for item in fields(FrontCounts)})
ITEMS = st.lists(st.one_of(FRAMES, NEWS, COUNTS, st.builds(Failure, WORDS, st.booleans())), max_size=20)


@given(ITEMS)
def test_what_goes_in_comes_out_in_order(items: list[Item]) -> None:
    sent = list(encode(items))
    assert [item for _, inside in sent for item in inside] == items
    assert [item for message, _ in sent for item in decode(message)] == items
    assert all(len(message) <= MESSAGE_BYTES for message, _ in sent)


def test_words_of_a_stream_are_held_to_what_a_log_has_room_for() -> None:
    ((message, _),) = encode([LinkEvent(LinkKind.NOISE, "udp://[::]:1", (), 9999 * "x")])
    (event,) = decode(message)
    assert isinstance(event, LinkEvent) and event.detail == (DETAIL - 1) * "x" + "…"


@given(ITEMS, st.integers(0, 1 << 20), st.integers(0, 255))
def test_a_bent_message_is_refused_or_read_and_never_more(items: list[Item], at: int, value: int) -> None:
    for message, _ in encode(items):
        bent = bytearray(message)
        bent[at % len(bent)] = value
        for data in (bytes(bent), message[: at % len(message)]):
            with suppress(ValueError):
                assert sum(len(item.frame.data) for item in decode(data) if isinstance(item, PmuFrameIn)) <= len(data)


def test_the_largest_frame_passes_a_pair_with_its_default_buffer() -> None:
    frame = Frame(bytes(65535), 1, StampSource.KERNEL, 0)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        theirs.setblocking(False)
        for message, _ in encode([PmuFrameIn(1, frame, True)]):
            theirs.send(message)
        assert list(decode(ours.recv(1 << 18))) == [PmuFrameIn(1, frame, True)]


@pytest.mark.parametrize("message", [b"\0", bytes(15), b"\x09" + bytes(15), b"\0\xff" + bytes(14)])
def test_what_the_front_cannot_have_sent(message: bytes) -> None:
    with pytest.raises(ValueError, match=r"record|source"):
        list(decode(message))
