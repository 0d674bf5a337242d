"""Walking an MCAP file record by record, and finding the way again after damage (https://mcap.dev/spec).

The mcap library's readers stop at the first fault and load what a length field says; these do neither.
"""

from __future__ import annotations

import struct
import zlib
from enum import IntEnum
from io import BytesIO
from typing import IO, Any, NamedTuple

MAGIC = b"\x89MCAP0\r\n"
MAX_RECORD_BYTES = 256 << 20
"""No record or chunk beyond this is loaded; mcap writers make chunks of 1 to 8 MiB."""

RECORD_HEAD = struct.Struct("<BQ")
MESSAGE_RECORD = struct.Struct("<BQHIQQ")
"""Head of the record and of the message in it: channel, sequence, log time, publish time."""
CHUNK_HEAD = struct.Struct("<QQQI")
FOOTER = struct.Struct("<BQQQI")
_SIGNATURES = (b"\x04\x00\x00\x00zstd", b"\x03\x00\x00\x00lz4")
_SIGNATURE_AT = RECORD_HEAD.size + CHUNK_HEAD.size
_DATA_END_SIZE = 4
_WINDOW = 1 << 20


class Op(IntEnum):
    """Opcodes of records that a log has."""

    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    CHUNK_INDEX = 0x08
    ATTACHMENT = 0x09
    ATTACHMENT_INDEX = 0x0A
    STATISTICS = 0x0B
    METADATA = 0x0C
    METADATA_INDEX = 0x0D
    SUMMARY_OFFSET = 0x0E
    DATA_END = 0x0F


FIRST_PRIVATE_OPCODE = 0x80
LAST_DEFINED_OPCODE = Op.DATA_END


class DamagedRecordError(Exception):
    """A record whose content does not hold together."""


class RawRecord(NamedTuple):
    """A top-level record, ``body`` without its opcode and length; ``end`` is the offset of the next."""

    opcode: int
    body: bytes
    end: int


def read_record(file: IO[bytes], at: int, size: int) -> RawRecord | None:
    """The record at offset ``at`` of a file of ``size`` bytes; None where no whole and plausible record begins."""
    file.seek(at)
    head = file.read(RECORD_HEAD.size)
    if len(head) < RECORD_HEAD.size:
        return None
    opcode, length = RECORD_HEAD.unpack(head)
    end = at + RECORD_HEAD.size + length
    if opcode == 0 or length > MAX_RECORD_BYTES or end > size:
        return None
    body = file.read(length)
    if len(body) < length or not _holds_together(opcode, body):
        return None
    return RawRecord(opcode, body, end)


def _holds_together(opcode: int, body: bytes) -> bool:
    """Whether the sizes inside a record fit it, and it is no chunk by another name: a bent bit may not hide a chunk."""
    if opcode == Op.CHUNK:
        at = CHUNK_HEAD.size
        at += 4 + int.from_bytes(body[at : at + 4], "little")
        return at + 8 + int.from_bytes(body[at : at + 8], "little") == len(body)
    if opcode == Op.MESSAGE_INDEX:
        return 6 + int.from_bytes(body[2:6], "little") == len(body)
    if opcode == Op.DATA_END:
        return len(body) == _DATA_END_SIZE
    return not body[CHUNK_HEAD.size : CHUNK_HEAD.size + len(_SIGNATURES[0])].startswith(_SIGNATURES)


def find_chunk(file: IO[bytes], start: int, size: int) -> int | None:
    """Offset of the first compressed chunk record that begins at or after ``start``; None if there is none."""
    at = start + _SIGNATURE_AT
    while at < size:
        file.seek(at)
        window = file.read(_WINDOW)
        hit = min((found for signature in _SIGNATURES if (found := window.find(signature)) >= 0), default=None)
        if hit is None:
            at += max(len(window) - len(_SIGNATURES[0]) + 1, 1)
            continue
        chunk = at + hit - _SIGNATURE_AT
        file.seek(chunk)
        opcode, length = RECORD_HEAD.unpack(file.read(RECORD_HEAD.size))
        if opcode == Op.CHUNK and length <= MAX_RECORD_BYTES and chunk + RECORD_HEAD.size + length <= size:
            return chunk
        at += hit + 1
    return None


def unpack_chunk(body: bytes) -> bytes:
    """The records inside a chunk, decompressed and checked; raises DamagedRecordError."""
    _, _, size, crc = CHUNK_HEAD.unpack_from(body)
    at = CHUNK_HEAD.size + 4
    name_end = at + int.from_bytes(body[at - 4 : at], "little")
    data = _decompress(body[at:name_end], body[name_end + 8 :], size)
    if len(data) != size or (crc and zlib.crc32(data) != crc):
        raise DamagedRecordError("chunk CRC")
    return data


def _decompress(compression: bytes, data: bytes, size: int) -> bytes:
    if size > MAX_RECORD_BYTES:
        raise DamagedRecordError(f"chunk of {size} bytes")
    if not compression:
        return data
    if compression == b"zstd":
        import zstandard

        try:
            if zstandard.frame_content_size(data) > MAX_RECORD_BYTES:
                raise DamagedRecordError("zstd frame size")
            return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
        except zstandard.ZstdError as error:
            raise DamagedRecordError(str(error)) from None
    if compression == b"lz4":
        import lz4.frame  # type: ignore[import-untyped]

        try:
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size))
        except (RuntimeError, EOFError) as error:
            raise DamagedRecordError(str(error)) from None
    raise DamagedRecordError(f"compression {compression!r}")


def parse(kind: Any, body: bytes) -> Any:
    """``body`` as a record class of :mod:`mcap.records`; raises DamagedRecordError."""
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError

    try:
        return kind.read(ReadDataStream(BytesIO(body)))
    except (McapError, struct.error, UnicodeDecodeError, OverflowError, MemoryError) as error:
        raise DamagedRecordError(f"{kind.__name__}: {error}") from None


def parse_attachment(body: bytes) -> Any:
    """An attachment whose CRC holds; raises DamagedRecordError."""
    from mcap.records import Attachment

    crc = int.from_bytes(body[-4:], "little")
    if crc and zlib.crc32(body[:-4]) != crc:
        raise DamagedRecordError("attachment CRC")
    return parse(Attachment, body)


def read_summary(file: IO[bytes], size: int) -> bytes | None:
    """The records of the summary section; None where the file does not end in an intact one."""
    tail = FOOTER.size + len(MAGIC)
    if size < len(MAGIC) + tail:
        return None
    file.seek(size - tail)
    footer = file.read(tail)
    opcode, length, start, offset_start, crc = FOOTER.unpack_from(footer)
    if footer[-len(MAGIC) :] != MAGIC or opcode != Op.FOOTER or length != FOOTER.size - RECORD_HEAD.size:
        return None
    if start == 0:
        return b""
    if not len(MAGIC) <= start <= size - tail or size - tail - start > MAX_RECORD_BYTES:
        return None
    file.seek(start)
    summary = file.read(size - tail - start)
    head = struct.pack("<BQQQ", opcode, length, start, offset_start)
    return summary if not crc or zlib.crc32(head, zlib.crc32(summary)) == crc else None
