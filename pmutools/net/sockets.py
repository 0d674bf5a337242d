"""What every socket here needs: addresses resolved, buffers sized, and failures told in one useful line."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import struct
import sys
from typing import NamedTuple

from pmutools import linux
from pmutools.errors import SourceError
from pmutools.flow import StampSource
from pmutools.net.endpoint import join_host

RCVBUF_BYTES = 64 << 20
"""Receive buffer asked for: 80,000 small datagrams, each charged some 0.8 KiB by the kernel."""

SNDBUF_BYTES = 8 << 20
"""Send buffer asked for: a tick of some thousand streams, while the network card takes it."""


class Address(NamedTuple):
    """A resolved address: its family, and the tuple that the socket module takes."""

    family: int
    sockaddr: tuple[str, int] | tuple[str, int, int, int]

    @property
    def host(self) -> str:
        return self.sockaddr[0]

    @property
    def port(self) -> int:
        return self.sockaddr[1]

    def at(self, host: str, port: int) -> Address:
        """Another numeric address, of the same family and on the same link."""
        if len(self.sockaddr) == 4:
            return Address(self.family, (host, port, 0, self.sockaddr[3]))
        return Address(self.family, (host, port))

    def __str__(self) -> str:
        return join_host(self.host, self.port)


def resolve(host: str, port: int, *, datagram: bool, family: int = socket.AF_UNSPEC) -> Address:
    """An address of ``host``, IPv4 where it has one (``localhost`` is then the same to both ends).

    Raises SourceError where there is none. A name may have to be asked for, which may take its time.
    """
    kind = socket.SOCK_DGRAM if datagram else socket.SOCK_STREAM
    try:
        found = socket.getaddrinfo(host, port, socket.AddressFamily(family), kind)
    except (OSError, UnicodeError):
        raise SourceError(f"{join_host(host, port)}: unknown host {host!r}; check it, or give an address") from None
    numeric, _, _, _, sockaddr = min(found, key=lambda entry: entry[0] != socket.AF_INET)
    return Address(numeric, (str(sockaddr[0]), *sockaddr[1:]))


def listening_socket(address: Address, backlog: int, called: str) -> socket.socket:
    """A non-blocking TCP socket that listens, IPv6 without IPv4.

    Raises SourceError, which begins with ``called``, where the port is taken or not permitted.
    """
    sock = socket.socket(address.family, socket.SOCK_STREAM)
    try:
        sock.setblocking(False)
        if address.family == socket.AF_INET6:
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        if sys.platform != "win32":  # a new start need not wait for old connections; on Windows it means sharing
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(address.sockaddr)
        sock.listen(backlog)
    except OSError as error:
        sock.close()
        raise explain(error, called) from None
    return sock


def refuse_itself(sock: socket.socket) -> None:
    """Raise ConnectionRefusedError where a TCP socket has reached nobody but itself.

    Who tries a local port again and again that nobody listens at may be given that port as its own, and the two SYNs
    meet (RFC 9293, 3.5). What is left of such a connection would keep a server from its port for a minute.
    """
    if sock.getsockname() == sock.getpeername():
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        raise ConnectionRefusedError(errno.ECONNREFUSED, os.strerror(errno.ECONNREFUSED))


_REMEDIES = {
    errno.EADDRINUSE: "already in use; stop the other program that has this port, or choose another",
    errno.EADDRNOTAVAIL: "this machine does not have that address; use 0.0.0.0 for every local address",
    errno.EACCES: "not permitted; ports below 1024 need privilege, broadcast addresses a network that allows them",
    errno.EPERM: "not permitted; does a local firewall forbid it?",
    errno.EINVAL: "not accepted; a link-local IPv6 address needs its interface (iface=NAME)",
    errno.ECONNREFUSED: "refused: nothing serves this port; is the device on, and the port right?",
    errno.ECONNRESET: "the other side reset the connection",
    errno.EPIPE: "the other side closed the connection",
    errno.ETIMEDOUT: "no answer; is the device reachable, or a firewall in between?",
    errno.EHOSTUNREACH: "no route to this host",
    errno.ENETUNREACH: "no route to this network",
    errno.ENODEV: "no such network interface",
    errno.EMFILE: "too many open files; raise the limit (ulimit -n)",
}


def explain(error: OSError, where: object) -> SourceError:
    """``error`` as one line that names ``where`` and says what to do."""
    reason = _REMEDIES.get(error.errno or 0, error.strerror or str(error))
    return SourceError(f"{where}: {reason}")


SPARE_FILES = 64
"""Open files that a process needs beside its sockets."""


def allow_all_files() -> None:
    """Let this process open as many files as the system permits: there may be one a stream."""
    with contextlib.suppress(ImportError, OSError, ValueError):  # Windows has no such limit; macOS another beside
        import resource

        _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def allow_open_files(count: int) -> None:
    """Raise this process's limit of open files so that ``count`` sockets fit. Raises SourceError where it may not."""
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return
    needed = count + SPARE_FILES
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= needed:
        return
    if hard != resource.RLIM_INFINITY and hard < needed:
        raise SourceError(
            f"{count} sockets: this process may have {hard} files open; raise the limit (ulimit -Hn, LimitNOFILE=) to "
            f"{needed}, or name fewer endpoints"
        )
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (needed, hard))
    except (OSError, ValueError) as error:  # macOS has another limit beside
        raise SourceError(f"{count} sockets: no more than {soft} files may be open ({error})") from None


def raise_rcvbuf(sock: socket.socket, nbytes: int = RCVBUF_BYTES) -> int:
    """Ask for a receive buffer; returns what the kernel gave (Linux gives, and reports, twice the size asked for)."""
    return _raise_buffer(sock, nbytes, linux.SO_RCVBUFFORCE, socket.SO_RCVBUF)


def raise_sndbuf(sock: socket.socket, nbytes: int = SNDBUF_BYTES) -> int:
    """Ask for a send buffer; returns what the kernel gave."""
    return _raise_buffer(sock, nbytes, linux.SO_SNDBUFFORCE, socket.SO_SNDBUF)


def _raise_buffer(sock: socket.socket, nbytes: int, force: int, ask: int) -> int:
    modest = 1 << 18
    options = (
        ((force, nbytes),) if sys.platform == "linux" else ()
    )  # needs CAP_NET_ADMIN; else the system's limit holds
    for option, size in (*options, (ask, nbytes), (ask, modest)):
        try:
            sock.setsockopt(socket.SOL_SOCKET, option, size)
        except OSError:
            continue
        break
    return sock.getsockopt(socket.SOL_SOCKET, ask)


SETTLING_NS = 1_000_000_000
"""The kernel begins to stamp some time after the first socket of the machine has asked for it."""


def stamp_arrivals(sock: socket.socket, *, hardware: bool = False) -> bool:
    """Have the kernel stamp what arrives (CLOCK_REALTIME); false where it cannot.

    ``hardware`` asks for the network card's stamps too, which come where the card was told to make them (SIOCSHWTSTAMP,
    as ``hwstamp_ctl -r 1`` does), in the card's own timescale.
    """
    if not linux.NATIVE:
        return False
    all_stamps = linux.RX_HARDWARE | linux.RAW_HARDWARE | linux.RX_SOFTWARE | linux.SOFTWARE
    try:
        sock.setsockopt(socket.SOL_SOCKET, linux.SO_TIMESTAMPNS, not hardware)  # one control message, not two
        if hardware:
            sock.setsockopt(socket.SOL_SOCKET, linux.SO_TIMESTAMPING, all_stamps)
    except OSError:
        return False
    return True


def stamp_source(stamp: linux.Stamp, asked_ns: int, *, settling: bool) -> StampSource:
    """Who took an arrival time, of what was asked for at UTC ``asked_ns``.

    While stamping is ``settling``, what the kernel has not stamped on arrival gets its stamp as it is read.
    """
    late = settling and stamp.source is StampSource.KERNEL and stamp.ns >= asked_ns
    return StampSource.USER if late else stamp.source


# --- the kernel's form of an address ----------------------------------------------------------------------------

_IN = struct.Struct("=H2s4s8x")
_IN6 = struct.Struct("=H2sI16sI")


def pack_sockaddr(address: Address) -> bytes:
    """``struct sockaddr_in`` or ``sockaddr_in6`` of Linux."""
    port = address.port.to_bytes(2, "big")
    if address.family == socket.AF_INET:
        return _IN.pack(address.family, port, socket.inet_aton(address.host))
    scope = address.sockaddr[3] if len(address.sockaddr) == 4 else 0
    raw = socket.inet_pton(socket.AF_INET6, address.host.partition("%")[0])
    return _IN6.pack(address.family, port, 0, raw, scope)


def unpack_sockaddr(raw: bytes) -> Address:
    """The inverse of :func:`pack_sockaddr`."""
    if len(raw) == _IN.size:
        family, port, host = _IN.unpack(raw)
        return Address(family, (socket.inet_ntoa(host), int.from_bytes(port, "big")))
    family, port, _flow, host, scope = _IN6.unpack(raw)
    return Address(family, (socket.inet_ntop(socket.AF_INET6, host), int.from_bytes(port, "big"), 0, scope))
