"""Protobuf classes and descriptor bytes, built at run time from :mod:`pmutools.schema.messages`.

No compiler and no generated code, which would tie users to one protobuf version. protobuf is imported on first use.
"""

from __future__ import annotations

from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any

from pmutools.schema.messages import FILE_NAME, MESSAGES, PACKAGE

if TYPE_CHECKING:
    from google.protobuf.descriptor_pb2 import FileDescriptorProto


def full_name(name: str) -> str:
    """Name of message ``name`` as a schema record gives it, e.g. ``pmutools.Tick``."""
    return f"{PACKAGE}.{name}"


def short_name(schema: str) -> str | None:
    """The inverse of :func:`full_name`; None for a schema that is not ours."""
    package, _, name = schema.rpartition(".")
    return name if package == PACKAGE and name in MESSAGES else None


@cache
def message_class(name: str) -> Any:
    """The protobuf class of message ``name``; raises KeyError for a name that the table lacks."""
    return _classes()[full_name(name)]


@cache
def file_descriptor_set() -> bytes:
    """A serialised ``google.protobuf.FileDescriptorSet``: the data of a protobuf schema record in MCAP."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    return FileDescriptorSet(file=[_file_descriptor()]).SerializeToString(deterministic=True)


@lru_cache(maxsize=16)
def unknown_fields(schema: bytes) -> frozenset[str]:
    """``Message.field`` that a log's protobuf schema has and our table lacks: a newer program's, or another's."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.message import DecodeError

    if schema == file_descriptor_set():
        return frozenset()
    try:
        files = FileDescriptorSet.FromString(schema).file
    except DecodeError:
        return frozenset()
    return frozenset(
        f"{message.name}.{field.name}"
        for file in files
        if file.package == PACKAGE
        for message in file.message_type
        if message.name in MESSAGES
        for field in message.field
        if field.number > len(MESSAGES[message.name].fields)
    )


def unnamed_fields(message: Any) -> frozenset[int]:
    """Numbers of the fields of a decoded message that our table lacks."""
    from google.protobuf.unknown_fields import UnknownFieldSet

    unknown = UnknownFieldSet(message)
    return frozenset(unknown[place].field_number for place in range(len(unknown)))


@cache
def _classes() -> dict[str, Any]:
    from google.protobuf import descriptor_pool, message_factory

    pool = descriptor_pool.DescriptorPool()  # our own: the process may know another pmutools.proto
    pool.Add(_file_descriptor())
    return dict(message_factory.GetMessageClassesForFiles([FILE_NAME], pool))


def _file_descriptor() -> FileDescriptorProto:
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto

    file = FileDescriptorProto(name=FILE_NAME, package=PACKAGE, syntax="proto3")
    for name, message in MESSAGES.items():
        descriptor = file.message_type.add(name=name)
        for number, field in enumerate(message.fields, start=1):
            descriptor.field.add(
                name=field.name,
                number=number,
                type=FieldDescriptorProto.Type.Value(f"TYPE_{field.type.upper()}"),
                label=FieldDescriptorProto.LABEL_REPEATED if field.repeated else FieldDescriptorProto.LABEL_OPTIONAL,
            )
    return file
