"""The message table, its protobuf classes and the shipped ``.proto`` text."""

from __future__ import annotations

import math
import re
import struct
import subprocess
import sys
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmutools.schema.descriptors import file_descriptor_set, full_name, message_class, short_name
from pmutools.schema.messages import MESSAGES, Field
from pmutools.schema.proto import PROTO_PATH, proto_text

VALUES: dict[str, st.SearchStrategy[Any]] = {
    "int64": st.integers(-(2**63), 2**63 - 1),
    "uint64": st.integers(0, 2**64 - 1),
    "int32": st.integers(-(2**31), 2**31 - 1),
    "uint32": st.integers(0, 2**32 - 1),
    "double": st.floats() | st.sampled_from((-0.0, math.nan, math.inf)),
    "bool": st.booleans(),
    "string": st.text(),
    "bytes": st.binary(),
}


def values_of(field: Field) -> st.SearchStrategy[Any]:
    return st.lists(VALUES[field.type], max_size=4) if field.repeated else VALUES[field.type]


def bits(value: object) -> object:
    """Something that is equal exactly where every bit is."""
    if isinstance(value, float):
        return struct.pack(">d", value)
    return [bits(item) for item in value] if isinstance(value, list) else value


@pytest.mark.parametrize("name", MESSAGES)
def test_every_field_comes_back_bit_for_bit(name: str) -> None:
    fields = MESSAGES[name].fields

    @given(st.fixed_dictionaries({field.name: values_of(field) for field in fields}))
    def round_trip(values: dict[str, Any]) -> None:
        wire = message_class(name)(**values).SerializeToString()
        back = message_class(name).FromString(wire)
        for field in fields:
            value = getattr(back, field.name)
            assert bits(list(value) if field.repeated else value) == bits(values[field.name])

    round_trip()


def test_shipped_proto_text_is_that_of_the_table() -> None:
    remedy = "PROTO_PATH.write_text(proto_text(), 'utf-8') in pmutools.schema.proto"
    assert PROTO_PATH.read_text("utf-8") == proto_text(), f"after a change of the table: {remedy}"


def test_proto_text_and_descriptors_agree() -> None:
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet

    (file,) = FileDescriptorSet.FromString(file_descriptor_set()).file
    described = [
        (
            message.name,
            field.name,
            field.number,
            FieldDescriptorProto.Type.Name(field.type)[5:].lower(),
            field.label == 3,
        )
        for message in file.message_type
        for field in message.field
    ]
    parsed = []
    message = ""
    for line in proto_text().splitlines():
        if match := re.fullmatch(r"message (\w+) \{", line):
            message = match[1]
        elif match := re.fullmatch(r"  (repeated )?(\w+) (\w+) = (\d+); // .+", line):
            parsed.append((message, match[3], int(match[4]), match[2], match[1] is not None))
    assert parsed == described


def test_all_topics_are_there() -> None:
    dcon = {f"/dcon/{name}" for name in ("tick", "instance", "event", "setting", "watchdog", "timing", "pdci")}
    added = {"/dcon/flag", "/dcon/surroundings", "/dcon/counts", "/dcon/checkpoint"}
    assert {message.topic for message in MESSAGES.values()} == {"/pmu/NAME/frame"} | dcon | added


def test_every_field_is_documented_and_every_quantity_has_its_unit() -> None:
    units = {"_ns": "ns", "_ms": "ms", "_us": "us", "_hz": "Hz", "_hz_s": "Hz/s", "_mw": "MW", "_mhz": "mHz", "_v": "V"}
    for name, message in MESSAGES.items():
        for field in message.fields:
            assert field.doc.endswith("."), (name, field.name)
            suffix = max((suffix for suffix in units if field.name.endswith(suffix)), key=len, default=None)
            if suffix is not None and field.name != "gain_mw_per_mhz":
                assert field.unit == units[suffix], (name, field.name)


def test_names_of_schemas() -> None:
    assert [short_name(full_name(name)) for name in MESSAGES] == list(MESSAGES)
    assert short_name("pmutools.Tock") is None
    assert short_name("Tick") is None
    assert short_name("foxglove.Tick") is None


def test_importing_the_schema_imports_neither_protobuf_nor_mcap() -> None:
    code = (
        "import sys, pmutools.schema.pmu_log, dcon.export.export;"
        "print([m for m in ('google.protobuf', 'mcap', 'zstandard', 'pyarrow') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "[]"
