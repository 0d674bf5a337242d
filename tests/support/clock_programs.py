"""Real chronyd, ptp4l and gpsd that keep their hands off this machine's clock, and are ended by their ids."""

from __future__ import annotations

import contextlib
import os
import pwd
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import pytest
from support.live import free_ports
from support.requires import requires

from pmutools.clocksources.asking import SYSTEM_PATHS, NoAnswer, Patience
from pmutools.measure.clocks import ChronyClock

PATIENCE_S = 20.0
T = TypeVar("T")
os.environ["PATH"] = os.pathsep.join((os.environ.get("PATH", ""), *SYSTEM_PATHS))


@contextmanager
def running(command: list[str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A program in a process group of its own, which ends with the block."""
    with log.open("wb") as out:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=out, stderr=out, start_new_session=True)
    try:
        yield process
    finally:
        end(process)


def end(process: subprocess.Popen[bytes]) -> None:
    """End a program of :func:`running`, and all that it has started."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(3)


def until(ask: Callable[[Patience], T], wanted: Callable[[T], bool]) -> T:
    """Ask again and again for an answer that is ``wanted``; fails the test where none comes."""
    deadline, last = time.monotonic() + PATIENCE_S, "nothing"
    while time.monotonic() < deadline:
        try:
            answer = ask(Patience(5.0))
            if wanted(answer):
                return answer
            last = repr(answer)
        except NoAnswer as error:
            last = str(error)
        time.sleep(0.05)
    pytest.fail(f"never came; the last answer was: {last}")


@contextmanager
def chronyd(folder: Path, *settings: str, ntp_port: int = 0) -> Iterator[int]:
    """chronyd without control of the clock (``-x``); gives the port where it takes questions."""
    program = requires("chronyd")
    (port,) = free_ports(1)
    config = folder / f"chrony-{port}.conf"
    lines = (f"port {ntp_port}", f"cmdport {port}", "bindcmdaddress 127.0.0.1", "bindcmdaddress /")
    config.write_text("\n".join((*lines, f"pidfile {folder}/chrony-{port}.pid", *settings, "")))
    user = pwd.getpwuid(os.getuid()).pw_name
    command = [str(program), "-U", "-x", "-d", "-u", user, "-f", str(config)]
    with running(command, folder / f"chrony-{port}.log"):
        yield port


def settled(clock: ChronyClock) -> bool:
    """Whether it is over the first samples, which say little."""
    return clock.bound_ns is not None and clock.bound_ns < 10_000_000


GRANDMASTER = """
clockClass 6
clockAccuracy 0x21
masterOnly 1
"""
PTP = """[global]
free_running 1
time_stamping software
logSyncInterval -4
logMinDelayReqInterval -4
logAnnounceInterval -2
announceReceiptTimeout 3
use_syslog 0
uds_address {folder}/{name}.sock
{more}
"""
NETWORK = """
ip link add pv0 type veth peer name pv1 && ip link set pv0 up && ip link set pv1 up || exit 9
ptp4l -2 -f {folder}/grandmaster.conf -i pv0 & echo $! > {folder}/grandmaster.pid
exec ptp4l -2 -f {folder}/slave.conf -i pv1
"""


@contextmanager
def ptp4l_pair(folder: Path) -> Iterator[tuple[Path, int]]:
    """A grandmaster and who follows it, over a cable that only they know; gives the latter's socket, the former's id.

    They are in a namespace without any right to the clock, and free-running besides.
    """
    for program in ("ptp4l", "pmc", "ip", "unshare"):
        requires(program)
    if subprocess.run(["unshare", "-rn", "ip", "link", "add", "pv0", "type", "veth"], capture_output=True).returncode:
        pytest.skip("this kernel gives no network namespace to try PTP in")
    (folder / "grandmaster.conf").write_text(PTP.format(folder=folder, name="grandmaster", more=GRANDMASTER))
    (folder / "slave.conf").write_text(PTP.format(folder=folder, name="slave", more="slaveOnly 1"))
    with running(["unshare", "-rn", "sh", "-c", NETWORK.format(folder=folder)], folder / "ptp.log"):
        deadline = time.monotonic() + PATIENCE_S
        while not (folder / "slave.sock").exists():
            assert time.monotonic() < deadline, (folder / "ptp.log").read_text()
            time.sleep(0.02)
        yield folder / "slave.sock", int((folder / "grandmaster.pid").read_text())


@contextmanager
def gpsd_of(sentences: list[str], folder: Path, *, cycle_s: float = 0.02) -> Iterator[int]:
    """gpsd, fed by its own gpsfake with NMEA sentences over and over; gives its port."""
    program = requires("gpsfake")
    requires("gpsd")
    (port,) = free_ports(1)
    log = folder / "receiver.log"
    log.write_bytes(b"# a receiver\n" + b"".join(f"{sentence}\r\n".encode() for sentence in sentences))
    command = [str(program), "-q", "-n", "-t", "-c", str(cycle_s), "-P", str(port), str(log)]
    with running(command, folder / "gpsfake.log"):
        yield port


def nmea(body: str) -> str:
    """A sentence with its checksum."""
    check = 0
    for octet in body.encode():
        check ^= octet
    return f"${body}*{check:02X}"


def receiver(start_s: float, seconds: int, *, fix: bool = True) -> list[str]:
    """What a GPS receiver says in so many seconds from a POSIX time on."""
    said = []
    for second in range(seconds):
        at = time.gmtime(start_s + second)
        clock, day = time.strftime("%H%M%S.00", at), time.strftime("%d%m%y", at)
        if fix:
            said += [
                nmea(f"GPGGA,{clock},4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"),
                nmea("GPGSA,A,3,04,05,09,12,24,25,29,31,,,,,1.8,1.0,1.5"),
                nmea(f"GPRMC,{clock},A,4807.038,N,01131.000,E,0.0,0.0,{day},,,A"),
            ]
        else:
            said += [
                nmea(f"GPGGA,{clock},,,,,0,00,,,M,,M,,"),
                nmea("GPGSA,A,1,,,,,,,,,,,,,,,"),
                nmea("GPRMC,,V,,,,,,,,,,N"),
            ]
    return said
