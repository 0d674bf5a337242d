"""What a run writes while it is on: readable when it is killed, honest when the disk is full; nothing waits for it."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.measured import batch, config, stamps

from pmutools.clock import VirtualClock
from pmutools.errors import SourceError
from pmutools.flow import Flow
from pmutools.formats.source import Block
from pmutools.timebase import NS
from pmutools.tools.characterizer.chores import Chores
from pmutools.tools.characterizer.chronicle import FIRST, LAST, Chronicle
from pmutools.tools.characterizer.engine import Engine
from pmutools.tools.characterizer.folder import Folder
from pmutools.tools.characterizer.names import SUMMARY
from pmutools.tools.characterizer.recorder import Recorder
from pmutools.tools.characterizer.samples import Samples
from pmutools.tools.characterizer.summaries import run_part

FLOW = Flow("udp", "192.0.2.1:4713", "192.0.2.9:4713")


class Running:
    """An engine and its recorder in virtual time."""

    def __init__(self, path: Path, **options: Any) -> None:
        self.clock = VirtualClock()
        self.engine = Engine(begin_ns=self.clock.realtime_ns())
        self.folder = Folder(path)
        self.recorder = Recorder(
            self.engine,
            self.folder,
            lambda utc_ns: run_part(self.engine, "x", self.engine.begin_ns, utc_ns, dict, complete=False),
            self.clock.monotonic_ns,
            **options,
        )
        self.second = 0

    def go(self, seconds: int) -> None:
        """So many seconds of a stream of 60/s that misses the tenth frame of each."""
        for _ in range(seconds):
            slots = [slot for slot in range(60 * self.second, 60 * self.second + 60) if slot % 60 != 10]
            self.engine.take([Block(FLOW, batch(stamps(slots), of=config()))])
            self.second += 1
            self.clock.advance(NS)
            self.recorder.look(self.clock.realtime_ns())

    def end(self) -> None:
        self.recorder.close(self.clock.realtime_ns())
        self.engine.close()
        self.recorder.finish()


def rows(journal: Path) -> list[dict[str, Any]]:
    """An Arrow stream up to where it is cut."""
    found: list[dict[str, Any]] = []
    with pa.OSFile(str(journal)) as file:
        try:
            for part in pa.ipc.open_stream(file):
                found += part.to_pylist()
        except (OSError, pa.ArrowInvalid):
            pass
    return found


def test_samples_hold_every_frame_and_every_lost_slot(tmp_path: Path) -> None:
    running = Running(tmp_path)
    running.go(100)
    running.end()
    table = pq.read_table(tmp_path / "samples.parquet")
    assert table.column_names == ["stream", "slot", "time_ns", "arrival_ns", "delay_ns", "stamp_source", "state"]
    found = table.to_pylist()
    assert sorted(row["slot"] for row in found) == list(range(found[0]["slot"], found[0]["slot"] + 6000))
    lost = [row for row in found if row["state"] == "lost"]
    assert len(lost) == 100
    assert {row["stream"] for row in found} == {"N1"}
    assert all(row["arrival_ns"] is None and row["delay_ns"] is None and row["stamp_source"] is None for row in lost)
    assert all(row["delay_ns"] == row["arrival_ns"] - row["time_ns"] for row in found if row["state"] != "lost")
    assert [path.name for path in tmp_path.iterdir() if "journal" in path.name] == []
    assert running.recorder.paths == [tmp_path / "samples.parquet"]


def test_what_was_flushed_can_be_read_when_a_run_is_killed(tmp_path: Path) -> None:
    """It is copied while it runs, which is what is on the disk then."""
    running = Running(tmp_path / "run", interval_ns=5 * NS)
    running.go(23)
    shutil.copytree(tmp_path / "run", tmp_path / "dead")
    dead = tmp_path / "dead"
    found = rows(dead / "samples.parquet.journal")
    assert len([row for row in found if row["state"] != "lost"]) == 23 * 59
    summary = json.loads((dead / SUMMARY).read_text())
    assert not summary["run"]["complete"]
    assert 10 * 59 <= summary["streams"][0]["received"] <= 23 * 59
    lines = (dead / "intervals.jsonl").read_text().splitlines()
    assert [json.loads(line)["all"]["received"] for line in lines] == [5 * 59] * 4
    cut = (dead / "samples.parquet.journal").read_bytes()
    (dead / "cut").write_bytes(cut[: len(cut) - 700])
    assert 0 < len(rows(dead / "cut")) < len(found)
    running.end()


def test_a_checkpoint_costs_no_more_than_its_share(tmp_path: Path) -> None:
    running = Running(tmp_path, samples=False)
    put: list[int] = []
    running.folder.put = lambda name, text: put.append(running.clock.monotonic_ns())  # type: ignore[method-assign,assignment]
    running.go(100)
    assert 8 <= len(put) <= 10  # every 10 s where it takes no time
    recorder = running.recorder
    recorder._chores.took_ns[SUMMARY] = 3 * NS
    recorder._checkpoint_ns = running.clock.monotonic_ns()
    running.go(1)
    assert recorder._checkpoint_ns - running.clock.monotonic_ns() == 60 * NS


def refuse(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """A disk that takes nothing more."""
    from pmutools.formats.output import OutputFile

    whole = OutputFile._put

    def full(self: OutputFile, data: bytes) -> None:
        if any(name in self.path.name for name in names):
            with self._failing():
                raise OSError(28, "No space left on device")
        whole(self, data)

    monkeypatch.setattr(OutputFile, "_put", full)


def test_a_full_disk_costs_the_samples_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    running = Running(tmp_path, interval_ns=5 * NS)
    running.go(12)
    refuse(monkeypatch, "samples")
    running.go(12)
    running.end()
    assert running.engine.gauges[0].meter.result().counts.slots.received == 24 * 59
    (failure,) = running.recorder.failures
    assert "samples.parquet" in failure and "No space left on device" in failure
    assert failure in [line for _, line in running.engine.chronicle.lines()]
    assert not (tmp_path / "samples.parquet").exists()
    assert len(rows(tmp_path / "samples.parquet.journal")) >= 11 * 59
    assert len((tmp_path / "intervals.jsonl").read_text().splitlines()) == 5
    assert running.recorder.paths == [tmp_path / "intervals.jsonl"]


def test_a_full_disk_may_cost_the_intervals_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    running = Running(tmp_path, interval_ns=5 * NS)
    refuse(monkeypatch, "samples", "intervals")
    running.go(12)
    running.end()
    assert len(running.recorder.failures) == 2
    assert running.engine.gauges[0].frames == 12 * 59


def test_a_full_disk_gives_the_journal_s_room_to_the_summary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    running = Running(tmp_path)
    running.go(12)
    refuse(monkeypatch, "samples")
    running.go(2)
    running.end()
    journal, put = tmp_path / "samples.parquet.journal", running.folder.put
    assert journal.exists()

    def crowded(name: str, text: str) -> None:
        if journal.exists():
            raise SourceError(f"cannot write {name}: No space left on device")
        put(name, text)

    running.folder.put = crowded  # type: ignore[method-assign]
    running.recorder.put_summary("{}")
    assert (tmp_path / "summary.json").read_text() == "{}"
    assert not journal.exists() and running.recorder.samples is None
    assert str(journal) not in {os.readlink(f"/proc/self/fd/{fd}").removesuffix(" (deleted)") for fd in open_files()}


def open_files() -> list[str]:
    """Those of this process; a file that is deleted but open still takes its room."""
    if not Path("/proc/self/fd").is_dir():
        pytest.skip("needs /proc")
    return [fd for fd in os.listdir("/proc/self/fd") if os.path.islink(f"/proc/self/fd/{fd}")]


def test_a_summary_never_costs_samples_that_are_whole(tmp_path: Path) -> None:
    running = Running(tmp_path)
    running.go(2)
    (tmp_path / "summary.json.new").mkdir()
    with pytest.raises(SourceError, match=r"summary\.json"):
        running.recorder.put_summary("{}")
    running.end()
    assert (tmp_path / "samples.parquet").exists()


def test_a_summary_is_there_whole_or_not_at_all(tmp_path: Path) -> None:
    folder = Folder(tmp_path / "new" / "run")
    folder.put("x.json", "{}")
    (folder.path / "x.json.new").mkdir()
    with pytest.raises(SourceError, match=r"cannot write .*x\.json"):
        folder.put("x.json", "{1}")
    assert (folder.path / "x.json").read_text() == "{}"


def test_a_folder_is_emptied_of_an_earlier_run_alone(tmp_path: Path) -> None:
    for name in ("summary.json", "samples.parquet", "samples.parquet.journal", "intervals.jsonl", "report.html"):
        (tmp_path / name).write_text("old")
    (tmp_path / "mine.txt").write_text("kept")
    Folder(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
    (tmp_path / "file").write_text("x")
    with pytest.raises(SourceError, match="cannot make the folder"):
        Folder(tmp_path / "file")


def test_many_streams_share_one_file(tmp_path: Path) -> None:
    samples, engine = Samples(tmp_path), Engine()
    engine.sinks.append(samples.add)
    for second in range(3):
        for idcode in range(1, 1 + 20 * (second + 1)):
            slots = range(60 * second, 60 * second + 60)
            engine.take([Block(FLOW, batch(stamps(slots), of=config(idcode=idcode)))])
        engine.drain(1000)
        samples.flush()
    engine.close()
    samples.close()
    table = pq.read_table(tmp_path / "samples.parquet")
    assert table.num_rows == samples.rows == 60 * (20 + 40 + 60)
    counts = {row["values"]: row["counts"] for row in table["stream"].value_counts().to_pylist()}
    assert len(counts) == 60 and set(counts.values()) == {60, 120, 180}


def test_chores_take_turns_within_their_budget() -> None:
    clock, done = VirtualClock(), list[str]()

    def work(name: str, steps: int) -> Any:
        for _ in range(steps):
            clock.advance(20_000_000)
            done.append(name)
            yield

    chores = Chores(clock.monotonic_ns)
    chores.start("a", work("a", 6))
    chores.start("b", work("b", 2))
    chores.work()
    assert done == ["a"] * 3
    chores.work()
    assert done == ["a"] * 3 + ["b"] * 2 + ["a"]
    assert chores.busy("a") and not chores.busy("b")
    chores.finish()
    assert done.count("a") == 6 and chores.took_ns == {"a": 120_000_000, "b": 40_000_000}
    chores.start("a", work("a", 2))
    chores.start("a", work("c", 1))
    chores.drop("a")
    chores.finish()
    assert done[-2:] == ["a", "a"]  # what was begun is finished before another of its name begins


def test_a_chore_that_fails_is_not_begun_again() -> None:
    def fail() -> Any:
        yield
        raise SourceError("no")

    chores = Chores(VirtualClock().monotonic_ns)
    chores.start("a", fail())
    with pytest.raises(SourceError):
        chores.finish()
    assert not chores.busy("a")
    chores.work()


def test_a_chronicle_keeps_the_first_lines_and_the_last() -> None:
    chronicle = Chronicle()
    for number in range(5000):
        chronicle.add(number, f"line {number}")
    lines = chronicle.lines()
    assert len(lines) == FIRST + LAST + 1
    assert lines[FIRST][1] == "(4000 lines left out)"
    assert lines[-1] == (4999, "line 4999")
