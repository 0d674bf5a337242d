"""Messages by the thousand give what the protobuf library gives one by one."""

from __future__ import annotations

import math
import random
import struct
from typing import Any

import numpy as np
import pytest
from google.protobuf.message import DecodeError
from hypothesis import given, settings
from hypothesis import strategies as st

from pmutools.schema.columns import FEW, Texts, decode_columns
from pmutools.schema.descriptors import message_class, unnamed_fields
from pmutools.schema.messages import MESSAGES, Field

NAMES = ("READY", "HELD", "INITIALISING", "", "Δf → 9", "x" * 200)


def number(rng: random.Random, kind: str) -> Any:
    if kind == "double":
        return rng.choice((0.0, -0.0, math.nan, math.inf, 5e-324, rng.gauss(0, 10)))
    if kind == "bool":
        return rng.random() < 0.5
    if kind == "string":
        return rng.choice(NAMES)
    if kind == "bytes":
        return rng.randbytes(rng.choice((0, 5, 40)))
    low, high = {
        "int32": (-(1 << 31), (1 << 31) - 1),
        "uint32": (0, (1 << 32) - 1),
        "int64": (-(1 << 63), (1 << 63) - 1),
        "uint64": (0, (1 << 64) - 1),
    }[kind]
    return rng.choice((0, low, high, 1, 127, 128, rng.randint(low, high)))


def message(name: str, rng: random.Random) -> bytes:
    made = message_class(name)()
    for field in MESSAGES[name].fields:
        if rng.random() < 0.2:
            continue
        if field.repeated:
            getattr(made, field.name).extend(number(rng, field.type) for _ in range(rng.choice((0, 2, 2, 2, 3))))
        else:
            setattr(made, field.name, number(rng, field.type))
    return bytes(made.SerializeToString())


def bits(value: Any) -> Any:
    return struct.pack("<d", value) if isinstance(value, float) else value


def compare(name: str, messages: list[bytes], fields: list[str] | None = None) -> int:
    """Every field of every message, to the last bit; how many decode."""
    kinds = {field.name: field for field in MESSAGES[name].fields if field.type != "bytes"}
    wanted = list(kinds) if fields is None else fields
    columns = decode_columns(name, messages, wanted)
    assert list(columns.fields) == [key for key in kinds if key in wanted]
    expected = []
    for row, data in enumerate(messages):
        try:
            expected.append((row, message_class(name).FromString(data)))
        except DecodeError:
            continue
    assert columns.rows.tolist() == [row for row, _ in expected]
    assert columns.unnamed >= {field for _, decoded in expected for field in unnamed_fields(decoded)}
    for key in wanted:
        column = columns.fields[key]
        for place, (_, decoded) in enumerate(expected):
            assert bits(of_row(column, place, kinds[key], decoded)) == bits(getattr_plain(decoded, kinds[key])), key
    return len(expected)


def getattr_plain(decoded: Any, field: Field) -> Any:
    value = getattr(decoded, field.name)
    return [bits(each) for each in value] if field.repeated else value


def of_row(column: Any, place: int, field: Field, decoded: Any) -> Any:
    if isinstance(column, Texts):
        codes = np.atleast_1d(column.codes[place]).tolist()
        values: list[Any] = [None if code < 0 else column.values[code] for code in codes]
    else:
        values = np.atleast_1d(column[place]).tolist()
    if not field.repeated:
        return values[0]
    count = len(getattr(decoded, field.name))
    fill = {"double": struct.pack("<d", math.nan), "string": None}.get(field.type, 0)
    assert [bits(each) for each in values[count:]] == [fill] * (len(values) - count)
    return [bits(each) for each in values[:count]]


@pytest.mark.parametrize("name", MESSAGES)
@pytest.mark.parametrize("count", [0, 1, FEW + 1, 400])
def test_every_kind_of_message(name: str, count: int) -> None:
    rng = random.Random(count)
    assert compare(name, [message(name, rng) for _ in range(count)]) == count


def test_wanted_fields_only() -> None:
    rng = random.Random(1)
    messages = [message("Tick", rng) for _ in range(50)]
    assert compare("Tick", messages, ["tick_ns", "age_ms"]) == 50


def test_what_our_writer_would_not_write() -> None:
    """Lists that are not packed, fields twice, in any order, of a newer version, groups, varints too long."""
    rng = random.Random(2)
    tick = message_class("Tick")
    odd = [
        b"\x61" + struct.pack("<d", 5.0) + b"\x61" + struct.pack("<d", 6.0),  # f_hz unpacked
        tick(tick_ns=5).SerializeToString() + tick(tick_ns=7, state="OFF").SerializeToString(),
        b"\x9a\x06\x03new" + tick(tick_ns=5).SerializeToString(),
        b"\xf8\xff\xff\xff\x0f\x01" + tick(tick_ns=5).SerializeToString(),  # a very large field number
        tick(tick_ns=5).SerializeToString() + b"\x9d\x06abcd" + b"\x99\x06abcdefgh" + b"\x98\x06\x96\x01",
        b"\x9b\x06\x08\x01\x9c\x06" + tick(tick_ns=5).SerializeToString(),  # a group
        b"\x08\x85\x80\x00",  # tick_ns 5 in three bytes
        b"\x20\xff\xff\xff\xff\x7f",  # active beyond 32 bits
        b"",
    ]
    plain = [message("Tick", rng) for _ in range(30)]
    for copies in (1, FEW + 2):
        messages = [each for each in odd for _ in range(copies)] + plain
        rng.shuffle(messages)
        assert compare("Tick", messages) == len(messages)


def test_messages_that_do_not_decode_are_left_out() -> None:
    rng = random.Random(3)
    good = [message("Instance", rng) for _ in range(200)]
    bad = [b"\xff", b"\x12\x05ab", b"\x12\x02\xff\xfe", b"\x08", b"\x22\x07abcdefg", b"\x0b", b"\x00\x01"]
    for copies in (1, FEW + 2):
        messages = good + [each for each in bad for _ in range(copies)]
        rng.shuffle(messages)
        assert compare("Instance", messages) == len(good)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from(sorted(MESSAGES)), st.integers(1, 40))
def test_damaged_messages_are_read_or_left_out_as_the_library_does(seed: int, name: str, count: int) -> None:
    rng = random.Random(seed)
    messages = []
    for _ in range(count):
        data = bytearray(message(name, rng))
        for _ in range(rng.choice((0, 1, 3))):
            if data:
                data[rng.randrange(len(data))] = rng.randrange(256)
        messages += [bytes(data[: rng.choice((len(data), rng.randint(0, len(data))))])] * rng.choice((1, FEW + 1))
    compare(name, messages)
