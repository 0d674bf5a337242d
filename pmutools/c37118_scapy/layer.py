"""The frame itself: prefix, body by type, CHK."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

from scapy.config import conf
from scapy.fields import (
    BitEnumField,
    BitField,
    ConditionalField,
    FieldLenField,
    ShortField,
    SignedShortField,
    StrLenField,
    ThreeBytesField,
    UTCTimeField,
    XByteField,
    XShortEnumField,
    XShortField,
)
from scapy.layers.inet import TCP, UDP
from scapy.packet import Packet, Padding, Raw, bind_bottom_up, bind_top_down

from pmutools.c37118.checksum import chk
from pmutools.c37118.config import decode_config_body
from pmutools.c37118.constants import (
    CHK_SIZE,
    MAX_FRAME_SIZE,
    MIN_FRAME_SIZE,
    PREFIX_SIZE,
    SYNC,
    TCP_PORT,
    UDP_PORT,
    Command,
    FrameType,
    TimeQuality,
)
from pmutools.c37118.prefix import decode_prefix
from pmutools.c37118_scapy.blocks import Cfg3Station, CfgStation, data_block_classes
from pmutools.c37118_scapy.fields import PacketsField, ReservedBitField, SyncField, labels
from pmutools.c37118_scapy.registry import config_of, learn
from pmutools.errors import WireError

_CONFIGS = (FrameType.CFG1, FrameType.CFG2, FrameType.CFG3)
_TYPES = labels(FrameType)


def _opaque(pkt: Packet) -> bool:
    return pkt.getfieldval("undecoded") is not None


def _in(*types: FrameType) -> Callable[[Packet], bool]:
    return lambda pkt: not _opaque(pkt) and pkt.type in types


def _next_block(pkt: Packet, done: int) -> type[Packet] | None:
    """Class of the PMU block that follows ``done`` others."""
    if _opaque(pkt):
        return None
    if pkt.type in _CONFIGS:
        station = Cfg3Station if pkt.type == FrameType.CFG3 else CfgStation
        return station if done < pkt.num_pmu else None
    config = config_of(pkt.idcode)
    if pkt.type != FrameType.DATA or config is None or done == len(config.stations):
        return None
    return data_block_classes(config)[done]


class C37118(Packet):
    """One C37.118 frame. ``blocks`` holds a DataBlock, CfgStation or Cfg3Station for each PMU."""

    name = "IEEE C37.118"
    fields_desc: ClassVar[list[Any]] = [
        SyncField("sync", SYNC),
        ReservedBitField("reserved"),
        BitEnumField("type", FrameType.DATA, 3, _TYPES),
        BitField("version", None, 4),
        ShortField("framesize", None),
        ShortField("idcode", 1),
        UTCTimeField("soc", 0),
        BitField("tq_reserved", 0, 1),
        BitField("leap_delete", 0, 1),
        BitField("leap_occurred", 0, 1),
        BitField("leap_pending", 0, 1),
        BitEnumField("msg_tq", TimeQuality.LOCKED, 4, labels(TimeQuality)),
        ThreeBytesField("fracsec", 0),
        ConditionalField(ShortField("cont_idx", 0), _in(FrameType.CFG3)),
        ConditionalField(XByteField("time_base_flags", 0), _in(*_CONFIGS)),
        ConditionalField(ThreeBytesField("time_base", 1_000_000), _in(*_CONFIGS)),
        ConditionalField(FieldLenField("num_pmu", None, count_of="blocks"), _in(*_CONFIGS)),
        PacketsField("blocks", _next_block),
        ConditionalField(SignedShortField("data_rate", 30), _in(*_CONFIGS)),
        ConditionalField(StrLenField("text", b"", length_from=lambda pkt: pkt.body_size), _in(FrameType.HEADER)),
        ConditionalField(XShortEnumField("cmd", Command.START_DATA, labels(Command)), _in(FrameType.COMMAND)),
        ConditionalField(
            StrLenField("extended", b"", length_from=lambda pkt: pkt.body_size - 2), _in(FrameType.COMMAND)
        ),
        ConditionalField(
            StrLenField("undecoded", None, length_from=lambda pkt: pkt.body_size),  # type: ignore[arg-type]
            _opaque,
        ),
        XShortField("chk", None),
    ]

    @classmethod
    def dispatch_hook(cls, _pkt: bytes = b"", *args: Any, **kargs: Any) -> type[Packet]:
        """Bytes that do not begin with a whole frame are raw."""
        return cls if not _pkt or _size_of(_pkt) else conf.raw_layer

    @classmethod
    def tcp_reassemble(cls, data: bytes, metadata: dict[str, Any], session: dict[str, Any]) -> Packet | None:
        """All whole frames at the front of ``data``, the rest as padding; bytes that begin no frame are raw."""
        end = 0
        while size := _size_of(data[end:]):
            end += size
        if not end and _may_be_frame(data):
            return None
        found: Packet = cls(data[:end]) if end else Raw(data[: (end := _next_sync(data))])
        return found / Padding(data[end:]) if data[end:] else found

    @property
    def body_size(self) -> int:
        """Bytes between prefix and CHK, by FRAMESIZE."""
        return int(self.framesize) - MIN_FRAME_SIZE

    def pre_dissect(self, s: bytes) -> bytes:
        frame = s[: _size_of(s)]
        if not _understood(frame):
            self.fields["undecoded"] = frame[PREFIX_SIZE:-CHK_SIZE]
        return s

    def post_build(self, pkt: bytes, pay: bytes) -> bytes:
        frame = bytearray(pkt)
        if self.version is None:
            kind = frame[1] >> 4 & 7
            frame[1] |= FrameType(kind).version if kind in _TYPES else 1
        if self.framesize is None:
            frame[2:4] = min(len(frame), MAX_FRAME_SIZE).to_bytes(2, "big")
        if self.chk is None:
            frame[-CHK_SIZE:] = chk(bytes(frame[:-CHK_SIZE])).to_bytes(CHK_SIZE, "big")
        return bytes(frame) + pay

    def default_payload_class(self, payload: bytes) -> type[Packet]:
        return C37118


def _may_be_frame(data: bytes) -> bool:
    """Whether ``data``, as far as it goes, can be the beginning of a frame."""
    return data[:1] == bytes((SYNC,)) and (len(data) < 4 or int.from_bytes(data[2:4], "big") >= MIN_FRAME_SIZE)


def _next_sync(data: bytes) -> int:
    """Where in ``data``, past its first byte, a frame may begin; its end if nowhere."""
    return next((at for at in range(1, len(data)) if _may_be_frame(data[at : at + 4])), len(data))


def _size_of(data: bytes) -> int:
    """FRAMESIZE of the whole frame that ``data`` begins with; 0 where it does not."""
    size = int.from_bytes(data[2:4], "big")
    return size if len(data) >= MIN_FRAME_SIZE and _may_be_frame(data) and size <= len(data) else 0


def _understood(frame: bytes) -> bool:
    """Whether the body can be split into fields; a good CFG-2 or CFG-3 is learned on the way."""
    prefix = decode_prefix(frame)
    kind = prefix.sync >> 4 & 0xF
    if kind == FrameType.DATA:
        known = config_of(prefix.idcode)
        return known is not None and known.frame_size == len(frame)
    if kind == FrameType.COMMAND:
        return len(frame) >= MIN_FRAME_SIZE + 2
    if kind in _CONFIGS:
        try:
            config = decode_config_body(prefix, frame[PREFIX_SIZE:-CHK_SIZE])
        except WireError:
            return False
        if FrameType(kind).rules_data and not chk(frame):
            learn(config)
        return True
    return kind == FrameType.HEADER


for _port in (TCP_PORT, UDP_PORT):
    for _transport in (TCP, UDP):
        bind_bottom_up(_transport, C37118, sport=_port)
        bind_bottom_up(_transport, C37118, dport=_port)
bind_top_down(TCP, C37118, dport=TCP_PORT)
bind_top_down(UDP, C37118, dport=UDP_PORT)
