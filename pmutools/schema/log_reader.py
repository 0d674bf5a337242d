"""Reading MCAP logs that may be cut, damaged, foreign or newer than this program.

What can be read is, the rest is said. The unit of loss is a chunk: its CRC tells whether it holds. Where the walk
from record to record loses its footing, the next chunk is found by its signature. Memory is bounded by one chunk.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import IO, Any, NamedTuple

from pmutools.errors import SourceError
from pmutools.schema import mcap_records as raw
from pmutools.schema.descriptors import message_class, short_name, unknown_fields, unnamed_fields
from pmutools.schema.mcap_records import MESSAGE_RECORD, DamagedRecordError, Op


class LogChannel(NamedTuple):
    """A topic and what it carries. ``message`` is its name in our table, None where it is not ours."""

    topic: str
    schema: str
    message: str | None
    metadata: Mapping[str, str]


class LogMessage(NamedTuple):
    """One message, still serialised: :meth:`LogReader.decode` gives its fields."""

    channel: LogChannel
    log_time_ns: int
    publish_time_ns: int
    data: bytes


class LogAttachment(NamedTuple):
    name: str
    media_type: str
    time_ns: int
    data: bytes


class LogMetadata(NamedTuple):
    name: str
    values: Mapping[str, str]


LogRecord = LogMessage | LogAttachment | LogMetadata
LogBatch = list[LogMessage] | LogAttachment | LogMetadata


@dataclass(slots=True)
class Damage:
    """What of a log could not be read; false where nothing was lost."""

    cut: bool = False
    """The file has no end: its writer was killed, is still writing, or the tail is gone. What was flushed is there."""
    records: int = 0
    """Chunks, attachments and metadata whose checksum or content does not hold."""
    lost_bytes: int = 0
    """Bytes passed over to find the next chunk, and those of a last, incomplete record."""
    orphans: int = 0
    """Messages on a channel that is announced nowhere in the file."""
    undecodable: int = 0
    """Messages that are not what their schema says."""
    missing: int = 0
    """Messages that the file's own statistics count beyond those found."""

    def __bool__(self) -> bool:
        return bool(self.cut or self.losses)

    def __add__(self, other: Damage) -> Damage:
        counts = {item.name: getattr(self, item.name) + getattr(other, item.name) for item in fields(self)}
        return Damage(**counts | {"cut": self.cut or other.cut})

    @property
    def losses(self) -> int:
        """Grows with every loss but a cut: compare before and after to know whether something is missing between."""
        return self.records + self.lost_bytes + self.orphans + self.undecodable + self.missing

    def lines(self) -> list[str]:
        """One line for each kind of damage, for a user."""
        counts = (
            (self.records, "damaged chunk(s) or attachment(s) skipped"),
            (self.lost_bytes, "byte(s) belong to no whole record"),
            (self.orphans, "message(s) on an unknown channel"),
            (self.undecodable, "message(s) do not decode"),
            (self.missing, "message(s) missing, by the file's own count"),
        )
        cut = ["the log has no intact end: it was cut, or is still being written"] if self.cut else []
        return cut + [f"{count} {what}" for count, what in counts if count]


class LogReader:
    """One MCAP file, read from its beginning as often as wanted.

    ``damage`` is that of the last :meth:`records`, complete when its iterator is exhausted. ``unknown`` are the topics
    and ``Message.field`` met so far that our table lacks, which are passed over. Raises SourceError for a
    file that cannot be opened, is empty, or is no MCAP file.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.damage = Damage()
        self.unknown: set[str] = set()
        with self._open() as file:
            magic = file.read(len(raw.MAGIC))
        if not magic:
            raise SourceError(f"{self.path}: empty file")
        if magic != raw.MAGIC:
            raise SourceError(f"{self.path}: not an MCAP file")

    def records(self, messages: Collection[str] | None = None) -> Iterator[LogRecord]:
        """Everything in file order; ``messages`` names those of our table that are wanted (None: all, foreign too)."""
        batches = self.batches(messages)

        def each() -> Iterator[LogRecord]:
            for found in batches:
                if isinstance(found, list):
                    yield from found
                else:
                    yield found

        return each()

    def batches(self, messages: Collection[str] | None = None) -> Iterator[LogBatch]:
        """The same, the messages of a chunk at once."""
        self.damage = damage = Damage()

        def walk() -> Iterator[LogBatch]:
            with self._open() as file:
                size = file.seek(0, os.SEEK_END)
                yield from _Walk(file, size, damage, messages, self.unknown).batches()

        return walk()

    def decode(self, message: LogMessage) -> Any | None:
        """The protobuf message; None for one that is not ours, or (counted) does not decode."""
        from google.protobuf.message import DecodeError

        name = message.channel.message
        if name is None:
            return None
        try:
            decoded = message_class(name).FromString(message.data)
        except DecodeError:
            self.damage.undecodable += 1
            return None
        self.unnamed(name, unnamed_fields(decoded))
        return decoded

    def unnamed(self, name: str, numbers: Collection[int]) -> None:
        """Take note of fields of ``name`` that no schema told of: only their numbers are known."""
        if numbers and not any(known.startswith(f"{name}.") for known in self.unknown):
            self.unknown.update(f"{name}.{number}" for number in numbers)

    def _open(self) -> IO[bytes]:
        try:
            return self.path.open("rb")
        except OSError as error:
            raise SourceError(f"{self.path}: {error.strerror}") from None


class _Walk:
    """One pass over a file: known schemas and channels, and the damage met."""

    def __init__(
        self, file: IO[bytes], size: int, damage: Damage, wanted: Collection[str] | None, unknown: set[str]
    ) -> None:
        self.file = file
        self.size = size
        self.damage = damage
        self.wanted = wanted
        self.unknown = unknown
        self.at = len(raw.MAGIC)
        """Where the next record begins."""
        self.schemas: dict[int, str] = {0: ""}
        self.channels: dict[int, LogChannel] = {}
        self.all_known = False
        """Whether every channel that the rest of the file announces is in ``channels``."""
        self.chunked = False
        self.found = 0
        self.announced = 0

    def batches(self) -> Iterator[LogBatch]:
        summary = raw.read_summary(self.file, self.size)
        self.damage.cut = summary is None
        try:
            # the summary repeats every channel: with it, a damaged first chunk takes no other with it
            self._walk(summary or b"", [])
            self.all_known = bool(self.channels)
        except DamagedRecordError:
            self.damage.records += 1
        yield from self._data_section()
        if summary is not None:
            self.damage.missing = max(0, self.announced - self.found - self.damage.orphans)

    def _announced_later(self, number: int) -> LogChannel | None:
        """The channel of a message whose announcement is lost: writers of logs without end repeat them now and then.

        A channel known from then on is not looked for again, nor any once the rest of the file has been searched.
        """
        if self.all_known:
            return None
        ahead = _Walk(self.file, self.size, Damage(), (), set())
        ahead.at, ahead.schemas, ahead.channels, ahead.all_known = (
            self.at,
            dict(self.schemas),
            dict(self.channels),
            True,
        )
        for _ in ahead._data_section():
            if number in ahead.channels:
                break
        else:
            self.all_known = True
        self.channels.update(ahead.channels)
        return self.channels.get(number)

    def _data_section(self) -> Iterator[LogBatch]:
        at = floor = self.at  # floor: nothing before it is looked at again
        while at < self.size:
            record = raw.read_record(self.file, at, self.size)
            if record is None:
                found = raw.find_chunk(self.file, floor, self.size)
                self.damage.lost_bytes += max((self.size if found is None else found) - at, 0)
                if found is None:
                    return
                at, floor = found, found + 1
                record = raw.read_record(self.file, at, self.size)
                if record is None:
                    continue
            if record.opcode == Op.DATA_END:
                return
            self.at = record.end
            try:
                yield from self._top_level(record)
            except DamagedRecordError:
                self.damage.records += 1
                floor = at + 1
            else:
                if record.opcode == Op.CHUNK:
                    floor = record.end
            at = record.end

    def _top_level(self, record: raw.RawRecord) -> Iterator[LogBatch]:
        opcode, body, _ = record
        if opcode == Op.CHUNK:
            self.chunked = True
            yield from self._messages(raw.unpack_chunk(body))
        elif opcode == Op.MESSAGE and self.chunked:
            raise DamagedRecordError("a message outside the chunks")  # no writer mixes them: a bent message index
        elif opcode in (Op.SCHEMA, Op.CHANNEL, Op.MESSAGE):
            yield from self._messages(raw.RECORD_HEAD.pack(opcode, len(body)) + body)
        elif opcode == Op.ATTACHMENT:
            attachment = raw.parse_attachment(body)
            yield LogAttachment(attachment.name, attachment.media_type, attachment.log_time, attachment.data)
        elif opcode == Op.METADATA:
            from mcap.records import Metadata

            metadata = raw.parse(Metadata, body)
            yield LogMetadata(metadata.name, metadata.metadata)
        elif raw.LAST_DEFINED_OPCODE < opcode < raw.FIRST_PRIVATE_OPCODE:
            self.damage.records += 1  # of a later MCAP, or a bent opcode: either way not read

    def _messages(self, data: bytes) -> Iterator[LogBatch]:
        """Those of a chunk, as far as it holds together."""
        found: list[LogMessage] = []
        try:
            self._walk(data, found)
        finally:
            yield found

    def _walk(self, data: bytes, found: list[LogMessage]) -> None:
        """Records inside a chunk or the summary: messages are added to ``found``."""
        at, end = 0, len(data)
        wanted, channels = self.wanted, self.channels
        unpack, head, message_head = MESSAGE_RECORD.unpack_from, raw.RECORD_HEAD.size, MESSAGE_RECORD.size
        while at < end:
            if end - at < head:
                raise DamagedRecordError("record head")
            if data[at] == Op.MESSAGE:
                if end - at < message_head:
                    raise DamagedRecordError("message head")
                _, length, number, _, log_time_ns, publish_time_ns = unpack(data, at)
                stop = at + head + length
                if stop > end or length < message_head - head:
                    raise DamagedRecordError("record length")
                channel = channels.get(number) or self._announced_later(number)
                if channel is None:
                    self.damage.orphans += 1
                else:
                    self.found += 1
                    if wanted is None or channel.message in wanted:
                        found.append(LogMessage(channel, log_time_ns, publish_time_ns, data[at + message_head : stop]))
            else:
                opcode, length = raw.RECORD_HEAD.unpack_from(data, at)
                stop = at + head + length
                if stop > end:
                    raise DamagedRecordError("record length")
                self._define(opcode, data[at + head : stop])
            at = stop

    def _define(self, opcode: int, body: bytes) -> None:
        from mcap.records import Channel, Schema, Statistics

        if opcode == Op.SCHEMA:
            schema = raw.parse(Schema, body)
            self.schemas[schema.id] = (
                schema.name if schema.encoding == "protobuf" else f"{schema.encoding}:{schema.name}"
            )
            if schema.encoding == "protobuf":
                self.unknown |= unknown_fields(schema.data)
        elif opcode == Op.CHANNEL:
            channel = raw.parse(Channel, body)
            name = self.schemas.get(channel.schema_id, "")
            message = short_name(name) if channel.message_encoding == "protobuf" else None
            if message is None:
                self.unknown.add(channel.topic)
            self.channels[channel.id] = LogChannel(channel.topic, name, message, channel.metadata)
        elif opcode == Op.STATISTICS:
            self.announced = raw.parse(Statistics, body).message_count
