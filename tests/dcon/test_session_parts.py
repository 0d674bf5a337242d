"""A session in several files: rotation by time and size, a full disk, which parts belong together."""

from __future__ import annotations

import json
import os
import shutil
import stat
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from support.disk import full_disk
from support.sessions import (
    CONFIGS,
    FLAGS,
    HEAD,
    INI,
    INSTANCES,
    METADATA,
    PERIOD_NS,
    PMUS,
    T0,
    Tick,
    bits,
    log_configs,
    log_tick,
    random_ticks,
    write_session,
)

from dcon.cli import dcon
from dcon.export.export import export
from dcon.session.head import Head
from dcon.session.parts import part_path
from dcon.session.reader import LoggedTick, SessionReader
from dcon.session.rolling import RETRY_NS, RollingWriter
from dcon.sim.plan import Plan
from dcon.sim.simulate import simulate
from pmutools.cli.shell import run
from pmutools.errors import SourceError

Capsys = pytest.CaptureFixture[str]
TICKS = random_ticks(400)


def rolling(path: Path, **limits: Any) -> RollingWriter:
    log = RollingWriter(path, HEAD, **limits)
    log_configs(log, CONFIGS)
    return log


def written(path: Path, ticks: list[Tick] = TICKS, **limits: Any) -> RollingWriter:
    with rolling(path, **limits) as log:
        for tick in ticks:
            log_tick(log, tick.record, tick.frames, tick.orders, timing=tick.timing, pdci=tick.pdci)
    return log


def strip(tick: LoggedTick | Tick) -> object:
    return bits((tick.record, tick.frames, tick.orders, tick.timing, tick.pdci))


def stamps(reader: SessionReader) -> list[int]:
    return [tick.record.tick_ns for tick in reader.ticks()]


@pytest.mark.parametrize("limits", [{"max_minutes": 1 / 40}, {"max_mb": 0.1}], ids=["time", "size"])
def test_parts_are_one_session_bit_for_bit(limits: dict[str, float], tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    log = written(path, **limits)
    assert log.parts == [part_path(path, number) for number in range(1, len(log.parts) + 1)]
    assert log.parts[1].name == "s.part2.mcap" and len(log.parts) > 2
    for reader in (SessionReader(path), SessionReader(log.parts), SessionReader(log.parts[::-1])):
        back = list(reader.ticks())
        assert [strip(tick) for tick in back] == [strip(tick) for tick in TICKS]
        assert not any(tick.after_loss for tick in back) and not reader.damage


def test_a_part_is_whole_in_itself(tmp_path: Path) -> None:
    log = written(tmp_path / "s.mcap", max_minutes=1 / 40)
    counts = []
    for number, path in enumerate(log.parts, 1):
        reader = SessionReader([path])
        assert (reader.pmus, reader.instances, reader.flags, reader.ini_text) == (PMUS, INSTANCES, FLAGS, INI)
        assert reader.configs == CONFIGS and METADATA.items() <= reader.metadata.items()
        assert reader.metadata["part"] == str(number)
        assert reader.metadata.get("continues") == (log.parts[number - 2].name if number > 1 else None)
        counts.append(len(stamps(reader)))
        assert not reader.damage
    assert counts == [400, 91, 91, 91, 36]  # 1.5 s each; the first brings the others


def test_the_newest_configuration_goes_into_every_part(tmp_path: Path) -> None:
    with rolling(tmp_path / "s.mcap", max_minutes=1 / 40) as log:
        for number, tick in enumerate(TICKS):
            if number == 100:
                log.config("N1", b"\xaa\x31 new", tick.record.tick_ns)
            log_tick(log, tick.record, tick.frames)
    assert SessionReader([log.parts[1]]).configs["N1"] == CONFIGS["N1"]
    assert SessionReader([log.parts[2]]).configs == {**CONFIGS, "N1": b"\xaa\x31 new"}
    assert len(stamps(SessionReader(log.parts[0]))) == 400


def test_parts_of_an_earlier_session_are_left_aside(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    old = written(path, max_minutes=1 / 40)
    assert len(old.parts) > 3
    new = written(path, TICKS[:150], max_minutes=1 / 40)
    assert len(new.parts) == 2 and old.parts[2].exists()
    assert stamps(SessionReader(path)) == [tick.record.tick_ns for tick in TICKS[:150]]
    with pytest.raises(SourceError, match=r"s\.part3\.mcap: not of the same session as .*s\.mcap; read one at a time"):
        SessionReader([path, old.parts[2]])


def test_files_that_do_not_belong_together(tmp_path: Path) -> None:
    plain = write_session(tmp_path / "plain.mcap", TICKS[:5])
    other = write_session(tmp_path / "other.mcap", TICKS[:5])
    log = written(tmp_path / "s.mcap", TICKS[:5])
    for paths in ([plain, other], [log.path, plain]):
        with pytest.raises(SourceError, match="not of the same session"):
            SessionReader(paths)
    with pytest.raises(SourceError, match="part 1 of the session twice"):
        SessionReader([log.path, log.path])


def test_a_part_that_is_missing_is_a_loss_where_it_was(tmp_path: Path) -> None:
    log = written(tmp_path / "s.mcap", max_minutes=1 / 40)
    log.parts[1].unlink()
    for reader in (SessionReader(log.path), SessionReader([log.path, *log.parts[2:]])):
        back = list(reader.ticks())
        assert [tick.record.tick_ns for tick in back if tick.after_loss] == [T0 + 182 * PERIOD_NS]
        assert len(back) == 309
        assert reader.missing == ["part 2 is missing, part 3 is there"]


def in_parts(tmp_path: Path, *absent: int) -> tuple[Path, list[str]]:
    """The first part of a session of five without some of its parts, and all that are there."""
    log = written(tmp_path / "s.mcap", max_minutes=1 / 40)
    for number in absent:
        part_path(log.path, number).unlink()
    there = [path for path in log.parts if path.exists()]
    assert len(log.parts) == 5
    return log.parts[0], list(map(str, there))


def test_an_analysis_refuses_a_part_named_twice(tmp_path: Path, capsys: Capsys) -> None:
    first, there = in_parts(tmp_path)
    link = tmp_path / "link.mcap"
    link.symlink_to(first)
    for paths in ([there[0], there[0]], [there[0], str(link)], [there[1], there[0], there[1]]):
        assert run(dcon(), ["analyze", *paths, "--out", str(tmp_path / "a")]) == 1
        said = capsys.readouterr().err
        assert "of the session twice, also" in said and said.count("\n") == 1
    plain = write_session(tmp_path / "plain.mcap", TICKS[:5])
    assert run(dcon(), ["analyze", str(plain), str(plain), "--out", str(tmp_path / "a")]) == 1
    assert "part 1 of the session twice" in capsys.readouterr().err


def test_an_output_is_no_later_part_whatever_is_missing_before_it(tmp_path: Path, capsys: Capsys) -> None:
    first, there = in_parts(tmp_path, 2)
    before = Path(there[-1]).read_bytes()
    assert Path(there[-1]).name == "s.part5.mcap"
    link = tmp_path / "t.csv"
    link.symlink_to(there[-1])
    assert run(dcon(), ["export", str(first), str(link)]) == 2
    assert "is an input, and would be overwritten" in capsys.readouterr().err
    assert Path(there[-1]).read_bytes() == before


def test_a_cut_part_is_a_loss_at_its_end(tmp_path: Path) -> None:
    log = written(tmp_path / "s.mcap", max_minutes=1 / 40)
    log.parts[1].write_bytes(log.parts[1].read_bytes()[:-3000])
    reader = SessionReader(log.path)
    back = list(reader.ticks())
    assert [tick.record.tick_ns for tick in back if tick.after_loss] == [T0 + 182 * PERIOD_NS]
    assert reader.damage.cut
    assert export(log.path, tmp_path / "t.csv").gaps == 1


def test_a_full_disk_is_waited_for_and_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Ticks 300 to 1,299 meet a full disk: every whole chunk before stays, and a new part says what is missing."""
    disk = full_disk(tmp_path, monkeypatch)
    ticks = random_ticks(2000)
    with rolling(tmp_path / "s.mcap") as log:
        for number, tick in enumerate(ticks):
            if number == 300:
                disk.capacity = disk.used + 1000
            if number == 1300:
                disk.capacity = float("inf")
            log_tick(log, tick.record, tick.frames, tick.orders, timing=tick.timing)
    assert [path.name for path in log.parts] == ["s.mcap", "s.part2.mcap"] == sorted(p.name for p in tmp_path.iterdir())
    reader = SessionReader(log.path)
    back = list(reader.ticks())
    after = next(k for k, (a, b) in enumerate(pairwise(back), 1) if b.record.tick_ns - a.record.tick_ns > 2 * PERIOD_NS)
    assert 240 <= after <= 300  # a chunk is a second
    assert [k for k, tick in enumerate(back) if tick.after_loss] == [after]
    resumed = (back[after].record.tick_ns - T0) // PERIOD_NS
    assert 1300 <= resumed <= 1300 + RETRY_NS // PERIOD_NS + 1
    assert log.unlogged_ticks == 2000 - len(back) == resumed - after
    assert SessionReader([log.parts[1]]).metadata["unlogged_ticks"] == str(log.unlogged_ticks)
    told = back[after].record.events[-1]
    assert (told.name, told.subject) == ("log_gap", "log")
    assert told.detail == f"{log.unlogged_ticks} ticks were not logged: No space left on device"
    rest = [tick for k, tick in enumerate(back) if k != after]
    expected = [tick._replace(pdci=None) for tick in (*ticks[:after], *ticks[resumed + 1 :])]
    assert [strip(tick) for tick in rest] == [strip(tick) for tick in expected]
    assert caplog.text.count("No space left on device; control goes on") == 1
    assert caplog.text.count("logging again") == 1


def test_a_disk_that_stays_full_leaves_one_file_and_a_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = full_disk(tmp_path, monkeypatch)
    with rolling(tmp_path / "s.mcap") as log:
        for number, tick in enumerate(random_ticks(1500)):
            if number == 300:
                disk.capacity = disk.used + 9000  # enough for the head of a part, not for a chunk
            log_tick(log, tick.record, tick.frames)
    assert [path.name for path in tmp_path.iterdir()] == ["s.mcap"] == [path.name for path in log.parts]
    back = stamps(SessionReader(log.path))
    assert len(back) + log.unlogged_ticks == 1500 and 250 <= len(back) <= 310
    assert back == [tick.record.tick_ns for tick in random_ticks(len(back))]


@pytest.mark.parametrize("room", range(0, 60_000, 4001))
def test_wherever_the_disk_is_full_every_tick_is_logged_or_counted(
    room: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = full_disk(tmp_path, monkeypatch)
    with rolling(tmp_path / "s.mcap", max_minutes=1 / 60) as log:
        disk.capacity = disk.used + room
        for tick in TICKS[:200]:
            log_tick(log, tick.record, tick.frames)
        disk.capacity = float("inf")
        late = [replace_time(tick, 2 * RETRY_NS) for tick in TICKS[200:210]]
        for tick in late:
            log_tick(log, tick.record)
    reader = SessionReader(log.path)
    back = list(reader.ticks())
    assert len(back) + log.unlogged_ticks == 210
    assert back[-1].record.tick_ns == late[-1].record.tick_ns
    assert sum(tick.after_loss for tick in back) == 1


def replace_time(tick: Tick, by_ns: int) -> Tick:
    return tick._replace(record=tick.record._replace(tick_ns=tick.record.tick_ns + by_ns))


def test_only_the_first_part_may_fail(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="No such file or directory"):
        rolling(tmp_path / "no" / "s.mcap")


def test_what_is_no_file_is_never_taken_away(tmp_path: Path) -> None:
    """A FIFO whose reader goes, for a device."""
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    reader = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    with RollingWriter(fifo, HEAD, patient=True) as log:
        log_tick(log, TICKS[0].record)
        os.close(reader)
        log.flush(T0)
        assert log.is_refused and log.unlogged_ticks == 1 and log.parts == []
    assert stat.S_ISFIFO(fifo.lstat().st_mode)


def test_a_file_that_was_there_before_stays_on_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "s.mcap").write_bytes(b"")
    full_disk(tmp_path, monkeypatch, 100)
    with RollingWriter(tmp_path / "s.mcap", HEAD, patient=True) as log:
        log_tick(log, TICKS[0].record)
        assert log.is_refused
    with RollingWriter(tmp_path / "new.mcap", HEAD, patient=True) as log:
        log_tick(log, TICKS[0].record)
        assert log.is_refused
    assert [path.name for path in tmp_path.iterdir()] == ["s.mcap"]


@pytest.fixture
def session(tmp_path: Path) -> list[Path]:
    """A simulated session, rotated every two seconds."""
    simulate(Plan(gain_mw_per_mhz=12, duration_s=7), str(tmp_path / "whole.mcap"))
    reader = SessionReader(tmp_path / "whole.mcap")
    names = ("pmus", "instances", "flags")
    metadata = {key: value for key, value in reader.metadata.items() if key not in names}
    head = Head(reader.ini_text, reader.pmus, reader.instances, reader.flags, metadata)
    with RollingWriter(tmp_path / "s.mcap", head, max_minutes=1 / 30) as log:
        log_configs(log, reader.configs)
        for tick in reader.ticks():
            log_tick(log, tick.record, tick.frames, tick.orders, instances=reader.instances)
    assert len(log.parts) == 4
    return log.parts


def test_replay_and_export_take_a_session_in_parts(session: list[Path], tmp_path: Path, capsys: Capsys) -> None:
    for named in ([session[0]], session):
        assert run(dcon(), ["replay", *map(str, named)]) == 0
        assert capsys.readouterr().out == "420 ticks: identical\n"
        assert run(dcon(), ["export", *map(str, named), str(tmp_path / "t.csv"), "--json"]) == 0
        assert json.loads(capsys.readouterr().out) == {
            "rows": 420,
            "gaps": 0,
            "damage": [],
            "newer": None,
            "missing": [],
        }
    export(tmp_path / "whole.mcap", tmp_path / "whole.csv")
    assert [line.split(",")[:7] for line in (tmp_path / "t.csv").read_text().splitlines()] == [
        line.split(",")[:7] for line in (tmp_path / "whole.csv").read_text().splitlines()
    ]


def test_a_replay_needs_the_beginning(session: list[Path], tmp_path: Path, capsys: Capsys) -> None:
    assert run(dcon(), ["replay", str(session[2])]) == 1
    said = f"dcon: {session[2]}: part 3 of a session; a replay starts with the first, {session[0].name}\n"
    assert capsys.readouterr().err == said
    assert run(dcon(), ["export", str(session[2]), str(tmp_path / "t.csv"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"] == 121


def test_a_replay_stops_where_a_part_is_missing(session: list[Path], capsys: Capsys) -> None:
    assert run(dcon(), ["replay", str(session[0]), str(session[3])]) == 3
    out, err = capsys.readouterr()
    assert out == "121 ticks: identical\n" and "stopped: the log lost something before tick" in err


@pytest.mark.parametrize("named", [False, True], ids=["the first", "all"])
@pytest.mark.parametrize("command", ["export", "analyze", "replay"])
def test_every_command_says_which_part_is_missing(
    command: str, named: bool, session: list[Path], tmp_path: Path, capsys: Capsys
) -> None:
    kept = tmp_path / "kept"
    kept.mkdir()
    there = [shutil.copy(path, kept / path.name) for path in (session[0], *session[2:])]
    first, out = there[0], tmp_path / "out"
    where = {"export": [str(out) + ".csv"], "analyze": ["--out", str(out)], "replay": []}[command]
    assert run(dcon(), [command, *map(str, there if named else [first]), *where]) == 3
    assert "part 2 is missing, part 3 is there" in capsys.readouterr().err
    if command == "analyze":
        (analysed,) = json.loads((out / "analysis.json").read_text())["sessions"]
        assert any("part 2 is missing" in note for note in analysed["notes"])
