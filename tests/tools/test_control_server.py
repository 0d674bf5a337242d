"""Control over sockets: paths and ports, who is turned away, and that the loop is never held up."""

from __future__ import annotations

import json
import os
import socket
import stat
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from support.controlled import FakePlayer, player_status, whole_json
from support.peers import free_port

from pmutools.clock import SystemClock
from pmutools.errors import PmuError, SettingsError, SourceError
from pmutools.net.reactor import Reactor
from pmutools.timebase import NS
from pmutools.tools.player import control_server
from pmutools.tools.player.control_address import ControlAddress, parse_control_address
from pmutools.tools.player.control_client import ControlClient, Refused
from pmutools.tools.player.control_server import MAX_CLIENTS, ControlServer
from pmutools.tools.player.status import PlayerStatus

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(not hasattr(socket, "AF_UNIX"), reason="needs unix sockets"),
]
MS = 1_000_000


class Stage:
    """A server on a reactor that runs when told to."""

    def __init__(self, address: str, streams: int = 8) -> None:
        self.player = FakePlayer(streams)
        self.reactor = Reactor(SystemClock())
        self.told: list[str] = []
        self.server = ControlServer(parse_control_address(address), self.player, self.reactor, self.told.append)

    def run_until(self, done: Callable[[], bool], limit_s: float = 10) -> None:
        end = time.monotonic() + limit_s
        while not done():
            assert time.monotonic() < end, "never happened"
            self.reactor.run(5 * MS)

    def run_for(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.reactor.run(5 * MS)

    def connect(self) -> Connection:
        address = self.server.address
        if address.path:
            sock = socket.socket(socket.AF_UNIX)
            sock.connect(address.path)
        else:
            sock = socket.create_connection((address.host, address.port))
        return Connection(sock, self)


class Connection:
    def __init__(self, sock: socket.socket, stage: Stage) -> None:
        self.sock, self.stage, self.data, self.gone = sock, stage, b"", False
        sock.setblocking(False)

    def send(self, data: bytes) -> None:
        self.sock.sendall(data)

    def line(self) -> Any:
        self.stage.run_until(lambda: self._read() or b"\n" in self.data)
        line, _, self.data = self.data.partition(b"\n")
        return json.loads(line)

    def closed(self) -> bool:
        self._read()
        return self.gone

    def _read(self) -> bool:
        try:
            data = self.sock.recv(1 << 20)
        except BlockingIOError:
            return False
        except ConnectionError:
            data = b""
        self.gone |= not data
        self.data += data
        return False


@contextmanager
def stage(address: str | Path, streams: int = 8) -> Iterator[Stage]:
    made = Stage(str(address), streams)
    try:
        yield made
    finally:
        made.server.close()
        made.reactor.close()


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return Path("player.sock").absolute() if len(str(tmp_path)) < 80 else Path("player.sock")


# --- addresses


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("player.sock", ControlAddress("player.sock")),
        ("./a:b", ControlAddress("./a:b")),
        ("/run/x", ControlAddress("/run/x")),
        ("127.0.0.1:7777", ControlAddress(host="127.0.0.1", port=7777)),
        ("localhost:0", ControlAddress(host="localhost", port=0)),
        ("[::1]:7777", ControlAddress(host="::1", port=7777)),
    ],
)
def test_addresses(text: str, wanted: ControlAddress) -> None:
    assert parse_control_address(text) == wanted
    assert str(wanted) == text


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "no address; write a path"),
        ("127.0.0.1:", "neither a path nor HOST:PORT"),
        ("127.0.0.1:x", "'x' is no port"),
        ("127.0.0.1:65536", "ports are 0..65535"),
        ("::1:7777", "IPv6 addresses stand in brackets"),
        ("tcp://127.0.0.1:1", "control has no URL"),
        ("/tmp/" + "x" * 200, "205 bytes are too long for a socket's path, 107 at most"),
        ("a\0b", "no NUL"),
    ],
)
def test_addresses_that_are_none(text: str, why: str) -> None:
    with pytest.raises(SettingsError, match=why):
        parse_control_address(text)


def test_loopback() -> None:
    known = {
        "x.sock": True,
        "127.0.0.9:1": True,
        "[::1]:1": True,
        "localhost:1": True,
        "0.0.0.0:1": False,
        "h:1": False,
    }
    assert {text: parse_control_address(text).loopback for text in known} == known


# --- the socket's path


def test_only_the_owner_may_use_the_socket_and_it_goes_with_the_player(path: Path) -> None:
    umask = os.umask(0o022)
    try:
        with stage(path):
            assert stat.S_IMODE(path.stat().st_mode) == 0o600
            assert os.umask(0o022) == 0o022
    finally:
        os.umask(umask)
    assert not path.exists()


def test_a_dead_players_socket_is_replaced(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    with stage(path) as on:
        assert on.connect().line()["protocol"] == 1


def test_a_living_players_socket_is_not(path: Path) -> None:
    with stage(path) as on:
        with pytest.raises(SourceError, match="another player is controlled there; stop it, or choose another path"):
            Stage(str(path))
        assert on.connect().line()["protocol"] == 1


def test_a_successors_socket_stays(path: Path) -> None:
    with stage(path):
        path.unlink()
        other = Stage(str(path))
    assert path.exists()
    other.server.close()
    assert not path.exists()


def test_what_is_no_socket_is_left_alone(path: Path) -> None:
    path.write_text("precious")
    with pytest.raises(SettingsError, match="a file is there that is no socket"):
        Stage(str(path))
    assert path.read_text() == "precious"


def test_a_folder_that_is_not_there() -> None:
    with pytest.raises(SourceError, match=r"--control nodir/x\.sock: no such folder"):
        Stage("nodir/x.sock")


# --- ports


@pytest.mark.parametrize("host", ["127.0.0.1", "[::1]"])
def test_a_port(host: str) -> None:
    with stage(f"{host}:0") as on:
        client = on.connect()
        assert client.line() == {"hello": "pmutools player", "protocol": 1}
        client.send(b"pause\n")
        assert client.line() == {"ok": True}
        assert on.player.done == ["pause"]
        assert [line.rpartition(": ")[2] for line in on.told] == ["pause"]


def test_a_port_that_is_taken() -> None:
    with stage("127.0.0.1:0") as on, pytest.raises(SourceError, match="already in use; stop the other program"):
        Stage(str(on.server.address))


def test_a_port_for_all_is_warned_of() -> None:
    with stage("0.0.0.0:0") as on:
        assert "whoever reaches this port controls the player" in on.told[0]


# --- talk


def test_a_request_and_the_end_of_input_in_one(path: Path) -> None:
    """As netcat sends it: all of its input, then the end; the answers come nevertheless."""
    with stage(path) as on:
        client = on.connect()
        client.send(b"pause\nstats\nresume")
        client.sock.shutdown(socket.SHUT_WR)
        assert client.line()["hello"]
        assert client.line() == {"ok": True}
        assert client.line()["result"]["state"] == "paused"
        assert client.line() == {"ok": True}
        on.run_until(client.closed)
    assert on.player.done == ["pause", "resume"]
    assert on.told == ["control client: pause", "control client: resume"]


def test_watching(path: Path) -> None:
    with stage(path) as on:
        client = on.connect()
        client.line()
        client.send(b'{"do": "watch", "every_s": 30}\n')
        assert client.line() == {"ok": True}
        assert client.line()["event"] == "status"
        client.send(b'{"do": "watch", "every_s": 0.1}\n')
        assert client.line() == {"ok": True}
        began = time.monotonic()
        states = [client.line() for _ in range(4)]
        assert 0.25 < time.monotonic() - began < 3
        assert {state["event"] for state in states} == {"status"}
        client.sock.close()
        on.run_until(lambda: not on.server._clients)


def test_the_end_of_the_player_is_told(path: Path) -> None:
    with stage(path) as on:
        client = on.connect()
        client.line()
        on.server.close()
        assert client.line() == {"event": "bye", "reason": "the player has ended"}


def test_too_many_clients_are_turned_away(path: Path) -> None:
    with stage(path) as on:
        clients = [on.connect() for _ in range(MAX_CLIENTS)]
        for client in clients:
            client.line()
        assert on.connect().line() == {"event": "bye", "reason": f"{MAX_CLIENTS} clients are served already; close one"}
        clients[3].sock.close()
        on.run_until(lambda: len(on.server._clients) < MAX_CLIENTS)
        assert "hello" in on.connect().line()


def test_garbage_is_sent_away(path: Path) -> None:
    with stage(path) as on:
        client = on.connect()
        client.send(os.urandom(1000).replace(b"\n", b"") + b"\n" + b"x\n" * 30)
        on.run_until(client.closed)
        assert json.loads(client.data.splitlines()[-1])["event"] == "bye"
        assert "lines in a row said nothing" in on.told[-1]


def test_a_flood_holds_up_nobody(path: Path) -> None:
    with stage(path) as on:
        flood, other = on.connect(), on.connect()
        other.line()
        with pytest.raises((BlockingIOError, BrokenPipeError, ConnectionError)):
            while True:
                flood.send(b"pause\n" * 1000)
        other.send(b"resume\n")
        assert other.line() == {"ok": True}
        on.run_until(flood.closed)
        assert "ask less often" in on.told[-1]


def test_who_takes_nothing_is_sent_away(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control_server, "STALL_NS", NS // 2)
    with stage(path, 2000) as on:
        slow, other = on.connect(), on.connect()
        other.line()
        slow.send(b"stats\n" * 3)
        on.run_until(lambda: any("took nothing" in line for line in on.told))
        other.send(b"pause\n")
        assert other.line() == {"ok": True}
        assert on.server._clients


def test_a_handler_takes_little_time_at_two_thousand_streams(path: Path) -> None:
    """The player has about a millisecond to spare. The median is judged: the machine is not ours alone."""
    with stage(path, 2000) as on:
        clients = [on.connect() for _ in range(4)]
        for client in clients:
            client.line()
            client.send(b"stats\n")
        took = []
        end = time.monotonic() + 20
        while not all(client.data.endswith(b"]}}\n") for client in clients):
            assert time.monotonic() < end
            time.sleep(0.001)
            began = time.perf_counter()
            on.reactor.run(0)
            took.append(time.perf_counter() - began)
            for client in clients:
                client._read()
        busy = sorted(seconds for seconds in took if seconds > 5e-5)
        assert len(busy) > 100
        assert busy[len(busy) // 2] < 1e-3


# --- the client


@contextmanager
def running(address: str | Path, streams: int = 8) -> Iterator[Stage]:
    """A player in a thread of its own."""
    made, ending = Stage(str(address), streams), threading.Event()

    def run() -> None:
        while not ending.is_set():
            made.reactor.run(5 * MS)
        made.server.close()
        made.reactor.close()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield made
    finally:
        ending.set()
        thread.join()


@pytest.mark.parametrize("streams", [0, 8, 2000])
def test_a_state_comes_through_whole(path: Path, streams: int) -> None:
    with running(path, streams), ControlClient(parse_control_address(str(path))) as client:
        assert PlayerStatus.from_json(client.ask("stats")["result"]) == player_status(streams)
        assert client.ask("pause")["ok"] is True
        with pytest.raises(Refused, match="disable N9: no such stream; there are"):
            client.ask("disable N9")


def test_states_until_the_end(path: Path) -> None:
    with running(path) as on, ControlClient(parse_control_address(str(path))) as client:
        states = []
        for state in client.states(0.1):
            states.append(state)
            if len(states) == 3:
                on.reactor.call_in(0, lambda: on.server.close())
        assert len(states) == 3


@contextmanager
def answering(data: bytes) -> Iterator[ControlAddress]:
    """Something else that listens, and says ``data`` to whoever comes."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            sock, _ = listener.accept()
            with sock:
                sock.sendall(data)
                sock.recv(100)

        thread = threading.Thread(target=serve)
        thread.start()
        yield ControlAddress(host="127.0.0.1", port=listener.getsockname()[1])
        thread.join()


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "no answer within 0.2 s"),
        (b"SSH-2.0-OpenSSH\r\n", "not a player's control"),
        (b"[" * 5000 + b"\n", "not a player's control"),
        (b'{"hello": "x", "protocol": 99}\n', "speaks protocol 99, not 1"),
        (b'{"event": "bye", "reason": "full"}\n', "turned away: full"),
    ],
)
def test_others_that_answer(data: bytes, why: str) -> None:
    with answering(data) as address, pytest.raises(SourceError, match=why):
        ControlClient(address, timeout_s=0.2)


def test_nobody_there(path: Path) -> None:
    with pytest.raises(SourceError, match="no such socket; is the player running"):
        ControlClient(ControlAddress(str(path)))
    with pytest.raises(SourceError, match="nobody listens; is the player running"):
        ControlClient(ControlAddress(host="127.0.0.1", port=free_port()))
    path.write_text("")
    with pytest.raises(PmuError, match=r"nobody listens|not a socket"):
        ControlClient(ControlAddress(str(path)))


@pytest.mark.parametrize("result", [None, {}, {"streams": 5}, whole_json(player_status()) | {"state": "dancing"}])
def test_a_state_that_is_none(result: Any) -> None:
    with pytest.raises(SourceError, match="is not understood"):
        PlayerStatus.from_json(result)
