"""The short way for most of what is captured: whole IPv4 packets with UDP or TCP, by columns.

Plain is a packet over Ethernet with one VLAN tag at most, Linux cooked or raw IP, without IP option or fragment, whose
lengths agree with each other. All others take the general way (``link``, ``ip``), which plain ones could take too.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.formats.capture import ip, link
from pmutools.formats.capture.records import Ints, Records, gather

Mask = npt.NDArray[np.bool_]

_IPV4 = np.dtype(
    [
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
        ("udp_checksum", ">u2"),
    ]
)
_TCP = np.dtype(
    [("ports", ">u4"), ("sequence", ">u4"), ("acknowledged", ">u4"), ("offset", "u1"), ("flags", "u1"), ("rest", "V6")]
)
_ETHERTYPE = np.dtype(">u2")


TRAIN = 32
"""Fewer equal datagrams of a flow are not worth working on together."""


class Plain(NamedTuple):
    """Of N packets: which are plain UDP, which plain TCP; of these the flow's key, where the payload is, and (TCP) the
    sequence number, the one acknowledged, and the flags. All of shape (N,)."""

    udp: Mask
    tcp: Mask
    key: npt.NDArray[Any]
    begin: Ints
    end: Ints
    sequence: npt.NDArray[Any]
    acknowledged: npt.NDArray[Any]
    flags: npt.NDArray[Any]


def plain(records: Records) -> Plain:
    """Find the plain packets and read their headers."""
    at, carried = _network(records)
    head = _heads(records, carried, at, _IPV4)
    total = head["total"].astype(np.int64)
    whole = (head["version"] == 0x45) & (head["fragment"] & 0x3FFF == 0) & (at + total <= records.stop)
    length = head["length"].astype(np.int64)
    udp = whole & (head["protocol"] == ip.UDP) & (length >= 8) & (total == length + 20)
    segment = _heads(records, whole & (head["protocol"] == ip.TCP) & (total >= 40), at + 20, _TCP)
    header = segment["offset"].astype(np.int64) >> 4 << 2
    tcp = (header >= 20) & (total >= 20 + header)
    begin = at + 20 + np.where(tcp, header, 8)
    columns = segment["sequence"], segment["acknowledged"], segment["flags"]
    return Plain(udp, tcp, head["key"], begin, at + total, *columns)


def alike(short: Plain) -> Iterator[Ints]:
    """The rows of each flow that sends plain UDP datagrams of one size only, :data:`TRAIN` of them at least."""
    rows = np.flatnonzero(short.udp)
    words = np.ascontiguousarray(short.key[rows]).view("u4").reshape(-1, 3)
    order = np.lexsort(words.T)
    words, rows = words[order], rows[order]
    ends = np.flatnonzero((words[1:] != words[:-1]).any(1)) + 1
    for first, after in pairwise([0, *ends.tolist(), len(rows)]):
        of_flow = rows[first:after]
        size = short.end[of_flow] - short.begin[of_flow]
        if len(of_flow) >= TRAIN and size[0] > 0 and (size == size[0]).all():
            yield of_flow


def _network(records: Records) -> tuple[Ints, Mask]:
    """Where each packet's network header is, and whether it is announced as IPv4 (raw IP: may be)."""
    offset = np.zeros(len(records.start), np.int64)
    announced = np.zeros(len(offset), np.bool_)
    for linktype in np.unique(records.linktype).tolist():
        rows = records.linktype == linktype
        if linktype in link.RAW_IP:
            announced |= rows
        elif linktype in link.ETHERTYPE_AT:
            place, after = link.ETHERTYPE_AT[linktype]
            ethertype = _heads(records, rows, records.start + place, _ETHERTYPE)
            tagged = ethertype == link.VLAN
            offset[rows] = after
            if tagged.any():
                offset[tagged] += 4
                tagged_type = _heads(records, tagged, records.start + offset - 2, _ETHERTYPE)
                ethertype = np.where(tagged, tagged_type, ethertype)
            announced |= ethertype == link.IPV4
    return records.start + offset, announced


def _heads(records: Records, wanted: Mask, at: Ints, layout: np.dtype[Any]) -> npt.NDArray[Any]:
    """The structures at ``at`` of the wanted packets that hold them, zeros for the others."""
    present = wanted & (at + layout.itemsize <= records.stop)
    if present.all():
        return gather(records.data, at, layout)
    heads = np.zeros(len(present), layout)
    heads[present] = gather(records.data, at[present], layout)
    return heads
