"""``dcon run`` looks after its processes: here small programs are in their places, and bind what the real ones bind."""

from __future__ import annotations

import errno
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from dcon.household import household, member, predecessor
from dcon.household.household import Household, NotStarted
from dcon.household.member import ENDED, STARTED
from dcon.link.children import Children
from dcon.link.notify import Notifier
from dcon.link.paths import CONTROL, bind_datagram, prepare
from pmutools.errors import SourceError

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform != "linux", reason="dcon run is Linux's"),
]
STAND_IN = """
import os, signal, socket, sys, time
path, kind, log, name, life, code, deaf = sys.argv[1:]
def note(what):
    with open(log, "a") as file: file.write(f"{what} {name} {os.getpid()} {time.monotonic_ns()}\\n")
def end(*_):
    note("term")
    while deaf.isdigit() and open(log).read().count("start server") < int(deaf): time.sleep(0.01)
    sys.exit(int(code))
signal.signal(signal.SIGTERM, signal.SIG_IGN if deaf == "deaf" else end)
signal.signal(signal.SIGINT, lambda *_: note("int"))
if os.path.exists(path): os.unlink(path)
sock = socket.socket(socket.AF_UNIX, int(kind))
sock.bind(path)
if int(kind) == socket.SOCK_SEQPACKET: sock.listen(8)
note("start")
teller = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)  # kept: an exit from within a destructor is none
def tell(what): teller.sendto(what, os.environ["NOTIFY_SOCKET"])
if deaf != "unready": tell(b"READY=1\\nWATCHDOG=1")
end_s = time.monotonic() + float(life)
while (rest_s := end_s - time.monotonic()) > 0:
    if deaf not in ("deaf", "unready"): tell(b"WATCHDOG=1")
    time.sleep(min(0.05, rest_s))
print('{"ticks": 7}')
note("over"); sys.exit(int(code))
"""


class House:
    """Stand-ins that live for so long and end with a code."""

    def __init__(self, folder: Path, *, output: bool = False) -> None:
        self.folder = prepare(folder / "run")
        self.log = folder / "log"
        self.log.write_text("")
        self.lives: dict[str, list[tuple[float, int]]] = {}
        """(seconds, exit code) of each life, by name; the last goes on."""
        self.deaf = ""
        """Who does not end when asked to."""
        self.awaits = 0
        """So many starts of the server the platform awaits before it ends: to hand it the log."""
        self.unready = ""
        """Who never says that it is ready."""
        names = [member.name for member in STARTED if output or member.name != "output"]
        self.household = Household(self.folder, {name: self.command(name) for name in names})

    def command(self, name: str) -> Callable[[], Sequence[str]]:
        member = next(member for member in STARTED if member.name == name)

        def made() -> Sequence[str]:
            lives = self.lives.get(name, [(60.0, 0)])
            life_s, code = lives.pop(0) if len(lives) > 1 else lives[0]
            words = (self.folder / member.inbox, int(member.kind), self.log, name, life_s, code)
            how = "deaf" if name == self.deaf else "unready" if name == self.unready else "-"
            awaits = self.awaits if name == "platform" else 0
            return ["-c", STAND_IN, *map(str, words), str(awaits or how)]

        return made

    def events(self, what: str) -> list[str]:
        """Names, in the order in which it happened to them."""
        return [line.split()[1] for line in self.log.read_text().splitlines() if line.startswith(what + " ")]

    def pids(self) -> list[int]:
        return [int(line.split()[2]) for line in self.log.read_text().splitlines() if line.startswith("start ")]

    def stop_when(self, ready: Callable[[], bool]) -> None:
        def wait() -> None:
            end_s = time.monotonic() + 20
            while not ready() and time.monotonic() < end_s:
                time.sleep(0.01)
            self.household.stop()

        threading.Thread(target=wait, daemon=True).start()

    def is_empty(self) -> bool:
        return not any(alive(pid) for pid in self.pids())


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_they_start_in_order_each_when_the_one_before_is_ready_and_end_in_order(tmp_path: Path) -> None:
    house = House(tmp_path, output=True)
    house.stop_when(lambda: len(house.events("start")) == 4)
    house.household.run()
    assert house.events("start") == [member.name for member in STARTED]
    assert house.events("term") == [member.name for member in ENDED]
    assert house.household.outcome.restarts == {}
    assert house.is_empty()


def test_a_controller_whose_time_is_over_ends_the_run_with_its_code_and_its_words(tmp_path: Path) -> None:
    house = House(tmp_path)
    house.lives["platform"] = [(0.3, 3)]
    outcome = house.household.run()
    assert (outcome.code, outcome.restarts, outcome.said["platform"]) == (3, {}, ['{"ticks": 7}\n'])
    assert house.events("term") == ["server", "watchdog"]
    assert house.is_empty()


@pytest.mark.parametrize("name", ["watchdog", "server", "platform"])
def test_what_dies_is_started_again_and_the_others_stay(name: str, tmp_path: Path) -> None:
    house = House(tmp_path)
    house.lives[name] = [(0.2, 1), (0.2, 1), (60, 0)]
    house.stop_when(lambda: house.events("start").count(name) == 3)
    began_s = time.monotonic()
    outcome = house.household.run()
    assert outcome.restarts == {name: 2}
    assert sorted(house.events("start")) == sorted([*["watchdog", "server", "platform"], name, name])
    assert time.monotonic() - began_s > 0.25 + 0.5  # later and later
    assert house.is_empty()


def test_a_controller_that_was_set_up_wrongly_is_not_started_again(tmp_path: Path) -> None:
    house = House(tmp_path)
    house.lives["platform"] = [(0.3, 2)]
    assert house.household.run().code == 2
    assert house.events("start") == ["watchdog", "server", "platform"]


def test_one_that_has_run_is_started_again_whatever_it_ends_with(tmp_path: Path) -> None:
    """What a stream says meanwhile is no mistake in the initialisation file."""
    house = House(tmp_path)
    house.lives["platform"] = [(0.3, 1), (0.3, 2)]
    house.stop_when(lambda: house.events("start").count("platform") >= 3)
    assert house.household.run().restarts == {"platform": 2}


@pytest.mark.parametrize("call", ["fork", "pidfd"])
def test_a_system_without_room_for_a_process_is_asked_again_later(
    call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    house = House(tmp_path)
    house.lives["server"] = [(0.2, 1), (60, 0)]
    refused: list[int] = []
    where, name = {"fork": (member, "launch"), "pidfd": (os, "pidfd_open")}[call]
    right = getattr(where, name)

    def scarce(*given: Any, **named: Any) -> Any:
        if house.events("start").count("platform") and len(refused) < 2:
            refused.append(1)
            raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        return right(*given, **named)

    monkeypatch.setattr(where, name, scarce)
    house.stop_when(lambda: len(refused) == 2 and house.events("start").count("server") >= 2)
    outcome = house.household.run()
    assert outcome.restarts == {"server": 3} and len(refused) == 2
    assert "the server process could not be started, Resource temporarily unavailable" in caplog.text
    assert house.is_empty()


def test_one_for_which_there_is_no_room_at_the_start_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*given: Any, **named: Any) -> Any:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    house = House(tmp_path)
    monkeypatch.setattr(os, "pidfd_open", full)
    with pytest.raises(SourceError, match=r"^the watchdog process could not be started, Too many open files$"):
        house.household.run()
    assert house.is_empty()


@pytest.mark.parametrize(
    ("ending", "words", "is_told"),
    [
        ("raise SystemExit(1)", "exit code 1", True),
        ("raise SystemExit(2)", "exit code 2", True),
        ("raise SystemExit(0)", "exit code 0", False),
        ("import os; os.kill(os.getpid(), 9)", "by SIGKILL", False),
    ],
)
def test_one_that_cannot_start_ends_the_others_in_one_line(
    ending: str, words: str, is_told: bool, tmp_path: Path
) -> None:
    """Its own, where it had one."""
    house = House(tmp_path)
    house.household._commands["server"] = lambda: ["-c", ending]  # type: ignore[index]
    with pytest.raises(NotStarted, match=rf"^the server process could not start, {words}$") as caught:
        house.household.run()
    assert caught.value.is_told is is_told
    assert house.events("start") == ["watchdog"] and house.is_empty()


@pytest.mark.parametrize("name", ["watchdog", "server", "output", "platform"])
def test_one_that_ends_before_it_was_ever_ready_ends_the_whole(name: str, tmp_path: Path) -> None:
    """A socket is not enough: what fails may fail after that."""
    house = House(tmp_path, output=True)
    house.unready = name
    house.lives[name] = [(0.3, 1)]
    with pytest.raises(SourceError, match=rf"^the {name} process could not start, exit code 1$"):
        house.household.run()
    assert house.events("start").count(name) == 1 and house.is_empty()


def test_one_that_is_never_ready_is_not_waited_for_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(household, "START_S", 0.5)
    house = House(tmp_path)
    house.unready = "server"
    with pytest.raises(SourceError, match=r"^the server process is not ready after 0.5 s$"):
        house.household.run()
    assert house.events("start") == ["watchdog", "server"] and house.is_empty()


@pytest.mark.parametrize("name", ["watchdog", "server", "platform"])
def test_what_hangs_is_killed_and_started_again(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(household, "HUNG_S", 1.0)
    house = House(tmp_path)
    stopped: list[int] = []

    def again() -> bool:
        lines = [line.split() for line in house.log.read_text().splitlines() if line.startswith("start ")]
        if not stopped and len(lines) == 3:
            stopped.extend(int(pid) for _, who, pid, _ in lines if who == name)
            os.kill(stopped[0], signal.SIGSTOP)
        return len(lines) == 4

    house.stop_when(again)
    outcome = house.household.run()
    assert outcome.restarts == {name: 1}
    assert f"the {name} process has not beaten for 1 s, and is killed" in caplog.text
    assert f"the {name} process has ended, by SIGKILL; started again in 0.25 s" in caplog.text
    assert house.is_empty()


HELD = r"control.in: another process that is running has it; end that, or take another run folder$"


def test_a_second_run_in_one_folder_is_refused_at_once_and_disturbs_nobody(tmp_path: Path) -> None:
    house = House(tmp_path)
    began_s = time.monotonic()
    with (
        bind_datagram(house.folder, CONTROL),
        bind_datagram(house.folder, "run.platform"),
        pytest.raises(SourceError, match=HELD),
    ):
        house.household.run()
    assert house.events("start") == [] and time.monotonic() - began_s < 5


def test_places_that_stay_taken_are_not_waited_for_without_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(predecessor, "PLACES_S", 0.3)
    house = House(tmp_path)
    with bind_datagram(house.folder, CONTROL), pytest.raises(SourceError, match=HELD):
        house.household.run()
    assert house.events("start") == [] and caplog.text.count("waiting for its end, 0.3 s at most") == 1


def test_a_run_waits_for_the_processes_of_one_that_was_killed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    house = House(tmp_path)
    left = bind_datagram(house.folder, CONTROL)
    threading.Timer(0.5, left.close).start()
    began_s = time.monotonic()
    house.stop_when(lambda: len(house.events("start")) == 3)
    house.household.run()
    first_s = float(house.log.read_text().splitlines()[0].split()[3]) / 1e9
    assert first_s - began_s > 0.5
    assert caplog.text.count("another process that is running has it; waiting for its end, 10 s at most") == 1
    assert house.is_empty()


def test_a_stop_while_it_waits_starts_nobody(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    house = House(tmp_path)
    with bind_datagram(house.folder, CONTROL):
        house.stop_when(lambda: "waiting" in caplog.text)
        house.household.run()
    assert house.events("start") == []


def test_one_that_does_not_end_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    house = House(tmp_path)
    house.deaf = "server"
    brief = tuple(member._replace(patience_s=0.3) for member in STARTED)
    monkeypatch.setattr(household, "STARTED", brief)
    house.stop_when(lambda: len(house.events("start")) == 3)
    house.household.run()
    assert house.events("term") == ["watchdog"] or house.events("term") == ["platform", "watchdog"]
    assert house.is_empty()


@pytest.mark.parametrize("deaths", [1, 4])
def test_a_server_that_has_died_is_started_again_while_the_controller_ends(deaths: int, tmp_path: Path) -> None:
    """At once, however often it has died before: the fourth time it would be put off for 2 s."""
    house = House(tmp_path)
    house.lives["server"] = [(0.2, 1)] * deaths + [(60, 0)]
    house.awaits = deaths + 1
    house.stop_when(lambda: house.events("over").count("server") == deaths and "platform" in house.events("start"))
    began_s = time.monotonic()
    assert house.household.run().restarts == {"server": deaths}
    assert house.events("start").count("server") == deaths + 1
    assert house.events("term") == ["platform", "server", "watchdog"]
    assert time.monotonic() - began_s < 9  # the platform is killed after 10 s
    assert house.is_empty()


def test_who_holds_the_standard_output_of_one_that_has_ended_holds_nobody_up(tmp_path: Path) -> None:
    """And what it says may be longer than a pipe is."""
    house = House(tmp_path)
    heir = "import subprocess; left = subprocess.Popen(['sleep', '60']); print(left.pid, 100_000 * 'x')"
    house.household._commands["platform"] = lambda: ["-c", heir]  # type: ignore[index]
    began_s = time.monotonic()
    (said,) = house.household.run().said["platform"]
    pid, _, rest = said.partition(" ")
    os.kill(int(pid), signal.SIGKILL)
    assert rest == 100_000 * "x" + "\n" and time.monotonic() - began_s < 30
    assert house.is_empty()


def test_a_child_of_the_controller_has_no_part_in_its_standard_output(tmp_path: Path) -> None:
    children, said = Children(), tmp_path / "said"
    try:
        children.start("front", ("-c", f"import os; open({str(said)!r}, 'w').write(os.readlink('/proc/self/fd/1'))"))
        assert children.processes["front"].wait(20) == 0
    finally:
        children.close()
    assert said.read_text() == os.devnull


def test_a_stop_while_they_start_ends_what_has_started(tmp_path: Path) -> None:
    house = House(tmp_path)
    house.household._commands["server"] = lambda: ["-c", "import time; time.sleep(60)"]  # type: ignore[index]
    house.stop_when(lambda: house.events("start") == ["watchdog"])
    house.household.run()
    assert house.events("term") == ["watchdog"] and house.is_empty()


def test_systemd_is_told(tmp_path: Path) -> None:
    house = House(tmp_path)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as service:
        service.bind(str(tmp_path / "notify"))
        service.settimeout(5)
        house.household._notifier = Notifier({"NOTIFY_SOCKET": str(tmp_path / "notify")})
        house.stop_when(lambda: bool(select.select([service], [], [], 0)[0]))
        house.household.run()
        assert service.recv(100) == b"READY=1\nSTATUS=running"
        rest = []
        service.setblocking(False)
        while True:
            try:
                rest.append(service.recv(100))
            except BlockingIOError:
                break
    at = rest.index(b"STOPPING=1\nSTATUS=ending")
    assert set(rest[:at]) <= {b"WATCHDOG=1\nSTATUS=running"} and set(rest[at + 1 :]) == {b"WATCHDOG=1"}


ALONE = """
import sys
sys.path[:0] = sys.argv[2:]
from pathlib import Path
from test_household import House
house = House(Path(sys.argv[1]), output=True)
with house.household.stopped_by_signals():
    house.household.run()
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_nobody_is_left_however_it_ends(number: signal.Signals, tmp_path: Path) -> None:
    """Ctrl-C at a terminal goes to the whole group: it must not reach the others past their order."""
    here = Path(__file__).parent
    paths = [str(tmp_path), str(here), str(here.parents[1]), str(here.parent)]
    with subprocess.Popen([sys.executable, "-c", ALONE, *paths], start_new_session=True) as run:
        log = tmp_path / "log"
        end_s = time.monotonic() + 20
        while not log.exists() or log.read_text().count("start ") < 4:
            assert time.monotonic() < end_s and run.poll() is None
            time.sleep(0.02)
        os.killpg(run.pid, number)
        run.wait(20)
    pids = [int(line.split()[2]) for line in log.read_text().splitlines() if line.startswith("start ")]
    end_s = time.monotonic() + 5
    while any(map(alive, pids)):
        assert time.monotonic() < end_s
        time.sleep(0.02)
    ended = [line.split()[1] for line in log.read_text().splitlines() if line.startswith("term ")]
    order = [member.name for member in ENDED]
    assert ended == order if number != signal.SIGKILL else sorted(ended) == sorted(order)
    assert "int " not in log.read_text()
