"""The sockets of one platform: names in a folder that only its owner may enter, and how a process takes its own."""

from __future__ import annotations

import errno
import os
import socket
import stat
from contextlib import suppress
from pathlib import Path

from pmutools.errors import SourceError

WATCHDOG, CONTROL, AIDE, OUTPUT = "watchdog.in", "control.in", "aide.in", "output.in"
"""Datagram sockets."""
REPLIES = "server.replies"
"""Where the server hears what became of orders; datagrams."""
STATUS = "status.in"
"""Where the server hears the watchdog itself; datagrams."""
SERVER = "server.in"
"""Sequenced packets: the server listens."""
NAMES = (WATCHDOG, CONTROL, AIDE, OUTPUT, SERVER, REPLIES, STATUS)
LONGEST = 107
"""Bytes of a Unix socket's path."""


def prepare(folder: str | os.PathLike[str]) -> Path:
    """Make the run folder, mode 0700. Raises SourceError where others may enter it, or a name would be too long."""
    path = Path(folder).absolute()
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = path.stat()
    except OSError as error:
        raise SourceError(f"run folder {path}: {error.strerror}") from None
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid() or found.st_mode & 0o077:
        raise SourceError(f"run folder {path}: others may enter it; chmod 700 {path}, or take another")
    most = LONGEST - len("/") - max(map(len, NAMES))
    if len(os.fsencode(path)) > most:
        raise SourceError(f"run folder {path}: too long for a socket's name; take one of at most {most} bytes")
    return path


def bind_datagram(folder: Path, name: str, *, buffer: int | None = None) -> socket.socket:
    """A non-blocking datagram socket bound to ``name``; ``buffer`` asks for so many bytes to receive in.

    Raises SourceError where a process that lives has that name, or the folder takes none.
    """
    return _bound(folder / name, socket.SOCK_DGRAM, buffer)


def listen(folder: Path, name: str, backlog: int = 8) -> socket.socket:
    """A non-blocking listener of sequenced packets; raises as :func:`bind_datagram` does."""
    sock = _bound(folder / name, socket.SOCK_SEQPACKET, None)
    sock.listen(backlog)
    return sock


def is_held(path: Path, kind: int = socket.SOCK_DGRAM) -> bool:
    """Whether a process that lives is behind a name. A name that nobody holds may be left by one that died."""
    with socket.socket(socket.AF_UNIX, kind) as probe:
        probe.setblocking(False)
        try:
            probe.connect(os.fspath(path))
        except OSError as error:
            # EAGAIN: a listener whose queue is full; EPROTOTYPE: a socket of another kind
            return error.errno in (errno.EAGAIN, errno.EPROTOTYPE)
    return True


def release(sock: socket.socket) -> None:
    """Close a bound socket and take its name away."""
    with suppress(OSError):
        os.unlink(sock.getsockname())
    sock.close()


def _bound(path: Path, kind: int, buffer: int | None) -> socket.socket:
    if os.path.lexists(path) and is_held(path, kind):
        raise SourceError(f"{path}: another process that is running has it; end that, or take another run folder")
    sock = socket.socket(socket.AF_UNIX, kind)
    try:
        sock.setblocking(False)
        if buffer is not None:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
        with suppress(FileNotFoundError):
            path.unlink()
        sock.bind(os.fspath(path))
    except OSError as error:
        sock.close()
        raise SourceError(f"{path}: {error.strerror or error}") from None  # Python's own errors have no strerror
    return sock


class Sender:
    """Sends datagrams to one name; what is refused or not taken at once is told, never raised, never waited for."""

    def __init__(self, path: Path) -> None:
        self.path = os.fspath(path)
        self._sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._sock.setblocking(False)

    def send(self, datagram: bytes) -> bool:
        """Whether it was taken."""
        try:
            self._sock.sendto(datagram, self.path)
        except OSError:
            return False
        return True

    def close(self) -> None:
        self._sock.close()
