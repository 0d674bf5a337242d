"""The short way for most of what is captured: whole Ethernet/IPv4 packets with UDP or TCP, by columns.

Plain is a packet without VLAN tag, IP option or fragment whose lengths agree with each other. All others take the
general way (``link``, ``ip``).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.formats.capture import ip, link
from pmutools.formats.capture.records import Ints, Records, gather

_ETHERNET = 14
_HEADERS = _ETHERNET + 20

_IPV4 = np.dtype(
    [
        ("ethertype", ">u2"),
        ("version", "u1"),  # and header length
        ("tos", "u1"),
        ("total", ">u2"),
        ("ident", ">u2"),
        ("fragment", ">u2"),  # flags and offset
        ("ttl", "u1"),
        ("protocol", "u1"),
        ("checksum", ">u2"),
        ("key", "V12"),  # addresses and ports
        ("length", ">u2"),  # of UDP
    ]
)
_TCP = np.dtype(
    [("ports", ">u4"), ("sequence", ">u4"), ("acknowledged", ">u4"), ("offset", "u1"), ("flags", "u1"), ("rest", "V6")]
)


class Plain(NamedTuple):
    """Of N packets: which are plain UDP, which plain TCP; of these the flow's key, where the payload is, and (TCP) the
    sequence number, the one acknowledged, and the flags. All of shape (N,)."""

    udp: npt.NDArray[np.bool_]
    tcp: npt.NDArray[np.bool_]
    key: npt.NDArray[Any]
    begin: Ints
    end: Ints
    sequence: npt.NDArray[Any]
    acknowledged: npt.NDArray[Any]
    flags: npt.NDArray[Any]


def plain(records: Records) -> Plain:
    """Find the plain packets and read their headers."""
    size = records.stop - records.start
    head = _heads(records, (records.linktype == link.ETHERNET) & (size >= _HEADERS + 8), _ETHERNET - 2, _IPV4)
    total = head["total"].astype(np.int64)
    whole = (head["ethertype"] == link.IPV4) & (head["version"] == 0x45) & (head["fragment"] & 0x3FFF == 0)
    whole &= size >= total + _ETHERNET
    length = head["length"].astype(np.int64)
    udp = whole & (head["protocol"] == ip.UDP) & (length >= 8) & (total == length + 20)
    segment = _heads(records, whole & (head["protocol"] == ip.TCP) & (total >= 40), _HEADERS, _TCP)
    header = segment["offset"].astype(np.int64) >> 4 << 2
    tcp = (header >= 20) & (total >= 20 + header)
    begin = records.start + _HEADERS + np.where(tcp, header, 8)
    end = records.start + _ETHERNET + total
    return Plain(udp, tcp, head["key"], begin, end, segment["sequence"], segment["acknowledged"], segment["flags"])


def _heads(records: Records, present: npt.NDArray[np.bool_], offset: int, layout: np.dtype[Any]) -> npt.NDArray[Any]:
    """The headers at ``offset`` of the packets that have one, zeros for the others."""
    if present.all():
        return gather(records.data, records.start + offset, layout)
    heads = np.zeros(len(present), layout)
    heads[present] = gather(records.data, records.start[present] + offset, layout)
    return heads
