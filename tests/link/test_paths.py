"""Names in the run folder: taken from the dead, never from the living."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from dcon.link import paths
from dcon.link.paths import Sender, bind_datagram, is_held, listen, prepare, release
from pmutools.errors import SourceError

HOLDER = """
import sys, time
from pathlib import Path
from dcon.link.paths import bind_datagram, listen
take = {"datagram": bind_datagram, "packets": listen}[sys.argv[2]]
held = take(Path(sys.argv[1]), "x.in")
print("held", flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize(("kind", "take"), [("datagram", bind_datagram), ("packets", listen)])
def test_a_name_is_kept_from_the_living_and_taken_from_the_dead(kind: str, take: object, tmp_path: Path) -> None:
    folder = prepare(tmp_path / "run")
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, str(folder), kind], stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None and holder.stdout.readline() == "held\n"
    with pytest.raises(SourceError, match=r"x\.in: another process that is running has it; end that"):
        take(folder, "x.in")  # type: ignore[operator]
    holder.send_signal(signal.SIGSTOP)
    with pytest.raises(SourceError, match="another process"):
        take(folder, "x.in")  # type: ignore[operator]
    holder.kill()
    holder.communicate()
    assert (folder / "x.in").exists()
    mine = take(folder, "x.in")  # type: ignore[operator]
    release(mine)
    assert not (folder / "x.in").exists()


def test_a_listener_with_a_full_queue_is_alive(tmp_path: Path) -> None:
    folder = prepare(tmp_path / "run")
    listener = listen(folder, "x.in", backlog=0)
    waiting = []
    for _ in range(5):
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        sock.setblocking(False)
        waiting.append(sock)
        if sock.connect_ex(str(folder / "x.in")):
            break
    else:
        pytest.fail("the queue never filled")
    assert is_held(folder / "x.in", socket.SOCK_SEQPACKET) and is_held(folder / "x.in", socket.SOCK_DGRAM)
    for sock in waiting:
        sock.close()
    release(listener)


def test_the_folder_is_for_its_owner(tmp_path: Path) -> None:
    folder = prepare(tmp_path / "a" / "run")
    assert folder.stat().st_mode & 0o777 == 0o700 and prepare(folder) == folder
    folder.chmod(0o750)
    with pytest.raises(SourceError, match=r"others may enter it; chmod 700 .*run"):
        prepare(folder)
    (tmp_path / "file").touch()
    with pytest.raises(SourceError, match="File exists"):
        prepare(tmp_path / "file")
    with pytest.raises(SourceError, match="too long for a socket's name"):
        prepare(tmp_path / ("x" * 60) / ("y" * 60))


def test_a_sender_never_waits_and_tells_what_was_taken(tmp_path: Path) -> None:
    folder = prepare(tmp_path / "run")
    sender = Sender(folder / paths.CONTROL)
    assert not sender.send(b"x")
    mine = bind_datagram(folder, paths.CONTROL, buffer=4096)
    assert sender.send(b"x") and mine.recv(10) == b"x"
    while sender.send(bytes(500)):
        pass
    assert mine.recv(1000) == bytes(500) and sender.send(b"x")
    os.unlink(folder / paths.CONTROL)
    sender.close()
    mine.close()


def test_the_longest_folder_that_is_taken_has_room_for_every_name(tmp_path: Path) -> None:
    most = 107 - 1 - max(map(len, paths.NAMES))
    folder = tmp_path / ("x" * (most - len(str(tmp_path)) - 1))
    for name in paths.NAMES:
        release(bind_datagram(prepare(folder), name))
    with pytest.raises(SourceError, match=rf"too long for a socket's name; take one of at most {most} bytes"):
        prepare(f"{folder}y")
    with pytest.raises(SourceError, match=r"path too long$"):
        bind_datagram(tmp_path, "x" * 107)
