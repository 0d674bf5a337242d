"""A log that lacks ticks: what is behind a gap is replayed from the next checkpoint, and the rest never judged."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
from support.disk import full_disk
from support.relogged import Given, given_in, relogged, without
from support.swing import START_NS
from support.virtual_platform import STREAMS, config_chunk, stream, virtual_platform

from dcon.cli import dcon
from dcon.core.values import Record
from dcon.link.bundle import Entry, decode
from dcon.link.shipper import Ring, Shipper
from dcon.replay.replay import Gap, replay
from dcon.server.recorder import Recorder
from dcon.session.head import Head
from dcon.session.reader import SessionReader
from dcon.session.rolling import RollingWriter
from pmutools.cli.shell import run
from pmutools.schema.descriptors import message_class
from pmutools.timebase import NS

Capsys = pytest.CaptureFixture[str]
EVERY = 300
"""Ticks from one checkpoint to the next."""
CHANGED = 400
"""About the tick before which a PMU's configuration changes."""


class Logged(NamedTuple):
    """A session of a platform in virtual time, with its log taken apart."""

    path: Path
    head: Head
    ticks: list[Given]
    records: list[Record]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Logged:
    """16 s, armed and active; N1 sends another configuration after 6.6 s, and the frames that go with it."""
    path = tmp_path_factory.mktemp("whole") / "s.mcap"
    changed_ns = START_NS + CHANGED * NS // 60
    before = [(at, item) for at, item in stream(18) if at < changed_ns]
    change = config_chunk("N1", changed_ns, STREAMS.slim("N1"))
    try:
        after = [(at, item) for at, item in stream(18) if at > changed_ns]
        with pytest.MonkeyPatch.context() as patch:
            virtual_platform(path, [*before, change, *after], patch).run(16)
    finally:
        STREAMS.configs["N1"] = STREAMS.streams["N1"].config
    head, ticks = given_in(path)
    records: list[Record] = []
    assert replay(path, observe=lambda _, now: records.append(now)).different == 0
    assert [number for number, tick in enumerate(ticks) if tick.has_checkpoint] == [*range(0, len(ticks), EVERY)]
    assert len(records) == len(ticks) > 3 * EVERY
    assert max(abs(record.output_v) for record in records) > 0.1
    return Logged(path, head, ticks, records)


def told(capsys: Capsys, *arguments: str) -> tuple[int, str, str]:
    code = run(dcon(), ["replay", *arguments])
    return code, *capsys.readouterr()


@pytest.mark.parametrize(
    "lost",
    [range(310, 420), range(599, 600), range(299, 601), range(450, 890), range(500, 600)],
    ids=["with a configuration", "one before a checkpoint", "two checkpoints", "long", "up to a checkpoint"],
)
def test_a_replay_goes_on_behind_a_gap(lost: range, whole: Logged, tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    log = relogged(path, whole.head, whole.ticks, lost)
    assert (len(log.parts), log.unlogged_ticks) == (2, len(lost))
    resumed = -(-lost.stop // EVERY) * EVERY
    seen: list[Record] = []
    result = replay(path, observe=lambda _, now: seen.append(now))
    assert seen == [*whole.records[: lost.start], *whole.records[resumed:]]
    assert (result.ticks, result.different, result.first, result.problems) == (len(seen), 0, None, [])
    why = f"{len(lost)} ticks before part 2 were not logged"
    assert result.gaps == [Gap(whole.ticks[lost.stop].tick_ns, why, resumed - lost.stop, True)]


def test_every_gap_is_told(whole: Logged, tmp_path: Path, capsys: Capsys) -> None:
    lost = {*range(100, 110), *range(200, 210), *range(700, 720)}
    relogged(tmp_path / "s.mcap", whole.head, whole.ticks, lost)
    code, out, err = told(capsys, str(tmp_path / "s.mcap"), "--json")
    found = json.loads(out)
    assert code == 3 and found["different"] == 0 and err == f"not whole: {found['stopped']}\n"
    assert [(gap["tick_ns"], gap["not_replayed"]) for gap in found["gaps"]] == [
        (whole.ticks[110].tick_ns, 180),  # another gap before the checkpoint is no new one
        (whole.ticks[720].tick_ns, 180),
    ]
    assert found["not_replayed"] == 360 and found["ticks"] == len(whole.ticks) - len(lost) - 360
    assert found["gaps"][0]["why"] == "10 ticks before part 2 were not logged"
    assert "10 ticks before part 3" not in str(found["gaps"]) and "10 ticks before part 3" in found["stopped"]


def test_without_checkpoints_a_replay_ends_at_the_gap(whole: Logged, tmp_path: Path, capsys: Capsys) -> None:
    lost = range(310, 420)
    relogged(tmp_path / "s.mcap", whole.head, whole.ticks, lost, without("Checkpoint"))
    code, out, err = told(capsys, str(tmp_path / "s.mcap"))
    assert (code, out) == (3, "310 ticks: identical\n")
    rest = len(whole.ticks) - 420
    assert err == (
        f"stopped: the log lost something before tick {whole.ticks[420].tick_ns} (110 ticks before part 2 were not "
        f"logged); {rest} ticks from there on are not replayed\n"
    )


def of_another_layout(tick: Given) -> Given:
    def edit(entry: Entry) -> Entry:
        if entry.message != "Checkpoint":
            return entry
        message = message_class("Checkpoint").FromString(entry.data)
        message.layout = "of a later version"
        return entry._replace(data=message.SerializeToString())

    return tick._replace(entries=list(map(edit, tick.entries)))


def test_checkpoints_of_another_layout_are_passed_over(whole: Logged, tmp_path: Path, capsys: Capsys) -> None:
    relogged(tmp_path / "whole.mcap", whole.head, whole.ticks, (), of_another_layout)
    assert told(capsys, str(tmp_path / "whole.mcap")) == (0, f"{len(whole.ticks)} ticks: identical\n", "")
    relogged(tmp_path / "s.mcap", whole.head, whole.ticks, range(10, 20), of_another_layout)
    code, out, err = told(capsys, str(tmp_path / "s.mcap"))
    assert (code, out) == (3, "10 ticks: identical\n") and err.startswith("stopped: the log lost something before")


@pytest.mark.parametrize("checkpoints", [False, True])
def test_a_log_without_its_first_ticks_is_never_called_different(
    checkpoints: bool, whole: Logged, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    """The disk is full at the start, and has room from the 100th tick on; it is looked at again after 10 s."""
    disk = full_disk(tmp_path, monkeypatch, 0)
    path = tmp_path / "s.mcap"
    with RollingWriter(path, whole.head, patient=True) as log:
        for number, tick in enumerate(whole.ticks):
            if number == 100:
                disk.capacity = float("inf")
            for name, frame in tick.configs:
                log.config(name, frame, tick.tick_ns)
            log.write((tick if checkpoints else without("Checkpoint")(tick)).entries, tick.tick_ns)
    assert log.parts == [path] and log.unlogged_ticks == 600
    first = whole.ticks[600].tick_ns
    reader = SessionReader(path)
    ticks = list(reader.ticks())
    assert ticks[0].record.tick_ns == first and [tick.after_loss for tick in ticks].count(True) == 1
    assert ticks[0].after_loss and reader.missing == ["the first 600 ticks were not logged"]
    code, out, err = told(capsys, str(path))
    assert code == 3
    if checkpoints:
        assert out == f"{len(whole.ticks) - 600} ticks: identical\n"
        assert err == (f"not whole: the log lost something before tick {first} (the first 600 ticks were not logged)\n")
    else:
        assert out == "no tick could be replayed\n" and f"{len(whole.ticks) - 600} ticks from there on are not" in err
        found = json.loads(told(capsys, str(path), "--json")[1])
        assert (found["ticks"], found["different"], found["first"]) == (0, 0, None)
    assert run(dcon(), ["export", str(path), str(tmp_path / "t.csv"), "--json"]) == 3
    said = json.loads(capsys.readouterr().out)
    assert (said["gaps"], said["missing"]) == (1, ["the first 600 ticks were not logged"])


def test_bundles_that_the_server_never_got_are_a_gap_that_is_passed(whole: Logged, tmp_path: Path) -> None:
    """From the control process's ring, too small for the server's absence, to the log."""
    (tmp_path / "run").mkdir()
    recorder = Recorder(str(tmp_path / "s.mcap"), tmp_path / "run")
    shipper = Shipper(5, whole.head.pieces(5), Ring(600 * NS, 300_000))

    def take(data: bytes) -> bool:
        bundle = decode(data)
        assert bundle is not None
        recorder.take(bundle)
        return True

    for number, tick in enumerate(whole.ticks):
        for name, frame in tick.configs:
            shipper.config(name, frame, tick.tick_ns, tick.tick_ns)
        shipper.tick(tick.tick_ns, tick.entries, tick.tick_ns)
        if number in (0, 800):
            session, have, _ = recorder.resumes
            shipper.told(json.dumps({"session": session, "have": have}).encode())
        if number == 350:
            shipper.lost()
        while shipper.service(take):
            pass
    recorder.close()
    lost = recorder.flush().unlogged
    assert 100 < lost < 449
    result = replay(tmp_path / "s.mcap")
    assert (result.different, result.problems) == (0, [])
    behind = 350 + lost
    (gap,) = result.gaps
    assert gap.passed and gap.ticks == -behind % EVERY
    assert result.ticks == len(whole.ticks) - lost - gap.ticks


def test_damage_is_passed_at_the_next_checkpoint(whole: Logged, tmp_path: Path) -> None:
    rotten = bytearray(whole.path.read_bytes())
    at = rotten.index(b"\x04\x00\x00\x00zstd", len(rotten) // 2) + 500
    rotten[at : at + 3] = b"rot"
    (tmp_path / "s.mcap").write_bytes(rotten)
    result = replay(tmp_path / "s.mcap")
    assert result.different == 0
    (gap,) = result.gaps
    assert gap.passed and 0 < gap.ticks < EVERY and 55 <= len(whole.ticks) - result.ticks - gap.ticks <= 65
    assert "damaged chunk" in result.stopped


def test_a_configuration_that_the_log_lacks_puts_the_replay_off(whole: Logged, tmp_path: Path) -> None:
    """The change of N1 is lost with the ticks around it, and told again much later: no checkpoint before is used."""
    late = 700
    changed = next(n for n, tick in enumerate(whole.ticks) if n and tick.configs)
    configs = whole.ticks[changed].configs
    ticks = [*whole.ticks]
    ticks[changed] = ticks[changed]._replace(configs=[])
    ticks[late] = ticks[late]._replace(configs=configs)
    relogged(tmp_path / "s.mcap", whole.head, ticks, range(changed - 5, changed + 5))
    result = replay(tmp_path / "s.mcap")
    (gap,) = result.gaps
    assert gap.passed and gap.ticks == 3 * EVERY - (changed + 5)
    assert (result.different, result.ticks) == (0, changed - 5 + len(ticks) - 3 * EVERY)


def test_changed_settings_end_at_a_gap(whole: Logged, tmp_path: Path, capsys: Capsys) -> None:
    """The controller of a checkpoint had the recorded ones."""
    relogged(tmp_path / "s.mcap", whole.head, whole.ticks, range(650, 660))
    code, out, err = told(capsys, str(tmp_path / "s.mcap"), "--set", "controller.gain_mw_per_mhz=12")
    assert code == 3 and out.startswith("650 ticks with ") and err.startswith("stopped: the log lost something")


def edited(number: int, edit: Callable[[list[object]], object]) -> Callable[[Given], Given]:
    """Changes the memory of the checkpoint of that number."""
    count = iter(range(10**6))

    def of(tick: Given) -> Given:
        if not tick.has_checkpoint or next(count) != number:
            return tick
        entries = []
        for entry in tick.entries:
            if entry.message == "Checkpoint":
                message = message_class("Checkpoint").FromString(entry.data)
                memory = json.loads(message.memory)
                edit(memory)
                message.memory = json.dumps(memory)
                entry = entry._replace(data=message.SerializeToString())
            entries.append(entry)
        return tick._replace(entries=entries)

    return of


def minus_zero(memory: list[object]) -> None:
    memory[0][7] = -1e-300  # type: ignore[index]


def one_more(memory: list[object]) -> None:
    memory[0][0][1][6][4] -= 1  # type: ignore[index]


TAMPERED = {
    "the command": (minus_zero, "checkpoint.state.command_mw -1e-300 -> "),
    "a count of a filter": (one_more, "checkpoint.state.pmus.1.filter.frames 2 -> 3"),
    "a state": (lambda memory: memory[0].__setitem__(2, "FAULT"), "checkpoint.state.system <SystemState.FAULT"),
    "a configuration": (lambda memory: memory[2][0].__setitem__(1, "0" * 16), "checkpoint.configs.0.1 '0000000000"),
    "nonsense": (lambda memory: memory.pop(), "makes no sense"),
}


@pytest.mark.parametrize(("edit", "said"), TAMPERED.values(), ids=TAMPERED)
def test_a_checkpoint_that_is_passed_is_compared(
    edit: Callable[[list[object]], object], said: str, whole: Logged, tmp_path: Path, capsys: Capsys
) -> None:
    relogged(tmp_path / "s.mcap", whole.head, whole.ticks, (), edited(2, edit))
    code, out, _ = told(capsys, str(tmp_path / "s.mcap"))
    assert code == 3 and out.startswith(
        f"1 of {len(whole.ticks)} ticks differ; first: tick {whole.ticks[600].tick_ns}: "
    )
    assert said in out.splitlines()[0]


def test_a_wrong_memory_to_resume_from_shows_in_what_follows(whole: Logged, tmp_path: Path) -> None:
    def edit(memory: list[object]) -> None:
        memory[0][5] = 3.0  # type: ignore[index]

    relogged(tmp_path / "s.mcap", whole.head, whole.ticks, range(550, 560), edited(2, edit))
    result = replay(tmp_path / "s.mcap")
    assert result.different > 100 and result.first is not None and result.first.tick_ns == whole.ticks[600].tick_ns
    assert result.first.field == "gain_mw_per_mhz"


def in_parts(whole: Logged, folder: Path, **limits: float) -> list[Path]:
    return relogged(folder / "s.mcap", whole.head, whole.ticks, **limits).parts


@pytest.mark.parametrize("limits", [{"max_minutes": 0.08}, {"max_mb": 0.05}], ids=["time", "size"])
def test_every_part_begins_with_a_checkpoint_and_replays_alone(
    limits: dict[str, float], whole: Logged, tmp_path: Path, capsys: Capsys
) -> None:
    parts = in_parts(whole, tmp_path, **limits)
    assert len(parts) > 2
    times = [tick.tick_ns for tick in whole.ticks]
    for part in parts[1:]:
        here = stamps([part])
        at = times.index(here[0])
        seen: list[Record] = []
        result = replay([part], observe=lambda _, now, seen=seen: seen.append(now))  # type: ignore[misc]
        assert at % EVERY == 0 and seen == whole.records[at : at + len(here)]
        assert (result.different, result.gaps, result.stopped) == (0, [], "")
    assert told(capsys, str(parts[-1])) == (0, f"{len(here)} ticks: identical\n", "")
    assert told(capsys, str(parts[0])) == (0, f"{len(times)} ticks: identical\n", "")
    later = len(times) - times.index(stamps(parts[1:])[0])
    assert told(capsys, *map(str, parts[1:])) == (0, f"{later} ticks: identical\n", "")


def stamps(paths: list[Path]) -> list[int]:
    return [group.tick_ns for group in SessionReader(paths).groups({"Tick"})]


def test_a_part_with_changed_settings_needs_the_first(whole: Logged, tmp_path: Path, capsys: Capsys) -> None:
    parts = in_parts(whole, tmp_path, max_minutes=0.1)
    code, _, err = told(capsys, str(parts[1]), "--set", "controller.gain_mw_per_mhz=12")
    assert code == 1 and err == f"dcon: {parts[1]}: part 2 of a session; a replay starts with the first, s.mcap\n"


def test_a_part_that_a_restart_began_replays_from_its_first_checkpoint(
    whole: Logged, tmp_path: Path, capsys: Capsys
) -> None:
    with RollingWriter(tmp_path / "s.mcap", whole.head) as log:
        for number, tick in enumerate(whole.ticks):
            for name, frame in tick.configs:
                log.config(name, frame, tick.tick_ns)
            if number == 450:
                log.lost(0, "", tick.tick_ns)  # a new part, and nothing lost
            log.write(tick.entries, tick.tick_ns)
    code, out, err = told(capsys, str(log.parts[1]))
    assert (code, out) == (3, f"{len(whole.ticks) - 600} ticks: identical\n")
    assert err == (
        f"not whole: the log lost something before tick {whole.ticks[450].tick_ns} (what is read begins with part 2); "
        "150 ticks from there on are not replayed\n"
    )
    assert told(capsys, str(log.parts[0])) == (0, f"{len(whole.ticks)} ticks: identical\n", "")


def test_a_full_part_does_not_wait_for_ever(whole: Logged, tmp_path: Path) -> None:
    """Checkpoints that stop to come hold no part open."""
    ticks = [tick if number < 100 else without("Checkpoint")(tick) for number, tick in enumerate(whole.ticks)]
    log = relogged(tmp_path / "s.mcap", whole.head, ticks, max_minutes=0.05)
    firsts = [stamps([part])[0] for part in log.parts[1:]]
    assert (firsts[0] - whole.ticks[0].tick_ns) / NS == pytest.approx(10, abs=0.1)
    assert (firsts[1] - firsts[0]) / NS == pytest.approx(3, abs=0.1)
