"""Datagrams of sd_notify(3), to a socket in a folder and to one with an abstract name."""

from __future__ import annotations

import os
import socket
import sys
from pathlib import Path

import pytest

from dcon.link.notify import ALIVE, READY, Notifier

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="systemd is Linux's")


@pytest.mark.parametrize("abstract", [False, True])
def test_assignments_arrive_a_line_each(abstract: bool, tmp_path: Path) -> None:
    name = f"@dcon-test-{os.getpid()}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as service:
        service.bind("\0" + name[1:] if abstract else name)
        service.settimeout(5)
        notifier = Notifier({"NOTIFY_SOCKET": name})
        assert notifier.tell(READY, ALIVE, status="ACTIVE\nclosed_loop")
        assert service.recv(100) == b"READY=1\nWATCHDOG=1\nSTATUS=ACTIVE closed_loop"


def test_nobody_there_is_no_error(tmp_path: Path) -> None:
    assert not Notifier({}).tell(READY)
    assert not Notifier({"NOTIFY_SOCKET": str(tmp_path / "gone")}).tell(READY)
