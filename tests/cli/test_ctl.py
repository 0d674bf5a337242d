"""``pmu ctl``: what it says, its exit codes, and mistakes found before anything is connected."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.commands import Pmu
from support.controlled import FakePlayer, player_status, whole_json

from pmutools.cli.columns import fit, layout, number
from pmutools.cli.status_text import COLUMNS, progress_line, status_lines
from pmutools.clock import SystemClock
from pmutools.net.reactor import Reactor
from pmutools.tools.player.control_address import parse_control_address
from pmutools.tools.player.control_server import ControlServer

pytestmark = pytest.mark.realtime


@pytest.fixture(autouse=True)
def in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")


@pytest.fixture
def player() -> Iterator[FakePlayer]:
    """One that is controlled at ``player.sock``, from a thread of its own."""
    player, reactor, ending = FakePlayer(), Reactor(SystemClock()), threading.Event()
    server = ControlServer(parse_control_address("./player.sock"), player, reactor, lambda text: None)

    def run() -> None:
        while not ending.is_set() and len(player.done) < 50:
            reactor.run(5_000_000)
        server.close()
        reactor.close()

    thread = threading.Thread(target=run)
    thread.start()
    yield player
    ending.set()
    thread.join()


@pytest.mark.parametrize(
    ("words", "done"),
    [
        (["pause"], "pause"),
        (["step", "2"], "step 2"),
        (["seek", "1.5"], "seek 1.5"),
        (["loop", "1", "2.5"], "loop 1 2.5"),
        (["loop", "off"], "loop off"),
        (["fault", "N1", "loss=5%"], "fault N1"),
        (["fault", "SHELBY PMU", "delay=normal(16,2) corr=30%"], "fault SHELBY PMU"),
        (["disable", "SHELBY PMU"], "disable SHELBY PMU"),
    ],
)
def test_it_is_done_in_silence(pmu: Pmu, player: FakePlayer, words: list[str], done: str) -> None:
    assert pmu("ctl", "player.sock", *words) == (0, "", "")
    assert player.done == [done]


def test_json_gives_the_answer(pmu: Pmu, player: FakePlayer) -> None:
    assert pmu("ctl", "player.sock", "pause", "--json").json == {"id": 1, "ok": True}
    assert pmu("ctl", "player.sock", "stats", "--json").json == whole_json(player.now)


def test_stats_is_a_table(pmu: Pmu, player: FakePlayer) -> None:
    result = pmu("ctl", "player.sock", "stats")
    assert result.code == 0
    assert result.out.splitlines() == status_lines(player.now, 120)


def test_watching_ends_with_the_player(pmu: Pmu, player: FakePlayer) -> None:
    timer = threading.Timer(0.5, lambda: player.done.extend(["x"] * 50))
    timer.start()
    result = pmu("ctl", "player.sock", "stats", "--watch", "0.1", "--json")
    assert result.code == 0
    assert len(result.lines) >= 2


def test_a_refusal_is_one_line(pmu: Pmu, player: FakePlayer) -> None:
    result = pmu("ctl", "player.sock", "enable", "N9")
    assert (result.code, result.out) == (1, "")
    assert result.complaint == "pmu: player.sock: enable N9: no such stream; there are N1, N2, S1, S2, E1, E2, W1, W2"


MISTAKES = [
    ("ctl", 2, "Missing argument 'TARGET'"),
    ("ctl x.sock", 2, "Missing argument 'VERB"),
    ("ctl x.sock paws", 2, "did you mean 'pause'?"),
    ("ctl x.sock speed fast", 2, "speed: 'fast' is not a number; write 'speed FACTOR'"),
    ("ctl x.sock loop 5 1", 2, "loop: 5 1 runs backwards"),
    ("ctl x.sock seek -1.5", 2, "seek: -1.5 is out of range; it must be at least 0"),
    ("ctl x.sock fault N1 loss=200", 2, "loss: 200 is not a probability"),
    ("ctl x.sock pause --watch 1", 2, "--watch goes with stats"),
    ("ctl x.sock stats --watch 0", 2, "'--watch': 0 is out of range"),
    ("ctl x.sock watch", 2, "write 'stats --watch S'"),
    ("ctl 127.0.0.1:x pause", 2, "'x' is no port"),
    ("ctl x.sock pause", 1, "x.sock: no such socket; is the player running, with --control and this path?"),
    ("ctl 127.0.0.1:9 pause", 1, "127.0.0.1:9: nobody listens; is the player running, with --control?"),
    ("ctl no.such.host.invalid:9 pause", 1, "unknown host"),
]


@pytest.mark.parametrize(("line", "code", "why"), MISTAKES, ids=[line for line, _, _ in MISTAKES])
def test_mistakes(pmu: Pmu, line: str, code: int, why: str) -> None:
    result = pmu(*line.split())
    assert (result.code, result.out) == (code, "")
    assert why in result.complaint


# --- the text


def test_a_line_of_progress() -> None:
    line = progress_line(player_status())
    assert line == "12.5/30.0 s  loop 2  ×1.0  480 frames/s  late p50 21 us p99 180 us  2 misses"


def test_the_table() -> None:
    lines = status_lines(player_status(3), 110)
    assert lines[0] == "PLAYING  12.500 / 30.000 s  loop 2, between 5 and 20 s"
    assert " ".join(lines[3].split()[:8]) == "stream id on to sent lost drop disab"
    assert " ".join(lines[3].split()[8:]) == "skip fail p50us p99us maxus miss faults"
    assert lines[5].endswith("loss=gemodel(1%,20%)  delay=normal(16,2) corr=30%")
    assert lines[6].split()[:3] == ["S1", "103", "OFF"]


@pytest.mark.parametrize(
    ("value", "width", "text"),
    [
        (0, 4, "0"),
        (9999, 4, "9999"),
        (12345, 4, "12k"),
        (123456, 5, "123k"),
        (1.5e9, 5, "1500M"),
        (float("nan"), 5, "-"),
    ],
)
def test_numbers_fit(value: float, width: int, text: str) -> None:
    assert number(value, width) == text


@pytest.mark.parametrize("width", [80, 96, 97, 120, 200, 300])
def test_rows_are_as_wide_as_the_table(width: int) -> None:
    table = layout(COLUMNS, width)
    for stream in player_status(4).streams:
        assert len(table.row(stream)) == len(table.header()) == width


def test_wide_characters_are_two_cells() -> None:
    assert fit("東京PMU", 6) == "東京P…"
    assert fit("東京", 6) == "東京  "
