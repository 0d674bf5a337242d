"""What the watchdog tells systemd."""

from __future__ import annotations

import os
import signal
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.dogs import watchdog

from dcon.watchdog.notify import ALIVE, READY, STOPPING, Notify

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="systemd is Linux's")


@contextmanager
def service(name: str) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.bind(name)
        sock.settimeout(20)
        yield sock


@pytest.mark.parametrize("abstract", [False, True])
def test_assignments_arrive_a_line_each(abstract: bool, tmp_path: Path) -> None:
    name = f"@dcon-watchdog-test-{os.getpid()}" if abstract else str(tmp_path / "notify")
    with service("\0" + name[1:] if abstract else name) as sock:
        Notify({"NOTIFY_SOCKET": name}).tell(READY, ALIVE)
        assert sock.recv(100) == b"READY=1\nWATCHDOG=1"


def test_nobody_there_is_no_error(tmp_path: Path) -> None:
    Notify({}).tell(READY)
    Notify({"NOTIFY_SOCKET": str(tmp_path / "gone")}).tell(READY)


@pytest.mark.realtime
def test_it_is_ready_alive_and_stopping(tmp_path: Path) -> None:
    name = str(tmp_path / "notify")
    with service(name) as sock, watchdog(tmp_path / "run", env=os.environ | {"NOTIFY_SOCKET": name}) as dog:
        first = sock.recv(1000).decode().splitlines()
        assert first[:2] == [READY, ALIVE] and first[2].startswith("STATUS=OPEN ") and len(first) == 3
        second = sock.recv(1000).decode().splitlines()
        assert second[0] == ALIVE and "control" in second[1].split()  # nobody beats
        dog.signal(signal.SIGSTOP)
        sock.setblocking(False)
        while True:
            try:
                sock.recv(1000)
            except BlockingIOError:
                break
        sock.settimeout(1.5)
        with pytest.raises(TimeoutError):  # it does not go on, and says nothing
            sock.recv(1000)
        sock.settimeout(20)
        dog.signal(signal.SIGCONT)
        assert sock.recv(1000).decode().splitlines()[0] == ALIVE
        dog.signal(signal.SIGTERM)
        assert dog.process.wait(timeout=20) == 0
        while sock.recv(1000) != STOPPING.encode():
            pass
