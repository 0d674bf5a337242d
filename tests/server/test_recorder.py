"""The recorder: whatever dies, the log is whole as far as was said, and what is missing is counted."""

from __future__ import annotations

import json
import random
import shutil
import time
from pathlib import Path

import pytest
from support.sessions import CONFIGS, HEAD, T0
from support.shipped import FakeControl, recorder_in, same_ticks, tick_at

from dcon.link.assembly import Place
from dcon.link.bundle import Bundle, Entry, Kind, decode
from dcon.link.shipper import Ring, Shipper
from dcon.replay.replay import replay
from dcon.server import state
from dcon.server.recorder import Recorder, Report
from dcon.session.encode import tick_entries
from dcon.session.head import Head
from dcon.session.reader import SessionReader
from dcon.sim.plan import Plan
from dcon.sim.simulate import simulate
from pmutools.cli.shell import run
from pmutools.timebase import NS

EARLIER = b'{"session": 7, "key": "k", "path": "x", "have": 0, "earlier": [[1, "2"]]}'


class Line:
    """A control process and a recorder without sockets between them."""

    def __init__(self, folder: Path, session: int = 7, ring: Ring | None = None, **limits: float) -> None:
        self.folder = folder
        self.limits = limits
        self.control = FakeControl(folder / "run", session, ring)
        self.recorder = recorder_in(folder, **limits)
        self.connect()

    def connect(self) -> None:
        session, have, _ = self.recorder.resumes
        self.control.shipper.lost()
        self.control.shipper.told(json.dumps({"session": session, "have": have}).encode())

    def kill(self) -> None:
        """What kill -9 leaves: what was written to files, and nothing that was in memory."""
        self.recorder = recorder_in(self.folder, **self.limits)
        self.connect()

    def move(self, most: int = 8) -> None:
        self.control.shipper.service(self.take, most)

    def take(self, data: bytes) -> bool:
        bundle = decode(data)
        assert bundle is not None
        self.recorder.take(bundle)
        return True

    def flush(self) -> None:
        report = self.recorder.flush()
        self.control.shipper.told(json.dumps({"ack": report.have}).encode())

    def finish(self) -> SessionReader:
        self.control.shipper.end(time.monotonic_ns())
        while self.control.shipper.behind:
            self.move()
        self.recorder.close()
        return SessionReader(self.folder / "session.mcap")


def test_a_session_is_written_bit_for_bit(tmp_path: Path) -> None:
    line = Line(tmp_path)
    for _ in range(200):
        line.control.tick()
        line.move()
    reader = line.finish()
    same_ticks(reader, range(200))
    assert not reader.damage and len(reader.parts) == 1
    assert (reader.pmus, reader.instances, reader.flags) == (HEAD.pmus, HEAD.instances, HEAD.flags)
    assert (reader.configs, reader.ini_text) == (CONFIGS, HEAD.ini_text)
    assert reader.metadata["seed"] == "7"


@pytest.mark.parametrize("seed", range(6))
def test_kills_at_random_lose_nothing_that_the_controller_keeps(seed: int, tmp_path: Path) -> None:
    rng = random.Random(seed)
    line = Line(tmp_path, max_minutes=1 / 20)
    deaths = 0
    for _ in range(700):
        line.control.tick()
        if rng.random() < 0.9:
            line.move()
        if rng.random() < 0.05:
            line.flush()
        if rng.random() < 0.02:
            line.kill()
            deaths += 1
    reader = line.finish()
    same_ticks(reader, range(700))
    assert deaths > 5 and not reader.damage and not any(tick.after_loss for tick in reader.ticks())
    assert len(reader.parts) > 4
    for part in reader.parts:
        assert SessionReader(part.log.path).configs == CONFIGS


def test_a_kill_between_the_log_and_the_state_is_no_doubling(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    line = Line(tmp_path)
    for _ in range(50):
        line.control.tick()
        line.move()
    line.flush()
    for _ in range(50):
        line.control.tick()
        line.move()
    monkeypatch.setattr(state, "save", lambda folder, state: False)
    line.flush()
    assert len(line.control.shipper.ring) == 50  # nothing is acknowledged that would be cut off
    monkeypatch.undo()
    line.kill()
    same_ticks(line.finish(), range(100))


def test_what_was_flushed_stays_when_both_processes_die(tmp_path: Path) -> None:
    line = Line(tmp_path)
    for number in range(300):
        line.control.tick()
        line.move()
        if number % 30 == 29:
            line.flush()
    frozen = tmp_path / "frozen.mcap"
    shutil.copy(tmp_path / "session.mcap", frozen)
    line.control.tick()
    reader = SessionReader(frozen)
    same_ticks(reader, range(300))
    assert reader.damage.cut and not reader.damage.losses


def test_the_next_session_takes_a_free_name_and_never_another_s_parts(tmp_path: Path) -> None:
    (tmp_path / "session-2.part2.mcap").write_text("somebody's")
    first = Line(tmp_path, session=1)
    first.control.tick()
    first.move()
    second = FakeControl(tmp_path / "run", session=2)
    second.tick()
    first.control = second
    first.connect()
    for _ in range(10):
        first.move()
    first.recorder.close()
    assert sorted(path.name for path in tmp_path.glob("*.mcap")) == [
        "session-2.part2.mcap",
        "session-3.mcap",
        "session.mcap",
    ]
    for name in ("session.mcap", "session-3.mcap"):
        same_ticks(SessionReader(tmp_path / name), range(1))
    third = Line(tmp_path, session=3)
    third.control.tick()
    third.move()
    third.flush()
    assert third.recorder.flush().file.endswith("session-4.mcap")


def test_what_fell_out_of_the_ring_is_a_gap_that_the_log_tells(tmp_path: Path) -> None:
    line = Line(tmp_path, ring=Ring(600 * NS, 60_000))
    for _ in range(20):
        line.control.tick()
        line.move()
    line.flush()
    for _ in range(200):
        line.control.tick()
    dropped = line.control.shipper.ring.first - 24  # four configurations, twenty ticks
    assert dropped > 50
    reader = line.finish()
    same_ticks(reader, [*range(20), *range(20 + dropped, 220)])
    events = [(e.name, e.subject, e.detail) for tick in reader.ticks() for e in tick.record.events]
    assert [event[:2] for event in events] == [("log_gap", "log")]
    assert events[0][2].startswith(f"{dropped} ticks were not logged: the server was away")
    assert [tick.record.tick_ns for tick in reader.ticks() if tick.after_loss] == [tick_at(20 + dropped).record.tick_ns]
    assert reader.parts[1].unlogged == dropped and line.recorder.flush().gaps == 1


def test_a_session_joined_late_begins_with_a_gap_and_all_configurations(tmp_path: Path) -> None:
    line = Line(tmp_path, ring=Ring(600 * NS, 60_000))
    for _ in range(200):
        line.control.tick()
    missing = line.control.shipper.ring.first - 4  # configurations, which are told again
    reader = line.finish()
    assert reader.configs == CONFIGS
    (event,) = [event for tick in reader.ticks() for event in tick.record.events]
    assert event.detail.startswith(f"{missing} ticks were not logged")


def test_configurations_that_were_passed_over_are_no_missing_ticks(tmp_path: Path) -> None:
    line = Line(tmp_path)
    for _ in range(10):
        line.control.tick()
        line.move()
    line.flush()
    line.control.shipper.config("N1", CONFIGS["N1"], T0, 0)
    lost: list[bytes] = []
    line.control.shipper.service(lambda data: lost.append(data) is None)
    assert len(lost) == 1
    for _ in range(10):
        line.control.tick()
    reader = line.finish()
    same_ticks(reader, range(20))
    report = line.recorder.flush()
    assert (report.gaps, report.unlogged, len(reader.parts)) == (1, 0, 1)
    assert not any(tick.after_loss for tick in reader.ticks())


def test_bundles_without_sense_are_a_gap_and_no_harm(tmp_path: Path) -> None:
    line = Line(tmp_path)
    line.control.tick()
    line.move()
    good = tick_at(0).record.tick_ns
    nonsense = [
        Bundle(Kind.TICK, 5, 7, good, (Entry("Nonsense", "", b"", 1, 1),), tick=1),
        Bundle(Kind.TICK, 6, 7, good, (Entry("Tick", "N1", b"", 1, 1),), tick=2),
        Bundle(Kind.TICK, 7, 7, -1, tick=3),
        Bundle(Kind.TICK, 3, 7, good, (Entry("Tick", "", b"\xff", 1, 1),), tick=4),
        Bundle(Kind.TICK, 8, 99, good, tick=4),
        Bundle(Kind.HEAD, 0, 8, 0, (Entry("head", "values", b"{", 0, 1),)),
        Bundle(Kind.HEAD, 0, 8, 0, (Entry("head", "values", b"{", 7, 9),)),
        Bundle(Kind.HEAD, 0, 8, 0, ()),
    ]
    for bundle in nonsense:
        line.recorder.take(bundle)
    line.recorder.close()
    assert line.recorder.gaps == 3 == line.recorder.flush().unlogged
    same_ticks(SessionReader(tmp_path / "session.mcap"), range(1))


def gone(folder: Path, session: int, ticks: int) -> Report:
    """A session that loses so many ticks on their way; then controller and server are killed."""
    line = Line(folder, session)
    line.control.tick()
    line.move(16)
    for _ in range(ticks):
        line.control.tick()
    line.control.shipper.service(lambda data: True, ticks)
    line.control.tick()
    line.move()
    line.flush()
    return line.recorder.flush()


def test_sessions_that_lack_ticks_are_remembered_whoever_dies(tmp_path: Path) -> None:
    assert gone(tmp_path, 1, 30).lacking == ((1, 30),)
    assert gone(tmp_path, 2, 0).lacking == ((1, 30),)
    report = gone(tmp_path, 3, 12)
    assert (report.unlogged, report.lacking) == (12, ((1, 30), (3, 12)))
    kept = states_of(tmp_path)
    assert (kept.session, kept.unlogged, kept.earlier) == (3, 12, ((1, 30),))
    line = Line(tmp_path, 4)  # the same server for two sessions
    line.control.tick()
    line.move()
    line.control = FakeControl(tmp_path / "run", 5)
    line.connect()
    line.control.tick()
    line.move()
    line.flush()
    assert line.recorder.flush().lacking == ((1, 30), (3, 12))


def states_of(folder: Path) -> state.State:
    found = state.load(folder / "run")
    assert found is not None
    return found


def test_a_session_that_goes_on_is_counted_once(tmp_path: Path) -> None:
    line = Line(tmp_path, ring=Ring(600 * NS, 60_000))
    for _ in range(200):
        line.control.tick()
    for _ in range(20):
        line.move()
    line.flush()
    missing = line.recorder.flush().unlogged
    assert missing > 50
    line.kill()
    line.control.tick()
    line.move()
    line.flush()
    assert line.recorder.flush().lacking == ((7, missing),) and states_of(tmp_path).earlier == ()


def test_of_very_many_sessions_none_is_forgotten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dcon.server.recorder.EARLIER", 3)
    for session in range(1, 7):
        report = gone(tmp_path, session, session)
    assert report.lacking == ((3, 6), (4, 4), (5, 5), (6, 6))


@pytest.mark.parametrize(
    "content", [b"", b"{}", b"[1]", b'{"session": 7, "key": 1, "path": "x", "have": 0}', b"\xff", EARLIER]
)
def test_a_damaged_state_begins_a_new_log(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / state.FILE).write_bytes(content)
    assert recorder_in(tmp_path).resumes == Place()


def test_a_log_that_is_gone_is_begun_anew(tmp_path: Path) -> None:
    line = Line(tmp_path)
    for _ in range(50):
        line.control.tick()
        line.move()
    line.flush()
    (tmp_path / "session.mcap").unlink()
    line.kill()
    line.control.tick()
    reader = line.finish()
    assert [e.name for tick in reader.ticks() for e in tick.record.events] == ["log_gap"]
    same_ticks(reader, [50])


def test_a_folder_that_cannot_be_written_is_tried_again(tmp_path: Path) -> None:
    run_folder = tmp_path / "run"
    run_folder.mkdir()
    line = Line(tmp_path)
    line.recorder = Recorder(str(tmp_path / "later" / "session.mcap"), run_folder)
    line.connect()
    for _ in range(100):
        line.control.tick()
        line.move()
    line.flush()
    report = line.recorder.flush()
    assert report.refused and report.unlogged == 100 and report.have == 103
    (tmp_path / "later").mkdir()
    for _ in range(700):
        line.control.tick()
        line.move()
    line.control.shipper.end(0)
    line.move()
    line.recorder.close()
    (path,) = (tmp_path / "later").glob("*.mcap")
    reader = SessionReader(path)
    back = list(reader.ticks())
    assert 0 < len(back) < 700 and back[-1].record.tick_ns == tick_at(799).record.tick_ns
    assert back[0].record.events[-1].detail.startswith(f"{800 - len(back)} ticks were not logged: ")


def test_a_session_of_several_lives_replays_bit_for_bit(tmp_path: Path) -> None:
    """From the bytes of a simulated session, through bundles, deaths and backfill, to a replay without a difference."""
    simulate(Plan(gain_mw_per_mhz=12, duration_s=4), str(tmp_path / "simulated.mcap"))
    source = SessionReader(tmp_path / "simulated.mcap")
    metadata = {key: source.metadata[key] for key in ("scenario", "plant", "seed", "verified")}
    head = Head(source.ini_text, source.pmus, source.instances, source.flags, metadata)
    shipper = Shipper(5, head.pieces(5), Ring(600 * NS, 64 << 20))
    for name, frame in source.configs.items():
        shipper.config(name, frame, 0, 0)
    recorder = recorder_in(tmp_path)

    def take(data: bytes) -> bool:
        bundle = decode(data)
        assert bundle is not None
        recorder.take(bundle)
        return True

    for number, tick in enumerate(source.ticks()):
        if number % 100 == 0:
            recorder = recorder_in(tmp_path)
            session, have, _ = recorder.resumes
            shipper.told(json.dumps({"session": session, "have": have}).encode())
        entries = tick_entries(source.instances, tick.record, tick.frames, tick.orders, pdci=tick.pdci)
        shipper.tick(tick.record.tick_ns, entries, 0)
        shipper.service(take)
        if number % 37 == 0:
            shipper.told(json.dumps({"ack": recorder.flush().have}).encode())
    while shipper.service(take):
        pass
    recorder.close()
    result = replay(tmp_path / "session.mcap")
    assert len(SessionReader(tmp_path / "session.mcap").parts) == 3
    assert (result.ticks, result.different, result.stopped, result.problems) == (240, 0, "", [])


def test_a_log_of_two_lives_exports_without_a_gap(tmp_path: Path) -> None:
    from dcon.cli import dcon

    line = Line(tmp_path)
    for number in range(100):
        line.control.tick()
        line.move()
        if number == 50:
            line.flush()
            line.kill()
    line.finish()
    assert run(dcon(), ["export", str(tmp_path / "session.mcap"), str(tmp_path / "t.csv")]) == 0
    assert len((tmp_path / "t.csv").read_text().splitlines()) == 101
    assert tick_at(0).record.tick_ns == T0
