"""Link layers: where the network layer starts in a captured packet (LINKTYPE numbers: tcpdump.org/linktypes.html)."""

from __future__ import annotations

import struct

ETHERNET = 1
IPV4 = 0x0800
IPV6 = 0x86DD
NOT_IP = 0

_VLAN_TAGS = (0x8100, 0x88A8, 0x9100)
_MAX_TAGS = 8
_AF_INET = 2
_AF_INET6 = (10, 23, 24, 28, 30)  # Linux, Windows, the BSDs, macOS

_u16 = struct.Struct(">H").unpack_from
_u32 = struct.Struct(">I").unpack_from


def network_layer(linktype: int, packet: bytes) -> tuple[int, int] | None:
    """(IPV4, IPV6 or NOT_IP; offset of the network header), or None for a link layer that is not read.

    Raises struct.error or IndexError where the packet ends before its network layer.
    """
    match linktype:
        case 1:
            return _ethertype(packet, 12)
        case 12 | 14 | 101:  # raw IP
            return _by_version(packet, 0)
        case 228:
            return IPV4, 0
        case 229:
            return IPV6, 0
        case 0 | 108:  # BSD loopback: address family in the order of the capturing host, or big-endian
            family = _u32(packet)[0]
            family = family if family < 1 << 16 else int.from_bytes(packet[:4], "little")
            return (IPV4 if family == _AF_INET else IPV6 if family in _AF_INET6 else NOT_IP), 4
        case 113:  # Linux cooked, version 1
            return _ethertype(packet, 14)
        case 276:  # Linux cooked, version 2
            protocol = _u16(packet)[0]
            return _ethertype(packet, 22) if protocol in _VLAN_TAGS else (_known(protocol), 20)
    return None


def _by_version(packet: bytes, offset: int) -> tuple[int, int]:
    return {4: IPV4, 6: IPV6}.get(packet[offset] >> 4, NOT_IP), offset


def _known(ethertype: int) -> int:
    return ethertype if ethertype in (IPV4, IPV6) else NOT_IP


def _ethertype(packet: bytes, offset: int) -> tuple[int, int]:
    """Follow the EtherType at ``offset`` through any VLAN tags (802.1Q, 802.1ad)."""
    for _ in range(_MAX_TAGS):
        ethertype = _u16(packet, offset)[0]
        if ethertype not in _VLAN_TAGS:
            return _known(ethertype), offset + 2
        offset += 4
    return NOT_IP, offset
