"""What an MCAP file is made of, as bytes: chunks, and the summary that tells where they are (https://mcap.dev/spec).

The mcap library's writer spends ten times as long on a message, and works its index out when the file is closed; a
log that is written between two ticks of a controller can afford neither.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from functools import cached_property
from typing import Any

from pmutools.schema.mcap_records import CHUNK_HEAD, FOOTER, MESSAGE_RECORD, RECORD_HEAD, Op

_MESSAGE_HEAD = MESSAGE_RECORD.size - RECORD_HEAD.size
_INDEX_ENTRY = struct.Struct("<QQ")
_INDEX_HEAD = struct.Struct("<BQHI")
_CHUNK_INDEX_HEAD = struct.Struct("<QQQQI")
_CHUNK_INDEX_OFFSET = struct.Struct("<HQ")
_SUMMARY_OFFSET = struct.Struct("<BQBQQ")
_COMPRESSION = b"\x04\x00\x00\x00zstd"


def serialised(record: Any) -> bytes:
    """The bytes of a record class of :mod:`mcap.records`."""
    from mcap.data_stream import RecordBuilder

    builder: Any = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


class OpenChunk:
    """Messages that are not yet compressed."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.size = 0
        self.messages = 0
        self.start_ns = 1 << 64
        self.stop_ns = 0
        self.index: dict[int, list[bytes]] = {}
        """By channel, the entries of its message index."""

    def define(self, records: bytes) -> None:
        """Schemas and channels."""
        self.parts.append(records)
        self.size += len(records)

    def add(self, channel: int, log_time_ns: int, publish_time_ns: int, data: bytes) -> None:
        length = _MESSAGE_HEAD + len(data)
        self.parts.append(MESSAGE_RECORD.pack(Op.MESSAGE, length, channel, 0, log_time_ns, publish_time_ns))
        self.parts.append(data)
        self.index.setdefault(channel, []).append(_INDEX_ENTRY.pack(log_time_ns, self.size))
        self.size += RECORD_HEAD.size + length
        self.messages += 1
        self.start_ns = min(self.start_ns, log_time_ns)
        self.stop_ns = max(self.stop_ns, log_time_ns)


class Summary:
    """What the end of a file repeats and indexes; gives the records themselves as they are noted."""

    def __init__(self) -> None:
        self._schemas: dict[str, int] = {}
        self._counts: dict[int, int] = {}
        self._times = [1 << 64, 0]
        self._messages = self.chunks = self._attachments = self._metadata = 0
        self._groups: dict[Op, list[bytes]] = {}

    @cached_property
    def _compressor(self) -> Any:
        import zstandard

        return zstandard.ZstdCompressor()

    def schema(self, name: str, descriptors: bytes) -> tuple[int, bytes]:
        """Number of a protobuf schema, and its record where it is new."""
        from mcap.records import Schema

        if name in self._schemas:
            return self._schemas[name], b""
        number = self._schemas[name] = len(self._schemas) + 1
        return number, self._note(Op.SCHEMA, serialised(Schema(number, descriptors, "protobuf", name)))

    def channel(self, topic: str, schema: int, metadata: Mapping[str, str]) -> tuple[int, bytes]:
        """Number of a new channel, and its record."""
        from mcap.records import Channel

        number = len(self._groups.get(Op.CHANNEL, ())) + 1
        record = serialised(Channel(number, topic, "protobuf", dict(metadata), schema))
        return number, self._note(Op.CHANNEL, record)

    def definitions(self) -> bytes:
        """All schemas and channels so far, to be repeated."""
        return b"".join((*self._groups.get(Op.SCHEMA, ()), *self._groups.get(Op.CHANNEL, ())))

    def chunk(self, at: int, chunk: OpenChunk) -> tuple[bytes, bytes]:
        """Records of a chunk that begins at offset ``at``, and of its message indexes, which follow it."""
        data = b"".join(chunk.parts)
        packed = self._compressor.compress(data)
        head = CHUNK_HEAD.pack(chunk.start_ns, chunk.stop_ns, len(data), zlib.crc32(data))
        body = b"".join((head, _COMPRESSION, len(packed).to_bytes(8, "little"), packed))
        record = RECORD_HEAD.pack(Op.CHUNK, len(body)) + body

        indexes, offsets, end = [], [], at + len(record)
        for channel, entries in chunk.index.items():
            size = len(entries) * _INDEX_ENTRY.size
            indexes += [_INDEX_HEAD.pack(Op.MESSAGE_INDEX, 6 + size, channel, size), *entries]
            offsets.append(_CHUNK_INDEX_OFFSET.pack(channel, end))
            end += _INDEX_HEAD.size + size
            self._counts[channel] = self._counts.get(channel, 0) + len(entries)
        index = b"".join(
            (
                _CHUNK_INDEX_HEAD.pack(
                    *(chunk.start_ns, chunk.stop_ns, at, len(record), len(offsets) * _CHUNK_INDEX_OFFSET.size)
                ),
                *offsets,
                (end - at - len(record)).to_bytes(8, "little"),
                _COMPRESSION,
                *(size.to_bytes(8, "little") for size in (len(packed), len(data))),
            )
        )
        self._note(Op.CHUNK_INDEX, RECORD_HEAD.pack(Op.CHUNK_INDEX, len(index)) + index)
        self.chunks += 1
        self._messages += chunk.messages
        self._times = [min(self._times[0], chunk.start_ns), max(self._times[1], chunk.stop_ns)]
        return record, b"".join(indexes)

    def attachment(self, at: int, name: str, media_type: str, time_ns: int, data: bytes) -> bytes:
        from mcap.records import Attachment, AttachmentIndex

        record = serialised(Attachment(time_ns, time_ns, name, media_type, data))
        index = AttachmentIndex(at, len(record), time_ns, time_ns, len(data), name, media_type)
        self._note(Op.ATTACHMENT_INDEX, serialised(index))
        self._attachments += 1
        return record

    def metadata(self, at: int, name: str, values: Mapping[str, str]) -> bytes:
        from mcap.records import Metadata, MetadataIndex

        record = serialised(Metadata(name, dict(values)))
        self._note(Op.METADATA_INDEX, serialised(MetadataIndex(at, len(record), name)))
        self._metadata += 1
        return record

    def end(self, at: int) -> bytes:
        """End of the data section, summary and footer of a file that is ``at`` bytes long."""
        from mcap.records import DataEnd, Statistics

        data_end = serialised(DataEnd(0))
        statistics = Statistics(
            attachment_count=self._attachments,
            channel_count=len(self._groups.get(Op.CHANNEL, ())),
            channel_message_counts=self._counts,
            chunk_count=self.chunks,
            message_count=self._messages,
            message_end_time=self._times[1],
            message_start_time=self._times[0] if self._messages else 0,
            metadata_count=self._metadata,
            schema_count=len(self._schemas),
        )
        groups = {**self._groups, Op.STATISTICS: [serialised(statistics)]}
        start = offset = at + len(data_end)
        parts, places = [], []
        for opcode, records in groups.items():
            group = b"".join(records)
            parts.append(group)
            places.append(_SUMMARY_OFFSET.pack(Op.SUMMARY_OFFSET, 17, opcode, offset, len(group)))
            offset += len(group)
        summary = b"".join((*parts, *places))
        footer = FOOTER.pack(Op.FOOTER, FOOTER.size - RECORD_HEAD.size, start, offset, 0)[:-4]
        crc = zlib.crc32(footer, zlib.crc32(summary))
        return b"".join((data_end, summary, footer, crc.to_bytes(4, "little")))

    def _note(self, group: Op, record: bytes) -> bytes:
        self._groups.setdefault(group, []).append(record)
        return record
