"""The sockets of the watchdog: its own in the run folder, those it tells, and the one the command leaves by."""

from __future__ import annotations

import errno
import os
import socket
import time
from contextlib import suppress
from typing import Final
from urllib.parse import urlsplit

from dcon.watchdog.codec import LONGEST, Beat, Command, Malformed, Readback, Word, decode

INBOX: Final = "watchdog.in"
MOST: Final = 64
"""Datagrams that one round takes; the rest wait for the next. The kernel keeps ``net.unix.max_dgram_qlen`` (10 on
many systems) and refuses more: a flood costs its sender, and crowds out others, which are then silent."""


class Refused(Exception):
    """The watchdog cannot start: one line that says why, and the remedy."""


def run_folder(folder: str) -> None:
    """Make the run folder, or see that nobody else may write into it. Raises Refused."""
    try:
        os.mkdir(folder, 0o700)
    except FileExistsError:
        if os.stat(folder).st_mode & 0o022:
            raise Refused(f"{folder}: others may write into it; chmod 700 it, or name another run folder") from None
    except OSError as error:
        raise Refused(f"{folder}: {error.strerror}; name a run folder that can be made") from None


def bind_inbox(folder: str, name: str = INBOX) -> socket.socket:
    """The socket that everybody here writes to; one left by a process that died is replaced. Raises Refused."""
    path = os.path.join(folder, name)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(path)
        except OSError as error:
            if error.errno == errno.ECONNREFUSED:
                os.unlink(path)
        else:
            raise Refused(f"{path}: another watchdog runs there; end it, or name another run folder")
    inbox = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    inbox.setblocking(False)
    before = os.umask(0o077)
    try:
        inbox.bind(path)
    except OSError as error:
        inbox.close()
        raise Refused(f"{path}: {error.strerror or error}; name another run folder") from None
    finally:
        os.umask(before)
    return inbox


def drain(inbox: socket.socket) -> list[Beat | Command | Readback | Word | Malformed]:
    """What waits, at most :data:`MOST`."""
    items: list[Beat | Command | Readback | Word | Malformed] = []
    with suppress(BlockingIOError):
        while len(items) < MOST:
            items.append(decode(inbox.recv(LONGEST), time.time_ns()))
    return items


class Post:
    """Sends datagrams to one address without ever waiting; what is refused is counted."""

    def __init__(self, family: int, address: str | tuple[str, int] | tuple[str, int, int, int]) -> None:
        self._sock = socket.socket(family, socket.SOCK_DGRAM)
        self._sock.setblocking(False)
        self._address = address
        self.failed = 0

    def send(self, datagram: bytes) -> None:
        """Never raises."""
        for _ in range(2):
            try:
                self._sock.sendto(datagram, self._address)
                return
            except ConnectionRefusedError:  # over UDP it tells of the one before, and this one has not left
                continue
            except OSError:
                break
        self.failed += 1


def output(url: str, folder: str) -> Post:
    """Where the command leaves to: ``udp://HOST:PORT``, or the name of a socket in the run folder.

    A host is resolved once, here; the first address counts, IPv4 before IPv6. Raises Refused.
    """
    if "://" not in url:
        return Post(socket.AF_UNIX, os.path.join(folder, url))
    parts = urlsplit(url)
    try:
        if parts.scheme != "udp" or not parts.hostname or not parts.port:
            raise ValueError
    except ValueError:
        raise Refused(f"{url}: no output; write udp://HOST:PORT") from None
    try:
        found = socket.getaddrinfo(parts.hostname, parts.port, type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError):
        raise Refused(f"{url}: unknown host {parts.hostname!r}; check it, or give an address") from None
    family, _, _, _, address = min(found, key=lambda entry: entry[0] != socket.AF_INET)
    return Post(family, address)  # type: ignore[arg-type]


def listeners(names: tuple[str, ...], folder: str) -> list[Post]:
    """Who is told the status: sockets of the run folder."""
    return [Post(socket.AF_UNIX, os.path.join(folder, name)) for name in names]
