"""``dcon platform --run-dir`` as a process: what it says where it cannot be, and how it ends without the others."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from support.live import free_ports, free_udp_port
from support.running import command_line, descendants
from support.swing import Streams

from dcon.link.paths import CONTROL, bind_datagram, is_held, prepare

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform != "linux", reason="run folders are Linux's"),
]
NAMES = ("N1", "S1")
QUIET = "\n[platform]\nfifo = no\ntime_source = none\n"


def platform(folder: Path, *arguments: str, ports: list[int] | None = None) -> subprocess.Popen[str]:
    urls = [f"udp://127.0.0.1:{port}" for port in ports or [free_udp_port() for _ in NAMES]]
    (folder / "site.ini").write_text(Streams(NAMES).ini(urls=urls, extra=QUIET))
    command = [sys.executable, "-m", "dcon.cli", "platform", "--ini", str(folder / "site.ini")]
    command += ["--run-dir", str(folder / "run"), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def said(process: subprocess.Popen[str]) -> tuple[int, str]:
    _, err = process.communicate(timeout=30)
    return process.returncode, err


def test_two_in_one_folder(tmp_path: Path) -> None:
    with bind_datagram(prepare(tmp_path / "run"), CONTROL):
        code, err = said(platform(tmp_path))
    assert code == 1
    assert err.startswith(f"dcon: {tmp_path}/run/control.in: another process that is running has it; end that, or")
    assert err.count("\n") == 1


def test_a_folder_that_others_may_enter(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir(mode=0o755)
    code, err = said(platform(tmp_path))
    assert code == 1 and err.count("\n") == 1 and "chmod 700" in err


def test_a_port_in_use_is_the_front_s_word_in_one_line(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = int(taken.getsockname()[1])
        code, err = said(platform(tmp_path, ports=[port, free_udp_port()]))
    assert code == 1 and err.count("\n") == 1 and f"udp://127.0.0.1:{port}" in err
    assert not is_held(tmp_path / "run" / CONTROL)


def start_failed(folder: Path, command: str, ports: list[int], keys: str = "") -> tuple[int, str]:
    """Exit code, and stderr without the watchdog's log."""
    extra = f"""{QUIET}[server]
listen = 127.0.0.1:{free_ports(1)[0]}
{keys}
[watchdog]
fifo = no
log = {folder / "watchdog.jsonl"}
[log]
path = {folder / "s.mcap"}
"""
    (folder / "site.ini").write_text(
        Streams(NAMES).ini(urls=[f"udp://127.0.0.1:{port}" for port in ports], extra=extra)
    )
    arguments = [command, "--ini", str(folder / "site.ini"), "--run-dir", str(folder / "run"), "--quiet"]
    return said(subprocess.Popen([sys.executable, "-m", "dcon.cli", *arguments], stderr=subprocess.PIPE, text=True))


@pytest.mark.parametrize("command", ["platform", "server", pytest.param("run", marks=pytest.mark.alone)])
def test_a_bad_key_is_one_line_and_a_user_s_mistake_whoever_reads_it(command: str, tmp_path: Path) -> None:
    """The aides read it for the platform, and the server does for `dcon run`."""
    keys = tmp_path / "keys.ini"
    keys.write_text("[operator ann]\nkey = 12\n")
    keys.chmod(0o600)
    code, err = start_failed(tmp_path, command, [free_udp_port() for _ in NAMES], f"keys = {keys}")
    assert (code, err.count("\n")) == (2, 1), err
    assert err.startswith(f"dcon: {keys}:2: [operator ann] key: must be at least 32")


@pytest.mark.alone
def test_a_port_in_use_is_one_line_of_a_run_too(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = int(taken.getsockname()[1])
        code, err = start_failed(tmp_path, "run", [port, free_udp_port()])
    lines = [line for line in err.splitlines() if not line.startswith("no keys in [server]")]
    assert code == 1 and len(lines) == 1 and f"udp://127.0.0.1:{port}: already in use" in lines[0], err


def test_a_log_has_no_place_in_a_run_folder(tmp_path: Path) -> None:
    code, err = said(platform(tmp_path, "--log", "s.mcap"))
    assert code == 2 and "the server writes the log" in err


def test_it_ends_when_asked_to_while_it_still_waits_for_the_watchdog(tmp_path: Path) -> None:
    process = platform(tmp_path, "--json")
    end_s = time.monotonic() + 20
    while len(mine := list(descendants(process.pid))) < 2 or not is_held(tmp_path / "run" / CONTROL):
        assert time.monotonic() < end_s and process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 130, err
    assert json.loads(out)["final_state"] == "INIT"
    end_s = time.monotonic() + 5
    while any(Path(f"/proc/{pid}").exists() for pid in mine):
        assert time.monotonic() < end_s
        time.sleep(0.02)


IMPATIENT = """
import sys
from dcon.control import hanging
hanging.HUNG_NS = 1_000_000_000
from dcon.cli import main
main()
"""
"""``dcon``, to whose controller a child hangs after a second."""


@pytest.mark.parametrize(("module", "words"), [("dcon.front", "front process hangs"), ("dcon.aides", "aides process")])
def test_a_child_that_stands_still_ends_it_and_is_killed(module: str, words: str, tmp_path: Path) -> None:
    urls = [f"udp://127.0.0.1:{free_udp_port()}" for _ in NAMES]
    (tmp_path / "site.ini").write_text(Streams(NAMES).ini(urls=urls, extra=QUIET + "[watchdog]\nfifo = no\n"))
    both = ["--ini", str(tmp_path / "site.ini"), "--run-dir", str(prepare(tmp_path / "run"))]
    notify = tmp_path / "notify"
    with ExitStack() as stack:
        ready = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        ready.bind(str(notify))
        ready.settimeout(30)
        watchdog = subprocess.Popen([sys.executable, "-m", "dcon.cli", "watchdog", *both], stderr=subprocess.DEVNULL)
        stack.callback(watchdog.wait, 10)
        stack.callback(watchdog.kill)
        environment = {**os.environ, "NOTIFY_SOCKET": str(notify)}
        command = [sys.executable, "-c", IMPATIENT, "platform", *both]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)
        stack.callback(process.kill)
        assert b"READY=1" in ready.recv(4096)  # the watchdog is healthy: front and aides have beaten
        mine = list(descendants(process.pid))
        (child,) = [pid for pid in mine if module in command_line(pid)]
        os.kill(child, signal.SIGSTOP)
        code, err = said(process)
        assert code == 1 and err.splitlines()[-1].startswith(f"dcon: the {words}")
        assert err.splitlines()[-1].endswith("has not beaten for 1 s")
        assert not any(Path(f"/proc/{pid}").exists() for pid in mine)


def test_a_stderr_that_nobody_reads_stops_no_tick(tmp_path: Path) -> None:
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with suppress(BlockingIOError):
        while True:
            os.write(writer, bytes(4096))
    os.set_blocking(writer, True)
    ini = Streams(NAMES).ini(urls=[f"tcp://127.0.0.1:{port}" for port in free_ports(2)], extra=QUIET)  # warns: refused
    (tmp_path / "site.ini").write_text(ini)
    command = [sys.executable, "-m", "dcon.cli", "platform", "--ini", str(tmp_path / "site.ini"), "--json"]
    command += ["--log", str(tmp_path / "s.mcap"), "--duration", "2"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=writer, text=True) as process:
        os.close(writer)
        assert process.stdout is not None
        told, _, _ = select.select([process.stdout], [], [], 30)
        assert told, "it waits for whoever should read stderr"
        summary = json.loads(process.stdout.readline())
        with os.fdopen(reader, "rb") as stream:
            said = stream.read()
    assert summary["ticks"] > 60  # of the 120 of two seconds, of which it takes some to begin
    assert b"WARNING" in said.replace(bytes(4096), b"")
