"""The watchdog's codec and that of everybody else agree, and neither takes anything but what it should."""

from __future__ import annotations

import math
import struct
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcon.link import beats
from dcon.link import command as link_command
from dcon.watchdog import codec, memory, rules

U32 = st.integers(0, 2**32 - 1)
I64 = st.integers(-(2**63), 2**63 - 1)
FINITE = st.floats(allow_nan=False, allow_infinity=False)


def sealed(body: bytes) -> bytes:
    return body + struct.pack(">I", zlib.crc32(body))


def test_the_names_and_numbers_are_the_same() -> None:
    assert tuple(beats.LoopName) == codec.LOOPS
    assert {int(verb): verb.name.lower() for verb in beats.Verb} == codec.VERBS
    assert beats.CAUSES == rules.CAUSES and len(rules.CAUSES) == len(set(rules.CAUSES)) <= 32
    assert {(s.name, int(s)) for s in beats.WatchdogState} == {(s.name, int(s)) for s in memory.State}
    assert (beats.LoopState.RUNNING, beats.LoopState.FAILED) == (codec.RUNNING, codec.FAILED)


@given(st.sampled_from(beats.LoopName), U32, I64, st.sampled_from(beats.LoopState))
def test_a_beat(loop: beats.LoopName, counter: int, at_ns: int, state: beats.LoopState) -> None:
    datagram = beats.encode_beat(loop, counter, at_ns, state)
    assert len(datagram) == 32
    assert codec.decode(datagram, 0) == codec.Beat(codec.LOOPS.index(loop), counter, state)


@given(U32, I64, FINITE)
def test_a_readback(sequence: int, at_ns: int, volts: float) -> None:
    datagram = beats.encode_readback(beats.Readback(sequence, at_ns, volts))
    assert len(datagram) == 28
    assert codec.decode(datagram, 0) == codec.Readback(sequence, volts)
    assert beats.decode_readback(datagram) == beats.Readback(sequence, at_ns, volts)


@given(st.sampled_from(beats.Verb), st.text(st.characters(exclude_characters="\0", exclude_categories=("Cs",))))
def test_a_word(verb: beats.Verb, who: str) -> None:
    datagram = beats.encode_word(verb, who)
    assert len(datagram) == 44
    said = codec.decode(datagram, 0)
    assert isinstance(said, codec.Word) and said.verb == verb.name.lower()
    assert who.startswith(said.who) and (said.who == who or len(said.who.encode()) > 28)


@given(U32, st.integers(0, 2**62), FINITE, FINITE, st.booleans(), st.integers(-(10**9), 10**9))
def test_a_command(sequence: int, time_ns: int, mw: float, volts: float, relays: bool, age_ms: int) -> None:
    sent = link_command.encode(link_command.CommandOut(sequence, time_ns, mw, volts, int(relays)))
    said = codec.decode(sent, time_ns + age_ms * 10**6)
    assert said == codec.Command(sequence, time_ns, mw, volts, relays, age_ms)
    passed = codec.encode_command(sequence, time_ns, mw, volts, codec.RELAYS | codec.CLOSED)
    assert link_command.decode(passed) == link_command.CommandOut(sequence, time_ns, mw, volts, 3)


AGES = st.lists(st.integers(0, 65_535), min_size=8, max_size=8)


@given(U32, I64, *[st.booleans()] * 5, st.sampled_from(memory.State), st.booleans(), st.sets(st.integers(0, 24)), AGES)
def test_a_status(
    counter: int,
    at_ns: int,
    a: bool,
    b: bool,
    software: bool,
    line_a: bool,
    line_b: bool,
    state: memory.State,
    healthy: bool,
    bits: set[int],
    ages_ms: list[int],
) -> None:
    estop = software | line_a << 1 | line_b << 2
    causes = sum(1 << bit for bit in bits)
    datagram = codec.encode_status(counter, at_ns, a | b << 1, estop, state, healthy, causes, ages_ms)
    assert len(datagram) == 44
    status = beats.decode_status(datagram)
    assert status is not None
    assert status[:7] == (counter, at_ns, a, b, software, line_a, line_b)
    assert (status.state.name, status.healthy, status.causes) == (state.name, healthy, rules.names_of(causes))
    heard = {loop: age_ms for loop, age_ms in zip(codec.LOOPS, ages_ms, strict=True) if age_ms < 65_535}
    assert dict(status.beats_ms) == heard
    assert (status.closed, status.estop_released) == (a and b, software and line_a and line_b)


def test_counters_wrap() -> None:
    status = beats.decode_status(codec.encode_status(2**32 + 5, 0, 0, 0, 0, False, 0))
    assert status is not None and status.counter == 5
    command = link_command.decode(codec.encode_command(2**32 + 7, 0, 0.0, 0.0, 0))
    assert command is not None and command.sequence == 7
    beat = codec.decode(beats.encode_beat(beats.LoopName.GPS, 2**32 + 9, 0), 0)
    assert isinstance(beat, codec.Beat) and beat.counter == 9


GOOD = {
    "command": codec.encode_command(1, 2, 12.5, 1.0, 1),
    "beat": beats.encode_beat(beats.LoopName.UDP, 1, 2),
    "readback": beats.encode_readback(beats.Readback(1, 2, 3.0)),
    "word": beats.encode_word(beats.Verb.RESET, "op"),
}
STATUS = codec.encode_status(1, 2, 3, 7, 1, True, 5)


@pytest.mark.parametrize("name", GOOD)
def test_what_is_damaged_is_malformed(name: str) -> None:
    good = GOOD[name]
    for at in range(len(good)):
        for bit in range(8):
            damaged = bytearray(good)
            damaged[at] ^= 1 << bit
            said = codec.decode(bytes(damaged), 0)  # DCN1 is a bit away from DCO1, which has another size
            allowed = ("magic", "size", "crc") if at < 4 else ("crc",)
            assert isinstance(said, codec.Malformed) and said.reason in allowed, (at, bit)
    for cut in range(len(good)):
        assert codec.decode(good[:cut], 0) == codec.Malformed("magic" if cut < 4 else "size")
    assert codec.decode(good + b"\0", 0) == codec.Malformed("size")


def test_a_damaged_status_or_readback_is_nothing() -> None:
    for good, decode in ((STATUS, beats.decode_status), (GOOD["readback"], beats.decode_readback)):
        assert decode(good) is not None
        for at in range(len(good)):
            damaged = bytearray(good)
            damaged[at] ^= 4
            assert decode(bytes(damaged)) is None
        assert decode(good[:-1]) is None and decode(good + b"\0") is None and decode(b"") is None
    assert beats.decode_status(codec.encode_status(1, 2, 3, 7, 3, True, 5)) is None


NAN, INF = math.nan, math.inf
VALUES = {
    **{f"{mw:g} MW {v:g} V": struct.pack(">4sIqddI", b"DCN1", 1, 2, mw, v, 0) for mw, v in ((NAN, 0), (0, NAN))},
    **{f"{mw:g} MW {v:g} V": struct.pack(">4sIqddI", b"DCN1", 1, 2, mw, v, 0) for mw, v in ((INF, 0), (0, -INF))},
    "a readback of nan": struct.pack(">4sIqd", b"DCR1", 1, 2, NAN),
    "a loop that there is not": struct.pack(">4s8sIqB3x", b"DCB1", b"kontrol", 1, 2, 1),
    "a name that is no ASCII": struct.pack(">4s8sIqB3x", b"DCB1", b"\xff\xfe", 1, 2, 1),
    "a name that goes on": struct.pack(">4s8sIqB3x", b"DCB1", b"gps\0x", 1, 2, 1),
    "a state that there is not": struct.pack(">4s8sIqB3x", b"DCB1", b"gps", 1, 2, 4),
    "a verb that there is not": struct.pack(">4sB3x32s", b"DCO1", 4, b"op"),
    "no verb": struct.pack(">4sB3x32s", b"DCO1", 0, b"op"),
}


@pytest.mark.parametrize("name", VALUES)
def test_a_value_that_cannot_be_is_malformed(name: str) -> None:
    assert codec.decode(sealed(VALUES[name]), 0) == codec.Malformed("value")


@given(st.binary(max_size=80))
def test_random_bytes_are_malformed(data: bytes) -> None:
    assert isinstance(codec.decode(data, 0), codec.Malformed)
    assert beats.decode_status(data) is None and beats.decode_readback(data) is None


def test_the_longest_datagram_fits_what_is_read() -> None:
    assert max(map(len, (*GOOD.values(), STATUS))) < codec.LONGEST
