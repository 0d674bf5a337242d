"""``dcon replay``: the same records bit for bit, or the first difference; and whatever may be wrong with a log."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import pytest
from support.sessions import log_tick

from dcon.cli import dcon
from dcon.core.values import Event, Order, Pdci, Record, Surroundings
from dcon.engine import Engine
from dcon.replay.difference import identical
from dcon.replay.replay import replay
from dcon.session import codec
from dcon.session.defaults import former
from dcon.session.head import Head
from dcon.session.reader import LoggedTick, SessionReader
from dcon.session.writer import SessionWriter
from dcon.settings import parse
from dcon.sim.plan import Plan
from dcon.sim.simulate import simulate
from pmutools.cli.shell import run
from pmutools.flow import StampSource
from pmutools.schema.log_writer import LogWriter
from pmutools.schema.pmu_log import PmuFrame

Capsys = pytest.CaptureFixture[str]
Edit = Callable[[LoggedTick], LoggedTick]
PLAN = Plan(gain_mw_per_mhz=12, faults=("table1-delays",), noise_rad=1e-4, duration_s=6)


EDITED = 330
"""The tick that tampering is with: the brake is in, and the command far from 0."""


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("replay") / "session.mcap"
    simulate(PLAN, str(path))
    return path


def rewritten(session: Path, out: Path, edit: Edit = lambda tick: tick, ini: str | None = None) -> Path:
    """The session written anew, every tick through ``edit``."""
    reader = SessionReader(session)
    metadata = {key: value for key, value in reader.metadata.items() if key not in ("pmus", "instances", "flags")}
    head = Head(reader.ini_text if ini is None else ini, reader.pmus, reader.instances, reader.flags, metadata)
    with SessionWriter(out, head, reader.configs) as log:
        for number, tick in enumerate(reader.ticks()):
            changed = edit(tick) if number == EDITED else tick
            log_tick(
                log, changed.record, changed.frames, changed.orders, timing=changed.timing, instances=reader.instances
            )
    return out


def told(capsys: Capsys, *arguments: str) -> tuple[int, str, str]:
    code = run(dcon(), ["replay", *arguments])
    out, err = capsys.readouterr()
    return code, out, err


def test_a_simulated_session_replays_bit_for_bit(session: Path, capsys: Capsys) -> None:
    code, out, _ = told(capsys, str(session))
    assert (code, out) == (0, "360 ticks: identical\n")
    code, out, _ = told(capsys, str(session), "--json")
    assert code == 0
    assert json.loads(out) == {
        "ticks": 360,
        "not_replayed": 0,
        "different": 0,
        "first": None,
        "changes": [],
        "gaps": [],
        "stopped": None,
        "problems": [],
        "newer": None,
        "largest_command_change_mw": 0.0,
        "largest_probe_change_mw": 0.0,
        "largest_output_change_v": 0.0,
        "note": None,
    }


def test_the_records_are_those_of_the_log(session: Path) -> None:
    ticks = list(SessionReader(session).ticks())
    seen: list[Record] = []
    replay(session, observe=lambda recorded, now: seen.append(now))
    assert len(seen) == len(ticks)
    assert all(identical(tick.record, now) for tick, now in zip(ticks, seen, strict=True))
    assert max(abs(tick.record.command_mw) for tick in ticks) > 30  # there was something to get wrong
    assert sum(len(tick.record.events) for tick in ticks) > 20


def test_a_session_written_anew_is_the_same(session: Path, tmp_path: Path, capsys: Capsys) -> None:
    assert told(capsys, str(rewritten(session, tmp_path / "again.mcap")))[0] == 0


def frame_changed(**given: object) -> Edit:
    def edit(tick: LoggedTick) -> LoggedTick:
        first, *others = tick.frames
        return tick._replace(frames=(first._replace(**given), *others))  # type: ignore[arg-type]

    return edit


def bit_flipped(at: int) -> Edit:
    def edit(tick: LoggedTick) -> LoggedTick:
        wire = bytearray(tick.frames[0].wire)
        wire[at] ^= 1
        return frame_changed(wire=bytes(wire))(tick)

    return edit


def record_changed(**given: object) -> Edit:
    return lambda tick: tick._replace(record=tick.record._replace(**given))  # type: ignore[arg-type]


def instance_changed(tick: LoggedTick) -> LoggedTick:
    instances = list(tick.record.instances)
    instances[3] = instances[3]._replace(command_mw=1.0)
    return tick._replace(record=tick.record._replace(instances=tuple(instances)))


TAMPERED: dict[str, tuple[Edit, str]] = {
    "a bit of V1": (bit_flipped(20), "CHK does not hold"),
    "a bit of a current": (bit_flipped(50), "CHK does not hold"),
    "a bit of CHK": (bit_flipped(-1), "CHK does not hold"),
    "a bit of SYNC": (bit_flipped(0), "of them readable"),
    "the decoded frequency": (frame_changed(frequency_hz=61.0), "decodes otherwise"),
    "the arrival": (lambda tick: frame_changed(arrival_ns=tick.frames[0].time_ns + 95_000_000)(tick), "flags 0 -> "),
    "a frame lost": (lambda tick: tick._replace(frames=tick.frames[1:]), "f_hz."),
    "the command": (record_changed(command_mw=1.5), "command_mw 1.5 -> "),
    "minus zero": (record_changed(probe_mw=-0.0), "probe_mw -0.0 -> 0.0"),
    "an instance": (instance_changed, "instances.3.command_mw 1.0 -> "),
    "an event": (record_changed(events=(Event("selected", "N1-S1"),)), "events (Event(name='selected'"),
}


@pytest.mark.parametrize(("edit", "said"), TAMPERED.values(), ids=TAMPERED)
def test_a_changed_log_is_told_with_the_first_difference_and_its_inputs(
    edit: Edit, said: str, session: Path, tmp_path: Path, capsys: Capsys
) -> None:
    path = rewritten(session, tmp_path / "tampered.mcap", edit)
    code, out, _ = told(capsys, str(path))
    assert code == 3
    head, _, first = out.partition(" of 360 ticks differ; first: ")
    assert int(head) >= 1
    ticks = list(SessionReader(path).ticks())
    tick, before = ticks[EDITED], ticks[EDITED - 1].record
    what, *inputs = first.splitlines()
    assert what.startswith(f"tick {tick.record.tick_ns}: ") and said in what
    assert inputs[0] == (f"  before: ACTIVE closed_loop, N1-S1 active, 12 MW/mHz, command {before.command_mw!r} MW")
    assert len(inputs) == 1 + len(tick.frames)
    for line, frame in zip(inputs[1:], tick.frames, strict=True):
        assert line.startswith(
            f"  {frame.name}: stamp {frame.time_ns}, arrival {frame.arrival_ns}, V1 {abs(frame.v1):.3f} V"
        )
        assert f"{frame.frequency_hz:.6f} Hz" in line


def test_a_difference_to_another_version_is_told(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    path = rewritten(session, tmp_path / "x.mcap", record_changed(command_mw=1.5))
    monkeypatch.setattr("pmutools.__version__", "99.0")
    code, _, err = told(capsys, str(path))
    assert code == 3 and err.startswith("recorded by version 0.") and err.endswith(", replayed by 99.0\n")
    assert told(capsys, str(session))[0] == 0


def test_the_first_difference_as_json(session: Path, tmp_path: Path, capsys: Capsys) -> None:
    path = rewritten(session, tmp_path / "x.mcap", record_changed(command_mw=1.5))
    code, out, _ = told(capsys, str(path), "--json")
    tick = list(SessionReader(path).ticks())[EDITED]
    first = json.loads(out)["first"]
    assert (code, first["tick_ns"], first["field"], first["recorded"]) == (3, tick.record.tick_ns, "command_mw", 1.5)
    assert first["orders"] == [] and first["before"].startswith("ACTIVE closed_loop, N1-S1 active")
    assert [(f["pmu"], f["time_ns"], f["arrival_ns"], f["v1_re"]) for f in first["frames"]] == [
        (f.name, f.time_ns, f.arrival_ns, f.v1.real) for f in tick.frames
    ]


def test_orders_are_among_the_inputs(session: Path, tmp_path: Path, capsys: Capsys) -> None:
    def edit(tick: LoggedTick) -> LoggedTick:
        return tick._replace(orders=(Order("gain", 3.0), Order("estop")))

    code, out, _ = told(capsys, str(rewritten(session, tmp_path / "x.mcap", edit)))
    assert code == 3 and "state <SystemState.ACTIVE: 'ACTIVE'> -> <SystemState.ESTOP: 'ESTOP'>" in out
    assert out.endswith("  order: gain 3\n  order: estop\n")


def test_other_bytes_of_the_same_values_are_no_difference(session: Path, tmp_path: Path, capsys: Capsys) -> None:
    """As another protobuf library may write them: here, with a field that this version does not know."""
    path = tmp_path / "x.mcap"
    encode = codec.encode_tick
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(codec, "encode_tick", lambda *given: encode(*given) + b"\x9a\x06\x03new")
        rewritten(session, path)
    assert told(capsys, str(path))[:2] == (0, "360 ticks: identical\n")


def test_events_of_the_log_are_not_the_controllers(session: Path, tmp_path: Path, capsys: Capsys) -> None:
    def edit(tick: LoggedTick) -> LoggedTick:
        events = (*tick.record.events, Event("log_gap", "log", "3 ticks were not logged"))
        return tick._replace(record=tick.record._replace(events=events))

    assert told(capsys, str(rewritten(session, tmp_path / "x.mcap", edit)))[:2] == (0, "360 ticks: identical\n")


def test_settings_can_be_changed(session: Path, tmp_path: Path, capsys: Capsys) -> None:
    out_path = tmp_path / "commands.csv"
    code, out, _ = told(capsys, str(session), "--set", "controller.gain_mw_per_mhz=6", "--out", str(out_path))
    assert code == 0
    assert "with controller.gain_mw_per_mhz=6: commands differ by up to" in out
    rows = list(csv.DictReader(out_path.read_text().splitlines()))
    assert len(rows) == 360
    for row in rows[310:330]:  # the brake is in: half the gain is half the command
        assert float(row["replayed_command_mw"]) == pytest.approx(float(row["recorded_command_mw"]) / 2, rel=1e-9)
    code, out, _ = told(capsys, str(session), "--set", "controller.gain_mw_per_mhz=12")
    assert code == 0 and "differ by up to 0.000 MW, probing signals by 0.000 MW, outputs by 0.0000 V" in out


def test_a_change_of_the_probing_signal_is_seen(tmp_path: Path, capsys: Capsys) -> None:
    path, table = tmp_path / "probed.mcap", tmp_path / "commands.csv"
    simulate(Plan("square-pulse", duration_s=8.0, control=False), str(path))
    change = ("--set", "probing.amplitude_mw=50")
    code, out, _ = told(capsys, str(path), *change, "--out", str(table))
    assert code == 0
    assert "commands differ by up to 0.000 MW, probing signals by 75.000 MW, outputs by 6.0000 V. This is the" in out
    rows = list(csv.DictReader(table.read_text().splitlines()))
    for which, largest in (("recorded", 125), ("replayed", 50)):
        assert max(abs(float(row[f"{which}_probe_mw"])) for row in rows) == largest
        assert max(abs(float(row[f"{which}_output_v"])) for row in rows) == largest / 12.5
    code, out, _ = told(capsys, str(path), *change, "--json")
    found = json.loads(out)
    assert (code, found["largest_command_change_mw"]) == (0, 0.0)
    assert found["largest_probe_change_mw"] == pytest.approx(75.0)
    assert found["largest_output_change_v"] == pytest.approx(6.0) and "not the grid" in found["note"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("controller.gain=6", "--set: [controller] gain: unknown key"),
        ("controller.gain_mw_per_mhz=60", "--set: [controller] gain_mw_per_mhz: 60 MW/mHz is above"),
        ("controller.gain_mw_per_mhz=60", "may set controller.gain_max_mw_per_mhz too"),
        ("gain=6", "--set: 'gain=6' is not SECTION.KEY=VALUE"),
    ],
)
def test_a_change_that_cannot_be(change: str, said: str, session: Path, capsys: Capsys) -> None:
    code, _, err = told(capsys, str(session), "--set", change)
    assert code == 2 and said in err and err.count("\n") == 1


def test_a_gain_beyond_the_operators_needs_its_maximum_too(session: Path, capsys: Capsys) -> None:
    changes = ("--set", "controller.gain_mw_per_mhz=60", "--set", "controller.gain_max_mw_per_mhz=60")
    code, out, _ = told(capsys, str(session), *changes[2:], *changes[:2])
    assert code == 0 and "commands differ by up to" in out


def test_quiet_says_it_by_the_exit_code(session: Path, tmp_path: Path, capsys: Capsys) -> None:
    assert told(capsys, str(session), "--quiet") == (0, "", "")
    changed = rewritten(session, tmp_path / "x.mcap", record_changed(command_mw=1.0))
    assert told(capsys, str(changed), "--quiet") == (3, "", "")


def test_a_duration_is_of_the_session(session: Path, tmp_path: Path, capsys: Capsys) -> None:
    table = tmp_path / "t.csv"
    for seconds, ticks in (("2", 120), ("0.001", 1), ("1e3", 360)):
        code, out, err = told(capsys, str(session), "--duration", seconds, "--out", str(table))
        assert (code, out, err) == (0, f"{ticks} ticks: identical\n", "")
        assert len(table.read_text().splitlines()) == ticks + 1
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(session.read_bytes()[:-5000])
    assert told(capsys, str(cut), "--duration", "2")[0] == 0  # what is behind is not asked for
    assert told(capsys, str(cut))[0] == 3
    assert told(capsys, str(session), "--duration", "0")[0] == 2


@pytest.mark.parametrize("how", ["itself", "a link", "a hard link"])
def test_an_output_is_no_probing_signal_that_is_read(how: str, session: Path, tmp_path: Path, capsys: Capsys) -> None:
    signal, out = tmp_path / "p.csv", tmp_path / ("p.csv" if how == "itself" else "o.csv")
    signal.write_text("probe_mw\n1.5\n-2\n")
    if how == "a link":
        out.symlink_to(signal)
    elif how == "a hard link":
        out.hardlink_to(signal)
    changes = ("--set", "probing.kind=file", "--set", f"probing.file = {signal}")
    code, _, err = told(capsys, str(session), *changes, "--out", str(out))
    assert code == 2 and "is an input, and would be overwritten" in err
    assert signal.read_text() == "probe_mw\n1.5\n-2\n"
    assert told(capsys, str(session), *changes, "--out", str(tmp_path / "other.csv"))[0] == 0


def test_a_cut_log_replays_to_the_cut_and_says_so(session: Path, tmp_path: Path, capsys: Capsys) -> None:
    path = tmp_path / "cut.mcap"
    whole = session.read_bytes()
    path.write_bytes(whole[: len(whole) * 2 // 3])
    code, out, err = told(capsys, str(path))
    assert code == 3
    assert 100 < int(out.split()[0]) < 360 and "ticks: identical" in out
    assert "stopped: the log has no intact end" in err


def test_a_hole_in_a_log_ends_the_replay_there(session: Path, tmp_path: Path, capsys: Capsys) -> None:
    path = tmp_path / "hole.mcap"
    whole = bytearray(rewritten(session, path).read_bytes())  # without checkpoints
    middle = len(whole) // 2
    whole[middle : middle + 64] = bytes(64)
    path.write_bytes(whole)
    code, out, err = told(capsys, str(path))
    assert code == 3
    assert int(out.split()[0]) < 360
    assert "stopped: the log lost something before tick" in err


def foreign(path: Path) -> None:
    with LogWriter(path) as log:
        log.metadata("other", {"key": "value"})


def no_ini(path: Path) -> None:
    with SessionWriter(path, Head("")):
        pass


NO_SESSIONS: dict[str, tuple[Callable[[Path], object], str]] = {
    "no file": (lambda path: None, "No such file or directory"),
    "an empty file": (lambda path: path.write_bytes(b""), "empty file"),
    "text": (lambda path: path.write_text("tick_ns,command_mw\n"), "not an MCAP file"),
    "another MCAP file": (foreign, "not a session log"),
    "no settings": (no_ini, "holds no initialisation file (its beginning is lost), so no replay"),
    "a folder": (lambda path: path.mkdir(), "Is a directory"),
}


@pytest.mark.parametrize(("make", "said"), NO_SESSIONS.values(), ids=NO_SESSIONS)
def test_what_is_no_session_fails_in_one_line(
    make: Callable[[Path], object], said: str, tmp_path: Path, capsys: Capsys
) -> None:
    path = tmp_path / "x.mcap"
    make(path)
    code, out, err = told(capsys, str(path))
    assert (code, out) == (1, "")
    assert err.startswith(f"dcon: {path}: ") and said in err and err.count("\n") == 1


def test_a_session_without_ticks(session: Path, tmp_path: Path, capsys: Capsys) -> None:
    path = tmp_path / "x.mcap"
    reader = SessionReader(session)
    with SessionWriter(path, Head(reader.ini_text, reader.pmus)):
        pass
    code, _, err = told(capsys, str(path))
    assert code == 1 and err == f"dcon: {path}: holds no tick\n"


def test_settings_that_cannot_be_name_the_log_and_the_line(session: Path, tmp_path: Path, capsys: Capsys) -> None:
    path = rewritten(session, tmp_path / "x.mcap", ini="[controller]\ngain = 9\n[pmu A]\nurl = udp://h:1\n")
    code, _, err = told(capsys, str(path))
    assert code == 2 and err.startswith(f"dcon: {path}: initialisation file:2: [controller] gain: unknown key")


def test_an_output_that_cannot_be_written(session: Path, tmp_path: Path, capsys: Capsys) -> None:
    code, _, err = told(capsys, str(session), "--out", str(tmp_path / "no" / "x.csv"))
    assert code == 1 and err.startswith("dcon: --out ") and err.count("\n") == 1


def test_a_frame_of_a_pmu_that_the_settings_lack_is_a_difference(session: Path, tmp_path: Path, capsys: Capsys) -> None:
    path = rewritten(session, tmp_path / "x.mcap", frame_changed(name="N9"))
    code, out, _ = told(capsys, str(path))
    assert code == 3 and "frame '8 frames' -> '7 of them readable'" in out


def test_equal_to_the_last_bit() -> None:
    nan = float("nan")
    frame = PmuFrame(
        "N1", b"", 0, None, StampSource.USER, 0, 0, nan, v1=complex(nan, -0.0), phasors=(complex(nan, nan),)
    )
    assert identical(frame, frame._replace(frequency_hz=float("nan"), v1=complex(float("nan"), -0.0)))
    assert not identical(frame, frame._replace(v1=complex(nan, 0.0)))
    assert not identical((1.0, 2.0), (1.0,))
    assert not identical(0.0, -0.0)
    assert identical((1, "a", None), (1, "a", None))


def test_a_damaged_configuration_is_a_problem_that_is_told(session: Path, tmp_path: Path, capsys: Capsys) -> None:
    path = tmp_path / "x.mcap"
    reader = SessionReader(session)
    configs = dict(reader.configs)
    configs["N1"] = configs["N1"][:-1] + b"\0"
    head = Head(reader.ini_text, reader.pmus, reader.instances, metadata={"verified": "true"})
    with SessionWriter(path, head, configs) as log:
        for tick in list(reader.ticks())[:30]:
            log_tick(log, tick.record, tick.frames, tick.orders, instances=reader.instances)
    code, _, err = told(capsys, str(path))
    assert code == 3 and "N1: CHK is" in err


@pytest.mark.parametrize(("metadata", "different"), [({"defaults": "1"}, 0), ({}, 1)])
def test_a_log_is_replayed_with_the_defaults_that_it_was_recorded_under(
    metadata: dict[str, str], different: int, tmp_path: Path
) -> None:
    """A status of the line 5 s old counted by default as known, and does no more."""
    text = "[pmu A]\nurl = udp://h:1\nside = north\n[pmu B]\nurl = udp://h:2\nside = south\n"
    settings = parse(text, "x", ("pdci.status_age_s=10",))
    engine = Engine(settings.params, settings.sites)
    tick_ns = 1_700_000_000 * 10**9
    told = Surroundings(pdci=Pdci(tick_ns - 5 * 10**9, 2000.0, False, True, 2000.0))
    tick = engine.tick({}, (), tick_ns, told)
    path = tmp_path / "x.mcap"
    names = settings.params.instance_names
    with SessionWriter(path, Head(text, ("A", "B"), names, metadata=metadata)) as log:
        log_tick(log, tick.record, instances=names, pdci=told.pdci, surroundings=told)
    assert former({}) == former({"defaults": "1"}) == ("pdci.status_age_s=10", "pdci.required=no")
    assert former({"defaults": "2"}) == ("pdci.required=no",) and former({"defaults": "3"}) == ()
    assert replay(path).different == different
