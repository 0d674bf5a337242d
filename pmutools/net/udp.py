"""UDP sockets that keep count: kernel arrival stamps, own drops, multicast, datagrams in batches.

A datagram holds whole frames, so each is one :class:`~pmutools.flow.Chunk`. Over the native path many datagrams are
taken, and sent, by one system call; the portable path does the same one by one, and stamps arrivals itself.
"""

from __future__ import annotations

import errno
import ipaddress
import socket
import struct
import sys
import time
from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING, NamedTuple

from pmutools import linux
from pmutools.errors import SettingsError
from pmutools.flow import Chunk, Flow, StampSource
from pmutools.net.endpoint import is_multicast
from pmutools.net.sockets import (
    RCVBUF_BYTES,
    SETTLING_NS,
    Address,
    explain,
    pack_sockaddr,
    raise_rcvbuf,
    raise_sndbuf,
    resolve,
    stamp_arrivals,
    stamp_source,
    unpack_sockaddr,
)

if TYPE_CHECKING:
    from pmutools.linux_columns import DepartureBatch

READ_DATAGRAMS = 256
"""Datagrams taken from one socket before the others have their turn."""
READ_BYTES = 64 << 10
"""Bytes, likewise, and what is left of a datagram."""
_FLOWS = 1 << 16
_DATAGRAM_BYTES = 1 << 16


class Target(NamedTuple):
    """A destination, resolved once."""

    address: Address
    sockaddr: linux.SockAddr


def target(address: Address) -> Target:
    """``address`` as the system call takes it."""
    return Target(address, linux.SockAddr(pack_sockaddr(address)))


class Batches:
    """The buffers of the native path, to be shared by all sockets of a thread."""

    def __init__(self) -> None:
        self.receive = linux.ReceiveBatch()
        self.send = linux.SendBatch()
        self._departures: DepartureBatch | None = None

    @property
    def departures(self) -> DepartureBatch:
        if self._departures is None:  # few need it
            from pmutools.linux_columns import DepartureBatch

            self._departures = DepartureBatch()
        return self._departures


class UdpSocket:
    """A bound UDP socket, non-blocking.

    Parameters
    ----------
    host, port
        Local address; a multicast group binds to the group and joins nothing yet (:meth:`join`). Port 0: any.
    rcvbuf_bytes
        Receive buffer to ask for; ``rcvbuf_bytes`` then says what was got.
    batches
        Shared buffers; None takes new ones.
    native
        False takes the portable path: one call a datagram, arrival stamps from user space.

    Raises
    ------
    SourceError
        The port is taken, the address is not local, or not permitted.
    """

    def __init__(
        self,
        host: str,
        port: int,
        *,
        rcvbuf_bytes: int = RCVBUF_BYTES,
        batches: Batches | None = None,
        native: bool = linux.NATIVE,
    ) -> None:
        wanted = resolve(host, port, datagram=True)
        group = is_multicast(wanted.host)
        if group and sys.platform == "win32":  # binding to a group is refused there
            wanted = resolve("::" if wanted.family == socket.AF_INET6 else "0.0.0.0", port, datagram=True)
        self.native = native
        self._batches = (batches or Batches()) if native else None
        self._sock = sock = socket.socket(wanted.family, socket.SOCK_DGRAM)
        try:
            sock.setblocking(False)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            if wanted.family == socket.AF_INET6:
                sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            if group:  # several listeners to one group on one machine are normal
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                _only_joined_groups(sock, wanted.family)
            self.rcvbuf_bytes = raise_rcvbuf(sock, rcvbuf_bytes)
            raise_sndbuf(sock)
            self.stamps = native and stamp_arrivals(sock)
            sock.bind(wanted.sockaddr)
        except OSError as error:
            sock.close()
            raise explain(error, f"udp://{wanted}") from None
        self.address = Address(wanted.family, sock.getsockname())
        self.name_bytes = len(pack_sockaddr(self.address))
        """Size of a sender's address in the kernel's form."""
        self._settled_ns = time.monotonic_ns() + SETTLING_NS
        self._flows: dict[bytes | tuple[str, int], Flow] = {}
        self._stamps_departures = False
        self._dropped = self.own_drops or 0

    def __enter__(self) -> UdpSocket:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def fileno(self) -> int:
        return self._sock.fileno()

    def close(self) -> None:
        self._sock.close()

    # --- receiving

    def join(self, group: str, *, iface: str | None = None, source: str | None = None) -> None:
        """Join a multicast group on an interface (address or name; None: the system chooses), from one source or any.

        Raises SourceError where the system refuses, SettingsError for an interface that is none.
        """
        try:
            self._sock.setsockopt(*_membership(ipaddress.ip_address(group), iface, source))
        except OSError as error:
            raise explain(error, f"multicast group {group}{f' on {iface}' if iface else ''}") from None

    def connect(self, address: Address) -> None:
        """Talk to one peer only: datagrams from others are not seen, and a closed port there shows as refused."""
        try:
            self._sock.connect(address.sockaddr)
        except OSError as error:
            raise explain(error, f"udp://{address}") from None
        self.address = Address(address.family, self._sock.getsockname())
        self._flows.clear()

    def read(self) -> list[Chunk]:
        """What has arrived, at most a few batches, of large datagrams one or two; empty when nothing waits.

        Raises
        ------
        OSError
            On a connected socket: the peer's port is closed (ECONNREFUSED). The socket stays usable.
        """
        if self._batches is None:
            return self._read_portable()
        chunks: list[Chunk] = []
        receive, fd, settling = self._batches.receive, self._sock.fileno(), self._settling()
        left = READ_BYTES
        while left > 0 and len(chunks) < READ_DATAGRAMS:
            few = (self._meminfo(linux.MEMINFO_RMEM_ALLOC) or 0) <= left
            most = receive.size if few else 1  # how large the next is nobody knows
            asked_ns = time.time_ns()
            datagrams = receive.receive(fd, most)
            for data, sockaddr, stamp in datagrams:
                flow = self.flow_from(sockaddr)
                if stamp is None:
                    chunks.append(Chunk(data, time.time_ns(), flow, StampSource.USER))
                else:
                    chunks.append(Chunk(data, stamp.ns, flow, stamp_source(stamp, asked_ns, settling=settling)))
                left -= len(data)
            if len(datagrams) < most:
                break
        return chunks

    def flow_from(self, sockaddr: bytes) -> Flow:
        """The flow of what a sender, in the kernel's form, sends here."""
        return self._flows.get(sockaddr) or self._new_flow(sockaddr, unpack_sockaddr(sockaddr))

    def stamp_by_hardware(self) -> None:
        """Take the network card's stamps from now on, where there are any, else the kernel's."""
        if self.stamps:
            self.stamps = stamp_arrivals(self._sock, hardware=True)

    def _settling(self) -> bool:
        if self._settled_ns and time.monotonic_ns() >= self._settled_ns:
            self._settled_ns = 0
        return self._settled_ns > 0

    def _read_portable(self) -> list[Chunk]:
        chunks: list[Chunk] = []
        left = READ_BYTES
        while left > 0 and len(chunks) < READ_DATAGRAMS:
            try:
                data, sender = self._sock.recvfrom(_DATAGRAM_BYTES)
            except (BlockingIOError, InterruptedError):
                break
            key = (sender[0], sender[1])
            flow = self._flows.get(key) or self._new_flow(key, Address(self.address.family, sender))
            chunks.append(Chunk(data, time.time_ns(), flow, StampSource.USER))
            left -= len(data)
        return chunks

    def _new_flow(self, key: bytes | tuple[str, int], sender: Address) -> Flow:
        if len(self._flows) >= _FLOWS:  # a flood of spoofed senders: begin the cache again
            self._flows.clear()
        flow = self._flows[key] = Flow("udp", str(sender), str(self.address))
        return flow

    @property
    def own_drops(self) -> int | None:
        """Datagrams that this socket's full buffer has lost since it was opened (32 bits, wraps); None if unknown."""
        return self._meminfo(linux.MEMINFO_DROPS)

    def _meminfo(self, place: int) -> int | None:
        """One of the numbers of SO_MEMINFO; None where the system has none."""
        try:
            info = self._sock.getsockopt(socket.SOL_SOCKET, linux.SO_MEMINFO, 36) if linux.NATIVE else b""
        except OSError:
            return None
        return int(struct.unpack_from("=I", info, 4 * place)[0]) if len(info) == 36 else None

    def newly_dropped(self) -> int:
        """Own drops since this was last asked; those that are not known are 0."""
        drops, before = self.own_drops, self._dropped
        if drops is None:
            return 0
        self._dropped = drops
        return (drops - before) & 0xFFFFFFFF

    # --- sending

    def send_via(self, *, iface: str | None = None, ttl: int | None = None) -> None:
        """Choose the interface and the time to live of what is sent to multicast groups."""
        try:
            if iface is not None:
                self._sock.setsockopt(*_outgoing(self.address.family, iface))
            if ttl is not None:
                level, option = _MULTICAST_TTL[self.address.family]
                self._sock.setsockopt(level, option, ttl)
        except OSError as error:
            raise explain(error, f"multicast on {iface}") from None

    def send(self, frames: Sequence[bytes], targets: Sequence[Target]) -> list[int]:
        """Send ``frames[i]`` to ``targets[i]``; returns the indices of those the system would not take."""
        if self._batches is not None and len(frames) > 1:
            return self._batches.send.send(self._sock.fileno(), frames, [where.sockaddr for where in targets])
        failed = []
        for index, (frame, where) in enumerate(zip(frames, targets, strict=True)):
            try:
                self._sock.sendto(frame, where.address.sockaddr)
            except OSError:
                failed.append(index)
        return failed

    def send_connected(self, frame: bytes) -> bool:
        """Send to the peer of :meth:`connect`; false if the system would not take it."""
        try:
            self._sock.send(frame)
        except OSError:
            return False
        return True

    def stamp_departures(self) -> bool:
        """Have the kernel stamp what is sent from now on, and number it from 0; false where it cannot.

        The stamps wait in the socket's error queue, within its receive buffer (which is raised for it, to some 40,000
        stamps where permitted): read :meth:`departures` often. While any wait, a selector finds the socket ready.
        """
        if self._batches is None:
            return False
        try:
            self._number_departures()
        except OSError:
            return False
        self.rcvbuf_bytes = raise_rcvbuf(self._sock)
        self._stamps_departures = True
        return True

    def restart_departures(self) -> None:
        """Number what is sent from now on from 0 again: a failed send may have taken a number, or not.

        Read :meth:`departures` before, where the old numbers matter.
        """
        if self._stamps_departures:
            self._number_departures()

    def departures(self) -> list[tuple[int, int]]:
        """(number, UTC ns) of what has left since it was last asked: 32 bits, so it wraps; empty if nothing is stamped.

        The stamp is taken as the datagram is handed to the driver of the network card.
        """
        if self._batches is None or not self._stamps_departures:
            return []
        read, fd = self._batches.departures.read, self._sock.fileno()
        left: list[tuple[int, int]] = []
        more = True
        while more:
            ids, stamps_ns, more = read(fd)
            left += zip(ids.tolist(), stamps_ns.tolist(), strict=True)
        return left

    def _number_departures(self) -> None:
        """Numbers begin at 0 when they are asked for anew."""
        flags = linux.TX_SOFTWARE | linux.SOFTWARE | linux.OPT_TSONLY
        for value in (flags, flags | linux.OPT_ID):
            self._sock.setsockopt(socket.SOL_SOCKET, linux.SO_TIMESTAMPING, value)


def check_broadcast(where: Address, local: str) -> None:
    """Raise SourceError where ``where`` is a broadcast address and the system has no way there from ``local``.

    255.255.255.255 is the network of the address bound to, or that of the default route. Addresses that are none pass.
    """
    if where.family != socket.AF_INET or is_multicast(where.host):
        return
    with socket.socket(where.family, socket.SOCK_DGRAM) as probe:  # to connect one sends nothing
        probe.bind((local, 0))
        if where.host != "255.255.255.255" and probe.connect_ex(where.sockaddr) != errno.EACCES:
            return  # else it takes what only broadcast addresses ask for
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        try:
            probe.connect(where.sockaddr)
        except OSError as error:
            raise explain(error, f"broadcast to {where} from {local}") from None


_MULTICAST_TTL: dict[int, tuple[int, int]] = {
    socket.AF_INET: (socket.IPPROTO_IP, socket.IP_MULTICAST_TTL),
    socket.AF_INET6: (socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS),
}


def _only_joined_groups(sock: socket.socket, family: int) -> None:
    """By default a Linux socket also gets the groups that other sockets on the machine have joined."""
    if sys.platform == "linux" and family == socket.AF_INET:
        sock.setsockopt(socket.IPPROTO_IP, linux.IP_MULTICAST_ALL, 0)


def _index(iface: str | None) -> int:
    if iface is None:
        return 0
    try:
        return socket.if_nametoindex(iface)
    except OSError:
        raise SettingsError(f"iface={iface}: neither an address nor an interface of this machine") from None


def _ipv4(iface: str | None) -> tuple[bytes, int]:
    """An interface as (address, index), whichever of the two it is given by."""
    try:
        return socket.inet_aton(str(ipaddress.IPv4Address(iface or "0.0.0.0"))), 0
    except ValueError:
        return bytes(4), _index(iface)


def _outgoing(family: int, iface: str) -> tuple[int, int, bytes]:
    if family == socket.AF_INET6:
        return socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_IF, struct.pack("@I", _index(iface))
    address, index = _ipv4(iface)
    request = struct.pack("@4s4si", bytes(4), address, index) if index else address
    return socket.IPPROTO_IP, socket.IP_MULTICAST_IF, request


def _membership(
    group: ipaddress.IPv4Address | ipaddress.IPv6Address, iface: str | None, source: str | None
) -> tuple[int, int, bytes]:
    """setsockopt arguments: ip_mreq(n), ip_mreq_source, ipv6_mreq or group_source_req."""
    if isinstance(group, ipaddress.IPv6Address):
        index = _index(iface or group.scope_id)
        if source is None:
            return socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, struct.pack("@16sI", group.packed, index)
        both = (struct.pack("=HHI16sI100x", socket.AF_INET6, 0, 0, raw, 0) for raw in (group.packed, _packed6(source)))
        return socket.IPPROTO_IPV6, linux.MCAST_JOIN_SOURCE_GROUP, struct.pack("@I4x128s128s", index, *both)
    local, index = _ipv4(iface)
    if source is not None:
        if index:
            raise SettingsError(f"iface={iface}: with source= an interface is given by its address")
        request = struct.pack("=4s4s4s", group.packed, local, socket.inet_aton(source))
        return socket.IPPROTO_IP, linux.IP_ADD_SOURCE_MEMBERSHIP, request
    request = struct.pack("@4s4si", group.packed, local, index) if index else group.packed + local
    return socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, request


def _packed6(source: str) -> bytes:
    try:
        return ipaddress.IPv6Address(source).packed
    except ValueError:
        raise SettingsError(f"source={source}: an IPv6 group has IPv6 sources") from None
