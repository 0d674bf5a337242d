"""Link layers: where the network layer starts in a captured packet (LINKTYPE numbers: tcpdump.org/linktypes.html)."""

from __future__ import annotations

import struct

ETHERNET = 1
IPV4 = 0x0800
IPV6 = 0x86DD
NOT_IP = 0

VLAN = 0x8100
_VLAN_TAGS = (VLAN, 0x88A8, 0x9100)
_MAX_TAGS = 8
_AF_INET = 2
_AF_INET6 = (10, 23, 24, 28, 30)  # Linux, Windows, the BSDs, macOS

RAW_IP = (12, 14, 101, 228)
"""LINKTYPEs of packets that begin with an IP header, IPv4 at least."""
ETHERTYPE_AT = {ETHERNET: (12, 14), 113: (14, 16), 276: (0, 20)}
"""LINKTYPE -> offset of the EtherType, and of what it announces. 113 and 276 are Linux cooked, versions 1 and 2."""

_u16 = struct.Struct(">H").unpack_from
_u32 = struct.Struct(">I").unpack_from


def network_layer(linktype: int, packet: bytes) -> tuple[int, int] | None:
    """(IPV4, IPV6 or NOT_IP; offset of the network header), or None for a link layer that is not read.

    Raises struct.error or IndexError where the packet ends before its network layer.
    """
    if linktype in ETHERTYPE_AT:
        return _ethertype(packet, *ETHERTYPE_AT[linktype])
    if linktype in RAW_IP or linktype == 229:
        return {4: IPV4, 6: IPV6}.get(packet[0] >> 4, NOT_IP), 0
    if linktype in (0, 108):  # BSD loopback: address family in the order of the capturing host, or big-endian
        family = _u32(packet)[0]
        family = family if family < 1 << 16 else int.from_bytes(packet[:4], "little")
        return (IPV4 if family == _AF_INET else IPV6 if family in _AF_INET6 else NOT_IP), 4
    return None


def _ethertype(packet: bytes, place: int, after: int) -> tuple[int, int]:
    """Follow the EtherType at ``place`` through any VLAN tags (802.1Q, 802.1ad), the first at ``after``."""
    ethertype = _u16(packet, place)[0]
    for _ in range(_MAX_TAGS):
        if ethertype not in _VLAN_TAGS:
            break
        ethertype = _u16(packet, after + 2)[0]
        after += 4
    return (ethertype if ethertype in (IPV4, IPV6) else NOT_IP), after
