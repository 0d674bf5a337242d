"""The ``.proto`` text of the message table: documentation beside the code, and input for other languages' compilers."""

from __future__ import annotations

from pathlib import Path

from pmutools.schema.messages import FILE_NAME, MESSAGES, PACKAGE, Field

PROTO_PATH = Path(__file__).with_name(FILE_NAME)
"""The shipped text; after a change of the table: ``PROTO_PATH.write_text(proto_text(), "utf-8")``."""


def proto_text() -> str:
    """All messages in proto3, with units and topics in the comments."""
    parts = [
        "// Made from pmutools/schema/messages.py; the logs embed the same descriptors.",
        "// Times are POSIX UTC; NaN is an unknown number; lists of one message run in parallel.",
        'syntax = "proto3";',
        f"package {PACKAGE};",
    ]
    for name, message in MESSAGES.items():
        parts += ["", f"// {message.doc}", f"// Topic: {message.topic}", f"message {name} {{"]
        parts += [_field_line(field, number) for number, field in enumerate(message.fields, start=1)]
        parts.append("}")
    return "\n".join(parts) + "\n"


def _field_line(field: Field, number: int) -> str:
    unit = f" [{field.unit}]" if field.unit else ""
    return f"  {'repeated ' if field.repeated else ''}{field.type} {field.name} = {number}; // {field.doc}{unit}"
