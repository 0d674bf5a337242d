"""Operators over TCP: orders reach the controller and are answered; nobody else gets anything, nor harms anybody."""

from __future__ import annotations

import json
import random
import re
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from support.live import free_ports
from support.operated import FakePlatform
from support.shipped import ServerProcess, eventually

from dcon.cli import dcon, status_text
from dcon.link import paths
from dcon.link.beats import CAUSES as CAUSE_BITS
from dcon.link.keys import add_key, read_keys
from dcon.link.orders import REPLAYED, SignedOrder, sign
from dcon.link.paths import bind_datagram, prepare
from dcon.server import client as client_side
from dcon.server import operators
from dcon.server.client import Client, order
from dcon.session.codec import Watchdog
from dcon.session.reader import SessionReader
from dcon.watchdog.codec import encode_status
from pmutools.cli.shell import run
from pmutools.errors import SourceError
from pmutools.net.endpoint import Endpoint, Scheme
from pmutools.net.tcp import TcpListener
from pmutools.timebase import NS

pytestmark = pytest.mark.realtime
Ctl = Callable[..., int]


class Site:
    """A server, a platform, and the watchdog's ear."""

    def __init__(self, folder: Path) -> None:
        self.keys = folder / "operators.ini"
        for name, may in (("Ada", ()), ("Ben", ("arm",))):
            add_key(self.keys, name, may)
        self.server = ServerProcess(folder, f"keys = {self.keys}")
        self.run_dir = prepare(self.server.run_dir)
        self.watchdog = bind_datagram(self.run_dir, paths.WATCHDOG)
        self.platform = FakePlatform(self.run_dir, self.keys)
        self.server.listens()
        self.where = Endpoint(Scheme.TCP, "127.0.0.1", self.server.port)
        self.until(lambda: self.status()["state"] is not None and self.status()["log"]["file"])

    def until(self, done: Callable[[], object]) -> None:
        """Asks rarely: a client may ask twenty times a second."""
        eventually(lambda: bool(done()), "it did not happen", 20, lambda: time.sleep(0.1))

    def status(self) -> dict[str, Any]:
        with Client(self.where) as client:
            return client.ask({"ask": "status"})

    def ctl(self, *words: str, who: str | None = "Ada", key: bool = True) -> int:
        arguments = [*words, "--to", f"127.0.0.1:{self.server.port}", "--why", "a test"]
        arguments += ["--who", who] if who else []
        arguments += ["--key", str(self.keys)] if key else []
        return run(dcon(), ["ctl", *arguments])

    def words(self) -> list[tuple[int, bytes]]:
        """Of operators that the watchdog was told: verb and who."""
        found = []
        with suppress(BlockingIOError):
            while True:
                datagram = self.watchdog.recv(100)
                if datagram[:4] == b"DCO1":
                    assert len(datagram) == 44
                    found.append((datagram[4], datagram[8:40].rstrip(b"\0")))
        return found

    def signed(self, who: str = "Ada", **changes: Any) -> str:
        now_ns = time.time_ns()
        order = SignedOrder(who, now_ns, now_ns, "arm")._replace(**changes)
        return sign(order, read_keys(self.keys)[who].key).decode()

    def end(self) -> None:
        self.platform.end()
        if self.server.process.poll() is None:
            self.server.kill()
        self.watchdog.close()


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    made = Site(tmp_path_factory.mktemp("site"))
    yield made
    made.end()


def test_orders_reach_the_controller_with_who_and_why(site: Site, capsys: pytest.CaptureFixture[str]) -> None:
    assert site.ctl("arm") == 0
    assert site.ctl("gain", "12.5") == 0
    assert site.ctl("ack", "frozen", "N1", "--json") == 0
    taken = site.platform.taken[-3:]
    assert [(o.name, o.value, o.text, o.who, o.why) for o in taken] == [
        ("arm", 0.0, "", "Ada", "a test"),
        ("gain", 12.5, "", "Ada", "a test"),
        ("ack", 0.0, "frozen N1", "Ada", "a test"),
    ]
    out, err = capsys.readouterr()
    assert err.startswith("arm: accepted; ") and json.loads(out)["accepted"] == "ack"


def test_what_the_controller_refuses_is_said(site: Site, capsys: pytest.CaptureFixture[str]) -> None:
    assert site.ctl("activate") == 1
    assert capsys.readouterr().err == "dcon: activate refused: not possible in STANDBY\n"


def test_what_the_link_refuses_is_said_and_logged(site: Site, capsys: pytest.CaptureFixture[str]) -> None:
    assert site.ctl("disarm", who="Ben") == 1
    assert capsys.readouterr().err == "dcon: disarm refused: not allowed to this operator\n"
    assert site.platform.taken[-1].name == "link_refused" and site.platform.taken[-1].who == "Ben"


@pytest.mark.parametrize(("verb", "code"), [("estop", 1), ("release", 2), ("reset", 3)])
def test_the_watchdog_hears_of_stops(verb: str, code: int, site: Site) -> None:
    site.words()
    assert site.ctl(verb) == 0
    assert site.words() == [(code, b"Ada")] and site.platform.taken[-1].name == verb


def test_forged_replayed_reordered_and_forbidden_orders(site: Site) -> None:
    early, late = site.signed(name="disarm"), site.signed(name="disarm")
    forged = early.replace('"disarm"', '"reset"')
    site.words()
    with Client(site.where) as client:
        assert client.ask({"signed": forged}) == {"refused": "the signature does not hold"}
        assert site.words() == []
        assert "watchdog" not in client.ask({"signed": late})
        for again in (late, early):
            assert client.ask({"signed": again}) == {"refused": "replayed, or overtaken by a later order"}
        stranger = json.loads(early) | {"who": "Eve"}
        exact = json.dumps(stranger, sort_keys=True, separators=(",", ":"))
        assert client.ask({"signed": exact}) == {"refused": "unknown operator"}
        for time_ns in (time.time_ns() - 6 * 10**9, time.time_ns() + 6 * 10**9):
            answer = client.ask({"signed": site.signed(name="estop", time_ns=time_ns)})
            assert answer["refused"].endswith("is the operator's clock right?")
        assert client.ask({"signed": site.signed("Ben", name="estop")}) == {"refused": "not allowed to this operator"}
        assert client.ask({"signed": "hello"}) == {"refused": "no signed order"}
        assert client.ask({"signed": "x" * 5000}) == {"refused": "longer than 4000 bytes"}
    assert site.words() == []


def test_two_askers_get_their_own_answers(site: Site) -> None:
    with Client(site.where) as one, Client(site.where) as two:
        relayed = site.status()["server"]["orders_relayed"]
        one.send({"signed": site.signed(name="activate")})
        site.until(lambda: site.status()["server"]["orders_relayed"] > relayed)
        two.send({"signed": site.signed(name="arm")})
        assert next(two.answers())["accepted"] == "arm"
        assert next(one.answers()) == {"refused": "not possible in STANDBY"}


def test_status_has_everything(site: Site) -> None:
    status = site.status()
    assert status["controller_connected"] is True
    for key in (
        *("state", "mode", "active", "gain_mw_per_mhz", "delta_f_mhz", "command_mw", "output_v", "probe_mw", "flags"),
        *("instances", "pmus", "watchdog", "surroundings", "line", "timing", "events", "log", "response", "clock_ms"),
    ):
        assert key in status, key
    assert [pmu["name"] for pmu in status["pmus"]] == ["N1", "N2", "S1", "S2"]
    assert len(status["instances"]) == 4 and len(status["events"]) <= 50
    assert status["server"]["failures"] == 0
    assert status["log"]["file"].endswith("session.mcap") and status["log"]["unlogged_ticks"] == 0


SILENT = "relays NOT KNOWN: the watchdog is silent"
CAUSES: list[tuple[Watchdog, list[str] | None, str]] = [
    (Watchdog(1, True), [], "relays closed"),
    (Watchdog(2, True, reason="server"), ["server"], "relays closed; causes: server"),
    (
        Watchdog(3, False, True, True, "control estop_software"),
        ["control", "estop_software"],
        "relays open; tripped; causes: control estop_software",
    ),
    (
        Watchdog(4, True, silent=True),
        None,
        "relays NOT KNOWN: the watchdog is silent; 4.0 s ago it said: relays closed",
    ),
]


def test_what_the_watchdog_says_and_why(site: Site) -> None:
    for watchdog, causes, line in CAUSES:
        site.platform.control.watchdog = watchdog
        site.until(lambda at=watchdog.time_ns: (site.status()["watchdog"] or {}).get("time_ns") == at)
        said = site.status()["watchdog"]
        assert said["source"] == "log" and said["age_ms"] > 1e6
        assert said["causes"] == causes and status_text.relays({**said, "age_ms": 4000.0}) == line


def test_a_controller_that_hangs_is_told_in_the_first_line(site: Site, capsys: pytest.CaptureFixture[str]) -> None:
    """Its socket is open still: what counts is whether ticks come."""
    site.until(lambda: site.status()["controller_connected"])
    assert site.status()["tick_age_ms"] < 500
    assert site.ctl("status", who=None) == 0
    assert "OLD" not in capsys.readouterr().out
    site.platform.hangs.set()
    try:
        site.until(lambda: (site.status()["tick_age_ms"] or 0) > 1100)
        assert site.status()["controller_connected"] is False and site.status()["state"] is not None
        assert site.ctl("status", who=None) == 0
        first, second, third, *_ = capsys.readouterr().out.splitlines()
        assert re.match(r"OLD, by [12]\.\d s: the controller is silent", first)
        assert second.startswith("last known: ") and third.startswith("last known: command ")
        assert status_text.line(site.status()).startswith("OLD, by ")
        watchdog = site.status()["watchdog"]  # None where no test before has let it say anything
        assert watchdog is None or (watchdog["relays_closed"] is None and watchdog["silent"])
    finally:
        site.platform.hangs.clear()
    site.until(lambda: site.status()["controller_connected"])


def test_watch_comes_twice_a_second(site: Site) -> None:
    with Client(site.where) as client:
        client.send({"ask": "watch"})
        answers = client.answers()
        first, second, third = (next(answers) for _ in range(3))
    assert 0.8e9 < third["time_ns"] - first["time_ns"] < 4e9 and second["tick_ns"] >= first["tick_ns"]


@pytest.mark.parametrize(
    ("line", "error"),
    [
        (b"hello\n", "no JSON"),
        (b"[1]\n", "no JSON object"),
        (b"[" * 9000 + b"\n", "no JSON"),
        (b'{"ask": "key"}\n', "ask for one of status, watch, or send a signed order"),
        (b'{"signed": 5}\n', "ask for one of status, watch, or send a signed order"),
        (b"x" * 20_000, "a line is longer than 16384 bytes"),
    ],
)
def test_lines_without_sense_are_answered(line: bytes, error: str, site: Site) -> None:
    with socket.create_connection(("127.0.0.1", site.server.port), 5) as sock:
        sock.sendall(line)
        assert json.loads(sock.makefile().readline()) == {"error": error}


def test_garbage_floods_and_idle_clients_leave_an_operator_served(site: Site) -> None:
    rng = random.Random(2)
    idle = [socket.create_connection(("127.0.0.1", site.server.port), 5) for _ in range(200)]
    for sock in idle[-20:]:
        with suppress(OSError):
            sock.sendall(rng.randbytes(3000))
    with socket.create_connection(("127.0.0.1", site.server.port), 5) as flood:
        flood.sendall(b'{"ask":"status"}\n' * 300)
        assert site.ctl("arm") == 0
        file = flood.makefile()
        said = [json.loads(file.readline()) for _ in range(300)]
    fast = [answer for answer in said if answer.get("error") == "more than 20 lines in a second"]
    assert len(fast) >= 200
    status = site.status()
    assert status["server"]["clients"] <= 32 and status["server"]["turned_away"] >= 150
    for sock in idle:
        sock.close()


class Crowd:
    """Clients without a key, each in a thread that ends with this: they connect and hold, watch, or flood lines."""

    def __init__(self, port: int) -> None:
        self.where = ("127.0.0.1", port)
        self.made = 0
        self._over = threading.Event()
        self._threads = [threading.Thread(target=self._hold), threading.Thread(target=self._flood)]

    def __enter__(self) -> Crowd:
        self._watching = [socket.create_connection(self.where, 5) for _ in range(31)]
        for sock in self._watching:
            sock.sendall(b'{"ask":"watch"}\n')
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join()
        for sock in self._watching:
            sock.close()

    def _hold(self) -> None:
        held: deque[socket.socket] = deque()
        while not self._over.is_set():
            with suppress(OSError):
                held.append(socket.create_connection(self.where, 5))
                self.made += 1
                if self.made % 3 == 0:
                    held[-1].sendall(b'{"ask":"watch"}\n')
            if len(held) > 64:
                held.popleft().close()
        for sock in held:
            sock.close()

    def _flood(self) -> None:
        while not self._over.is_set():
            with suppress(OSError), socket.create_connection(self.where, 5) as sock:
                while not self._over.is_set():
                    sock.sendall(b'{"ask":"key"}\n' * 10)


def test_whoever_crowds_in_every_signed_order_is_answered_and_taken_once(site: Site) -> None:
    before = len(site.platform.taken)
    with Crowd(site.server.port) as crowd:
        operator = read_keys(site.keys)["Ada"]
        answers = [order(site.where, operator, "estop", text=str(n), now_ns=time.time_ns()) for n in range(100)]
        assert crowd.made > 100
    assert [answer.get("accepted") for answer in answers] == ["estop"] * 100
    assert [taken.text for taken in site.platform.taken[before:]] == [str(n) for n in range(100)]
    assert site.status()["server"]["clients"] <= operators.MOST_CLIENTS


def test_a_proven_client_keeps_its_place(site: Site) -> None:
    with Client(site.where) as client:
        assert client.ask({"signed": site.signed()})["accepted"] == "arm"
        with Crowd(site.server.port) as crowd:
            site.until(lambda: crowd.made > 100)
            assert client.ask({"signed": site.signed()})["accepted"] == "arm"


@pytest.mark.parametrize(
    ("answers", "becomes"),
    [
        ([{"error": client_side.CROWDED_OUT}, None, {"accepted": "arm"}], {"accepted": "arm"}),
        ([None, {"refused": REPLAYED}], "unknown"),
        ([{"refused": REPLAYED}], {"refused": REPLAYED}),
        ([None, {"refused": "not possible in STANDBY"}], {"refused": "not possible in STANDBY"}),
        ([{"error": client_side.CROWDED_OUT}] * 3, {"error": client_side.CROWDED_OUT}),
        ([None] * 3, client_side.Ended),
    ],
)
def test_who_loses_its_place_asks_again_with_the_same_bytes(answers: list[dict[str, Any] | None], becomes: Any) -> None:
    heard = []

    def serve() -> None:
        for answer in answers:
            sock, _ = listener.accept()
            with sock, sock.makefile("rwb") as file:
                heard.append(file.readline())
                file.write(b"" if answer is None else json.dumps(answer).encode() + b"\n")

    with socket.create_server(("127.0.0.1", 0)) as listener:
        where = Endpoint(Scheme.TCP, *listener.getsockname())
        server = threading.Thread(target=serve)
        server.start()
        if isinstance(becomes, type):
            with pytest.raises(becomes):
                client_side.ask(where, {"signed": "it"})
        else:
            said = client_side.ask(where, {"signed": "it"})
            assert "may have been taken" in said["unknown"] if becomes == "unknown" else said == becomes
        server.join()
    assert heard == [b'{"signed": "it"}\n'] * len(answers)


def test_a_client_that_does_not_read_is_known_by_what_waits() -> None:
    """Its answers may not pile up for ever, and a status is not sent after one that waits."""
    ours, theirs = socket.socketpair()
    ours.setblocking(False)
    client = operators.Client(ours, "", 1, 0)
    said = 0
    while client.say(bytes(1000)):
        said += 1
        assert client.waiting <= operators.WAITING_BYTES
    assert said > 256 and client.waiting <= operators.WAITING_BYTES + 1000
    theirs.close()
    assert not client.pump()
    ours.close()


def test_the_log_tells_of_orders_and_refusals(site: Site) -> None:
    assert site.ctl("ack", "frozen N1") == 0
    with Client(site.where) as client:
        client.ask({"signed": site.signed("Ben", name="estop")})
    tick_ns = site.status()["tick_ns"]
    site.until(lambda: site.status()["log"]["lag_s"] < (time.time_ns() - tick_ns) / 1e9)
    orders = [order for tick in SessionReader(site.server.log).ticks() for order in tick.orders]
    assert {"Ada"} <= {order.who for order in orders if order.why == "a test"}
    assert "link_refused" in {order.name for order in orders}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("gain",), "gain: write gain MW_PER_MHZ"),
        (("gain", "x"), "gain: 'x' is not a number"),
        (("gain", "-3"), "gain: -3 is out of range; it must be 0 to 1e+06"),
        (("gain", "-0.5e1"), "gain: -0.5e1 is out of range; it must be 0 to 1e+06"),
        (("arm", "5"), "arm takes no value"),
        (("status", "5"), "status takes no value"),
    ],
)
def test_mistakes_are_a_line(words: tuple[str, ...], said: str, site: Site, capsys: pytest.CaptureFixture[str]) -> None:
    assert site.ctl(*words) == 2
    assert capsys.readouterr().err == f"dcon: {said}\n"
    assert site.ctl("gain", "--hwo", "Ada") == 2
    err = capsys.readouterr().err
    assert "No such option '--hwo'" in err and "--who" in err
    assert site.ctl("arm", key=False) == 2 and "give --key FILE" in capsys.readouterr().err
    assert site.ctl("arm", who=None) == 2 and "name one with --who" in capsys.readouterr().err
    assert site.ctl("arm", who="Eve") == 2 and "has no operator 'Eve'; there are Ada, Ben" in capsys.readouterr().err


def test_the_watchdog_s_own_word_counts_and_ages(site: Site) -> None:
    """Whatever the control log says of it: here that the relays are closed."""
    site.platform.control.watchdog = Watchdog(5, True)
    word = paths.Sender(site.run_dir / paths.STATUS)
    word.send(b"nonsense")
    word.send(encode_status(1, time.monotonic_ns() + 3600 * NS, 0, 7, 2, False, 1 << CAUSE_BITS.index("control")))
    said = site.status()["watchdog"]
    assert (said["source"], said["relays_closed"], said["latched"], said["estop"]) == ("watchdog", False, True, False)
    assert said["causes"] == ["control"] and 0 <= said["age_ms"] <= 100 and not said["silent"]
    assert status_text.relays(said).startswith("relays open; tripped; causes: control")
    site.until(lambda: site.status()["watchdog"]["silent"])  # one from the future ages too
    said = site.status()["watchdog"]
    assert said["age_ms"] > 100 and said["source"] == "watchdog"
    assert said["relays_closed"] is said["latched"] is said["estop"] is said["causes"] is None
    assert status_text.relays(said).startswith(SILENT) and status_text.relays(said).endswith(
        "relays open; tripped; causes: control"
    )
    assert site.status()["server"]["malformed"] == 1
    word.close()


TOLD = "the watchdog was told"
RELAYS = "the relays may be closed still; use the emergency stop button"
AFTER = [
    ("reset", (0, 0, 7, 0, True, 0), 0, f"reset: accepted; STATE; {TOLD}, and is not tripped"),
    (
        "reset",
        (0, 0, 7, 2, False, 1 << CAUSE_BITS.index("control")),
        0,
        f"reset: accepted; STATE; {TOLD}, and is still tripped: control; when that is over, order it again",
    ),
    ("reset", (0, 0, 7, 2, False, 0), 0, f"reset: accepted; STATE; {TOLD}, and is still tripped: order it again"),
    (
        "reset",
        (0, 0, 7, 0, False, 1 << CAUSE_BITS.index("stamp")),
        0,
        f"reset: accepted; STATE; {TOLD}, and is not tripped, but not healthy: stamp",
    ),
    ("release", (0, 0, 7, 2, False, 1), 0, f"release: accepted; STATE; {TOLD}"),
    ("estop", (0, 0, 6, 2, False, 0), 0, f"estop: accepted; STATE; {TOLD}"),
    (
        "estop",
        (0, 3, 7, 1, True, 0),
        1,
        f"dcon: estop accepted; STATE, and the controller drives 0 V; {TOLD}, and its relays are closed still: "
        f"{RELAYS}",
    ),
]


def stateless(said: str) -> str:
    """Ticks are made at random: their state says nothing."""
    return re.sub("accepted; [A-Z]+", "accepted; STATE", said)


@contextmanager
def speaking(site: Site, status: tuple[Any, ...]) -> Iterator[None]:
    """As the watchdog does, each 20 ms."""
    over = threading.Event()
    word = paths.Sender(site.run_dir / paths.STATUS)
    counter, relays, *rest = status

    def run() -> None:
        while not over.wait(0.02):
            word.send(encode_status(counter, time.monotonic_ns(), relays, *rest))

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        word.close()


@pytest.mark.parametrize(("verb", "status", "code", "said"), AFTER, ids=[f"{case[0]}-{case[1]}" for case in AFTER])
def test_what_the_watchdog_made_of_it_is_said(
    verb: str, status: tuple[Any, ...], code: int, said: str, site: Site, capsys: pytest.CaptureFixture[str]
) -> None:
    """By its own status, of after it was told."""
    site.words()
    with speaking(site, status):
        assert site.ctl(verb) == code
    assert stateless(capsys.readouterr().err) == f"{said}\n"


def test_a_watchdog_that_is_told_and_says_nothing_and_one_that_is_not_there(
    site: Site, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing opens the relays for the controller: a stop that only it takes is none."""
    accepted = "dcon: estop accepted; STATE, and the controller drives 0 V; the watchdog "
    site.until(lambda: site.status()["watchdog"]["silent"])
    site.words()
    assert site.ctl("estop") == 1
    assert stateless(capsys.readouterr().err) == f"{accepted}was told, and has said nothing since: {RELAYS}\n"
    paths.release(site.watchdog)
    try:
        assert site.ctl("estop", "--json") == 1
        out, err = capsys.readouterr()
        assert stateless(err) == f"{accepted}could not be reached: {RELAYS}\n"
        assert json.loads(out)["accepted"] == "estop" and json.loads(out)["watchdog"] == "could not be reached"
        assert site.ctl("estop", who="Ben") == 1
        said = "refused: not allowed to this operator: nothing was stopped by this; use the emergency stop button"
        assert capsys.readouterr().err == f"dcon: estop {said}\n"
    finally:
        site.watchdog = bind_datagram(site.run_dir, paths.WATCHDOG)


def test_who_reaches_nobody_but_itself_is_refused_and_leaves_the_port_to_a_server(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The system may give a client the very port that it tries, where nobody listens at it."""
    (port,) = free_ports(1)
    itself = partial(socket.create_connection, source_address=("127.0.0.1", port))
    monkeypatch.setattr(client_side.socket, "create_connection", itself)
    with pytest.raises(SourceError, match=r"Connection refused; is dcon server running there\?"):
        Client(Endpoint(Scheme.TCP, "127.0.0.1", port))
    TcpListener("127.0.0.1", port).close()


def test_a_deaf_controller_and_none_at_all(site: Site, capsys: pytest.CaptureFixture[str]) -> None:
    site.platform.deaf = True
    began = time.monotonic()
    site.words()
    stopped = "dcon: estop: the watchdog was told, and opens the relays; the controller "
    with speaking(site, (0, 0, 6, 2, False, 0)):
        assert site.ctl("estop") == 0 and 1.9 < time.monotonic() - began < 6
        said = f"{stopped}may not have taken it: the controller has not answered in 2 s\n"
        assert capsys.readouterr().err == said and site.words() == [(1, b"Ada")]
        site.platform.end()
        assert site.ctl("estop") == 0
        said = f"{stopped}did not take it: the controller cannot be reached\n"
        assert capsys.readouterr().err == said and site.words() == [(1, b"Ada")]
        assert site.ctl("reset") == 1 and site.words() == [(3, b"Ada")]
        said = "dcon: reset refused: the controller cannot be reached; the watchdog was told, and is still tripped"
        assert capsys.readouterr().err == f"{said}: order it again\n"
    site.until(lambda: site.status()["controller_connected"] is False)
    assert site.server.end() == 0
    assert site.ctl("status") == 1
    assert capsys.readouterr().err.endswith("is dcon server running there?\n")
    assert site.ctl("estop") == 1
    said = "is dcon server running there?; take nothing as stopped by this: use the emergency stop button\n"
    assert capsys.readouterr().err.endswith(said)


def test_a_server_that_hangs_is_no_emergency_stop(
    site: Site, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client_side, "PATIENCE_S", 0.3)
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        monkeypatch.setattr(site.server, "port", deaf.getsockname()[1])
        assert site.ctl("estop") == 1 and site.ctl("arm") == 1
    stop, arm = capsys.readouterr().err.splitlines()
    assert stop.endswith("no answer in 0.5 s; take nothing as stopped by this: use the emergency stop button")
    assert arm.endswith("no answer in 0.5 s")
