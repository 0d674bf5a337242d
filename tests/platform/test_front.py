"""The front over real sockets: what is asked for passes, nothing else; a flood of one port holds nobody else up."""

from __future__ import annotations

import os
import random
import signal
import socket
import statistics
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from support.live import free_udp_port
from support.swing import Streams

from dcon.control.linked import PairFrames, pair
from dcon.front.front import PARSE_NS, ROUND_NS, Front, Outlet
from dcon.front.receiving import Reception
from dcon.link.beats import LoopName
from dcon.link.children import launch
from dcon.link.counts import FrontCounts
from dcon.link.crossing import Item, PmuFrameIn
from dcon.link.failure import Failure
from dcon.link.paths import Sender
from dcon.link.pulse import Pulse
from dcon.settings import parse
from pmutools.c37118 import Command, encode_command, encode_header
from pmutools.c37118.checksum import sealed
from pmutools.c37118.config import encode_config
from pmutools.clock import SystemClock

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform != "linux", reason="sequenced packets and the parent's death are Linux's"),
]
NAMES = ("N1", "S1")
CLOCK = SystemClock()
SMALL_BYTES = 1 << 17


class Rig:
    """A front in this process, with both ends of its pair; PMU N1 from 127.0.0.1 only, or over TCP."""

    def __init__(self, folder: Path, tcp_port: int | None = None, *, is_shared: bool = False) -> None:
        self.ports = [free_udp_port()] * len(NAMES) if is_shared else [free_udp_port() for _ in NAMES]
        self.streams = Streams(NAMES)
        urls = [f"udp://127.0.0.1:{port}?source=127.0.0.1" for port in self.ports]
        if tcp_port is not None:
            urls[0] = f"tcp://127.0.0.1:{tcp_port}"
        settings = parse(self.streams.ini(urls=urls), "test.ini")
        ours, self.theirs = pair(SMALL_BYTES)
        self.frames = PairFrames(ours, CLOCK)
        self.ours = ours
        self.counts = FrontCounts()
        reception = Reception.of([site.endpoint for site in settings.sites], CLOCK, self.counts)
        self.receivers = reception.receivers
        sender = Sender(folder / "watchdog.in")
        pulses = (Pulse(name, sender) for name in (LoopName.UDP, LoopName.PARSE))
        self.front = Front(reception, Outlet(self.theirs, self.counts), *pulses, CLOCK)
        self.sock = self.sender("127.0.0.1")

    def sender(self, host: str) -> socket.socket:
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.bind((host, 0))
        return sock

    def configure(self) -> None:
        for name, port in zip(NAMES, self.ports, strict=True):
            self.sock.sendto(encode_config(self.streams.configs[name]), ("127.0.0.1", port))

    def send(self, pmu: int, *, sock: socket.socket | None = None) -> bytes:
        data = self.streams.data(NAMES[pmu], time.time_ns())
        (sock or self.sock).sendto(data, ("127.0.0.1", self.ports[pmu]))
        return data

    def turn(self) -> list[Item]:
        self.front.turn()
        return list(self.frames.take())

    def turns(self, until: int) -> list[PmuFrameIn]:
        """Frames, once there are as many; a failure after some seconds."""
        found: list[PmuFrameIn] = []
        end_s = time.monotonic() + 5
        while len(found) < until:
            assert time.monotonic() < end_s, found
            found += [item for item in self.turn() if isinstance(item, PmuFrameIn)]
        return found

    def close(self) -> None:
        self.receivers.close()
        self.frames.close()
        self.theirs.close()
        self.sock.close()


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path)
    yield made
    made.close()


def test_frames_pass_with_their_pmu_and_the_kernel_s_stamp_after_their_configuration(rig: Rig) -> None:
    rig.configure()
    rig.turns(2)
    before_ns = time.time_ns()
    sent = [rig.send(1), rig.send(0)]
    found = rig.turns(2)
    assert sorted((item.pmu, item.frame.data) for item in found) == [(0, sent[1]), (1, sent[0])]
    for item in found:
        assert not item.is_config
        assert before_ns <= (item.frame.arrival_ns or 0) <= time.time_ns()
    rig.configure()  # nothing new: not said again
    rig.send(0)
    assert [item.is_config for item in rig.turns(1)] == [False]


def test_a_wrong_source_and_a_wrong_idcode_do_not_pass_and_are_counted(rig: Rig) -> None:
    rig.configure()
    rig.turns(2)
    foreign = rig.sender("127.0.0.2")
    with foreign:
        for _ in range(5):
            rig.send(0, sock=foreign)
        rig.sock.sendto(encode_config(rig.streams.configs["S1"]), ("127.0.0.1", rig.ports[0]))
    rig.sock.sendto(rig.streams.data("S1", time.time_ns()), ("127.0.0.1", rig.ports[0]))
    rig.send(0)
    assert [item.pmu for item in rig.turns(1)] == [0]
    assert rig.counts.foreign == 5 + 2


def nothings(rig: Rig) -> list[tuple[str, bytes, str]]:
    """(which count, a datagram to N1's port that gives nothing, the address it comes from)."""
    rng = random.Random(2)
    frame, here = rig.streams.data("N1", time.time_ns()), "127.0.0.1"
    body, header = frame[:-2], encode_header(rig.streams.configs["N1"].idcode, "a device")
    config = encode_config(rig.streams.configs["N1"])
    small = sealed(body[:2] + (len(body) - 2).to_bytes(2, "big") + body[4:-4])
    return [
        ("undecodable", b"", here),
        ("undecodable", rng.randbytes(60), here),
        ("undecodable", bytes(65_000), here),
        ("undecodable", body + b"\0\0", here),
        ("undecodable", body[:2] + b"\xff\xff" + body[4:], here),
        ("undecodable", body[:2] + b"\0\3" + body[4:], here),
        ("undecodable", frame[:-1], here),
        ("undecodable", b"\xaa\x71" + frame[2:], here),
        ("undecodable", sealed(b"\xaa\x83" + body[2:]), here),
        ("undecodable", sealed(config[:2] + (60).to_bytes(2, "big") + config[4:58]), here),
        ("foreign", rig.streams.data("S1", time.time_ns()), here),
        ("foreign", encode_config(rig.streams.configs["S1"]), here),
        ("foreign", frame, "127.0.0.2"),
        ("foreign", b"", "127.0.0.2"),
        ("foreign", rng.randbytes(60), "127.0.0.2"),
        ("unneeded", header, here),
        ("unneeded", encode_command(rig.streams.configs["N1"].idcode, 2), here),
        ("repeated", config, here),
        ("held", small, here),
    ]


@pytest.mark.parametrize("proven", [True, False])
def test_each_datagram_that_gives_nothing_is_in_exactly_one_count(rig: Rig, proven: bool) -> None:
    """Whether or not its sender has ever sent a good frame, and what it sends afterwards changes nothing."""
    rig.configure()
    rig.turns(2)
    sent = Counter[str]()
    senders = {host: rig.sender(host) for host in ("127.0.0.1", "127.0.0.2")}
    kinds = nothings(rig)
    if not proven:
        kinds = [kind for kind in kinds if kind[0] == "undecodable" and not kind[1].startswith(b"\xaa\x31")]
    for number, (count, datagram, host) in enumerate(kinds * 3):
        senders[host].sendto(datagram, ("127.0.0.1", rig.ports[0]))
        sent[count] += 1
        if proven and number == len(kinds):
            rig.send(0, sock=senders["127.0.0.1"])  # by the configuration that another port of its host has shown
    end_s = time.monotonic() + 5
    while sum(vars(rig.counts).values()) < sum(sent.values()) and time.monotonic() < end_s:
        assert not [item for item in rig.turn() if isinstance(item, PmuFrameIn) and item.is_config]
    rig.send(0, sock=senders["127.0.0.1"])  # now it is proven
    assert len(rig.turns(1)) == 1
    assert {name: value for name, value in vars(rig.counts).items() if value} == sent
    for sock in senders.values():
        sock.close()


def test_a_malformed_flood_of_one_port_delays_nobody_by_more_than_a_round(rig: Rig) -> None:
    """10,000 datagrams wait at the port of N1 when the frame of S1 comes."""
    rig.configure()
    rig.turns(2)
    rng = random.Random(1)
    frame = rig.send(0)
    rig.turns(1)
    junk = [rng.randbytes(60), frame[:-3], frame[:20] + b"\0" + frame[21:]]
    for k in range(10_000):
        rig.sock.sendto(junk[k % 3], ("127.0.0.1", rig.ports[0]))
    rig.send(1)
    began_s = time.monotonic()
    assert any(isinstance(item, PmuFrameIn) and item.pmu == 1 for item in rig.turn())  # in the very next round
    assert time.monotonic() - began_s < 1.0
    while rig.counts.undecodable <= 100:
        assert time.monotonic() - began_s < 10.0
        rig.turn()


FLOOD = 2000


def changing(rig: Rig, name: str) -> list[bytes]:
    """As many configurations of a PMU, or each of an IDCODE of its own, no two of them the same."""
    config = rig.streams.configs[name if name in NAMES else NAMES[0]]
    (station,) = config.stations
    return [
        encode_config(
            replace(
                config,
                idcode=config.idcode if name in NAMES else 20_000 + k,
                stations=(replace(station, cfgcnt=1000 + k),),
            )
        )
        for k in range(FLOOD)
    ]


@pytest.mark.parametrize(
    ("name", "host"),
    [("N1", "127.0.0.1"), ("S1", "127.0.0.1"), ("N1", "127.0.0.9"), ("S1", "127.0.0.9"), ("rotating", "127.0.0.9")],
)
def test_a_flood_of_configurations_at_one_port_delays_nobody_else(rig: Rig, name: str, host: str) -> None:
    """At the port of N1: its own, another or ever another IDCODE, from its address or another one."""
    rig.configure()
    rig.turns(2)
    flood, is_own = changing(rig, name), (name, host) == ("N1", "127.0.0.1")
    with rig.sender(host) as sock:
        for datagram in flood:
            sock.sendto(datagram, ("127.0.0.1", rig.ports[0]))
    counts, configs, took_ns = rig.counts, 0, list[int]()

    def done() -> int:
        return configs + counts.foreign + counts.crowded + counts.own_drops

    end_s = time.monotonic() + 10
    while done() < FLOOD:
        assert time.monotonic() < end_s, (configs, counts)
        sent, began_ns = rig.send(1), time.thread_time_ns()
        found = [item for item in rig.turn() if isinstance(item, PmuFrameIn)]
        took_ns.append(time.thread_time_ns() - began_ns)
        assert [item.frame.data for item in found if item.pmu == 1] == [sent], "in the very next turn"
        configs += sum(item.is_config for item in found)
    assert done() == FLOOD and (configs > 0) == is_own
    assert is_own or counts.foreign > FLOOD / 4
    known = len(NAMES) + is_own  # that one has another port
    assert len(rig.receivers.routes) <= known and len(rig.receivers.demux._flows) <= known
    assert statistics.median(took_ns) < 4 * PARSE_NS

    slim = encode_config(rig.streams.slim("N1"))
    rig.sock.sendto(slim, ("127.0.0.1", rig.ports[0]))
    sent = rig.send(0)
    assert [frame.frame.data for frame in rig.turns(2) if frame.pmu == 0][-2:] == [slim, sent], "and then it is heard"


@pytest.mark.parametrize("kind", ["configurations", "frames", "junk"])
def test_pmus_at_one_port_have_turns_of_their_own(tmp_path: Path, kind: str) -> None:
    """Each turn finds sixty more datagrams in the name of N1, and one frame of S1 behind them."""
    rig = Rig(tmp_path, is_shared=True)
    rig.configure()
    rig.turns(2)
    rng = random.Random(1)
    flood = {
        "configurations": changing(rig, "N1"),
        "frames": [rig.streams.data("N1", time.time_ns())] * FLOOD,
        "junk": [rng.randbytes(100) for _ in range(FLOOD)],
    }[kind]
    sent, heard = list[bytes](), list[bytes]()
    while flood:
        now, flood = flood[:60], flood[60:]
        for datagram in now:
            rig.sock.sendto(datagram, ("127.0.0.1", rig.ports[0]))
        sent.append(rig.send(1))
        heard += [item.frame.data for item in rig.turn() if isinstance(item, PmuFrameIn) and item.pmu == 1]
        assert heard == sent[: len(heard)] and len(sent) - len(heard) <= 1, "in the next turn, or the one after it"
    rig.close()


LARGEST = 65_507


@pytest.mark.parametrize("kind", ["random", "false frames", "good frames"])
def test_a_flood_of_large_datagrams_stops_no_beat_and_delays_nobody(rig: Rig, kind: str) -> None:
    """Two hundred wait, or what of it the receive buffer holds: a turn takes ``PARSE_NS`` and one datagram more.

    Measured in the processor's time, whoever else runs, and against what one datagram costs.
    """
    rig.configure()
    rig.turns(2)
    header = encode_header(rig.streams.configs["N1"].idcode, "a device")
    data = {
        "random": random.Random(1).randbytes(LARGEST),
        "false frames": (b"\xaa\x01\x40\x00" * LARGEST)[:LARGEST],
        "good frames": header * (LARGEST // len(header)),
    }[kind]

    def turn() -> tuple[int, list[bytes]]:
        began_ns = time.thread_time_ns()
        heard = [item.frame.data for item in rig.turn() if isinstance(item, PmuFrameIn) and item.pmu == 1]
        return time.thread_time_ns() - began_ns, heard

    one_ns = 0
    for _ in range(3):
        rig.sock.sendto(data, ("127.0.0.1", rig.ports[0]))
        one_ns = max(one_ns, turn()[0])
    for _ in range(200):
        rig.sock.sendto(data, ("127.0.0.1", rig.ports[0]))
    sent = rig.send(1)
    turns = [turn() for _ in range(10)]
    assert [frame for _, heard in turns for frame in heard] == [sent]
    assert max(took_ns for took_ns, _ in turns) < 2 * PARSE_NS + 3 * one_ns
    assert one_ns < 100_000_000, "a datagram alone stops no beat"


class Device:
    """N1 behind a listening socket: says what it is asked, and then as much as is taken."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.setblocking(False)
        self.port = int(self._listener.getsockname()[1])
        self._sock: socket.socket | None = None
        self._flood = b""
        self._left = b""
        self.sent = 0
        """Bytes of the flood."""

    def turn(self, config: bytes, flood: bytes) -> None:
        """Move on; ``flood`` is said over and over once data are asked for."""
        with suppress(BlockingIOError):
            self._sock = self._sock or self._listener.accept()[0]
            if self._sock is None:
                return
            self._sock.setblocking(False)
            self._left += b"".join(self._say(command, config, flood) for command in self._heard())
        while self._flood and self._sock is not None:
            try:
                taken = self._sock.send(self._left or self._flood)
            except BlockingIOError:
                return
            self.sent += taken
            self._left = (self._left or self._flood)[taken:]

    def _heard(self) -> list[int]:
        assert self._sock is not None
        data = self._sock.recv(1000)
        return [data[at + 15] for at in range(0, len(data), 18)]

    def _say(self, command: int, config: bytes, flood: bytes) -> bytes:
        if command == Command.START_DATA:
            self._flood = flood
        assert self._sock is not None
        return config if command == Command.SEND_CFG2 and self._sock.send(config) < 0 else b""

    def close(self) -> None:
        self._listener.close()
        if self._sock is not None:
            self._sock.close()


@pytest.mark.parametrize("kind", ["frames", "header frames", "configurations", "junk"])
def test_a_flood_of_one_connection_waits_for_its_turn_and_delays_nobody(tmp_path: Path, kind: str) -> None:
    device = Device()
    rig = Rig(tmp_path, device.port)
    rig.configure()
    config = rig.streams.configs["N1"]
    flood = {
        "frames": b"".join(rig.streams.data("N1", 10**18 + k * 10**7) for k in range(3000)),
        "header frames": encode_header(config.idcode, "N1") * 3000,
        "configurations": b"".join(changing(rig, "N1")),
        "junk": random.Random(1).randbytes(200_000),
    }[kind]
    found, took_ns, heard, sent = list[Item](), list[int](), list[bytes](), list[bytes]()
    while device.sent < 2_000_000 or len(took_ns) < 100:
        device.turn(encode_config(config), flood)
        if device.sent and len(took_ns) < 100:
            sent.append(rig.send(1))
        began_ns = time.thread_time_ns()
        items = rig.turn()
        if device.sent:
            took_ns.append(time.thread_time_ns() - began_ns)
        found += items
        heard += [i.frame.data for i in items if isinstance(i, PmuFrameIn) and i.pmu == 1 and not i.is_config]
        assert heard == sent[: len(heard)] and len(sent) - len(heard) <= 1, "in the next turn, or the one after it"
    rig.close()
    device.close()
    assert statistics.median(took_ns) < 3 * PARSE_NS
    assert max(Counter(i.pmu for i in found if isinstance(i, PmuFrameIn)).values()) < 3000
    assert kind != "frames" or rig.counts.crowded > 1000


def test_a_control_process_that_stands_still_is_not_waited_for_and_loses_no_configuration(rig: Rig) -> None:
    rig.configure()
    rig.turns(2)
    sent = 0
    while rig.counts.crowded < 50:
        assert sent < 100_000
        for _ in range(50):
            rig.send(0)
        sent += 50
        rig.front.turn()
    slim = rig.streams.slim("S1")
    rig.sock.sendto(encode_config(slim), ("127.0.0.1", rig.ports[1]))
    for _ in range(3):
        rig.front.turn()
    assert rig.front.outlet.is_open
    found: list[Item] = []
    for _ in range(20):
        found += rig.frames.take()
        rig.front.turn()
    changed = [item for item in found if isinstance(item, PmuFrameIn) and item.is_config]
    assert [item.pmu for item in changed] == [1]
    taken = sum(isinstance(item, PmuFrameIn) and not item.is_config for item in found)
    assert taken + rig.counts.crowded == sent


def test_the_end_of_the_pair_is_the_end_of_the_front(rig: Rig) -> None:
    rig.ours.close()
    rig.front._counted_ns = 0
    began_s = time.monotonic()
    rig.front.run()
    assert time.monotonic() - began_s < 50 * ROUND_NS / 1e9


# --- as a process --------------------------------------------------------------------------------------------------


def start(folder: Path, ports: list[int]) -> tuple[subprocess.Popen[str], PairFrames]:
    urls = [f"udp://127.0.0.1:{port}" for port in ports]
    (folder / "site.ini").write_text(Streams(NAMES).ini(urls=urls, extra="\n[platform]\nfifo = no\n"))
    ours, theirs = pair()
    with theirs:
        command = ["-m", "dcon.front", "--ini", str(folder / "site.ini"), "--run-dir", str(folder)]
        process = launch([*command, "--fd", str(theirs.fileno())], pass_fds=(theirs.fileno(),))
    return process, PairFrames(ours, CLOCK)


def test_a_port_in_use_is_told_in_one_line(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = int(taken.getsockname()[1])
        process, frames = start(tmp_path, [port, free_udp_port()])
        assert process.wait(20) == 1
    (failure,) = frames.take()
    frames.close()
    assert isinstance(failure, Failure) and f"udp://127.0.0.1:{port}" in failure.reason and "\n" not in failure.reason


def test_a_front_dies_with_its_parent_even_while_it_is_stopped(tmp_path: Path) -> None:
    """The parent here is a process that is killed; what it leaves must be gone."""
    script = (
        "import sys, time; from pathlib import Path; sys.path.insert(0, sys.argv[1]);"
        "from dcon.link.children import launch;"
        "p = launch(['-c', 'import time; time.sleep(60)']); print(p.pid, flush=True); time.sleep(60)"
    )
    root = str(Path(__file__).parents[2])
    with subprocess.Popen([sys.executable, "-c", script, root], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        child = Path(f"/proc/{pid}/stat")
        assert child.exists()
        os.kill(pid, signal.SIGSTOP)
        parent.kill()
    end_s = time.monotonic() + 5
    while child.exists() and child.read_text().rpartition(")")[2].split()[0] != "Z":
        assert time.monotonic() < end_s
        time.sleep(0.02)


def test_a_killed_front_is_seen_at_once(tmp_path: Path) -> None:
    process, frames = start(tmp_path, [free_udp_port(), free_udp_port()])
    bound: list[Item] = []
    end_s = time.monotonic() + 20
    while len(bound) < 2:
        assert time.monotonic() < end_s
        frames.wait(CLOCK.monotonic_ns() + ROUND_NS)
        bound += frames.take()
    process.kill()
    process.wait(5)
    assert frames.take() == []
    frames.close()
