"""No command destroys what it reads, nor a session that is there; a table is there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from support.sessions import random_ticks, write_session

from dcon.cli import dcon
from dcon.export import export as export_module
from dcon.export.export import export
from pmutools.cli.shell import run
from pmutools.errors import SourceError
from pmutools.formats.output import whole

Capsys = pytest.CaptureFixture[str]
OUTPUTS = {
    "replay": ["o.csv", "replay", "--out", "o.csv"],
    "export": ["o.csv", "export", "o.csv"],
    "analyze to the page": ["report.html", "analyze", "--out", "."],
    "analyze to the JSON": ["analysis.json", "analyze", "--out", "."],
    "analyze to a figure": ["figures/any.png", "analyze", "--out", "."],
}


@pytest.fixture
def session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Of two parts, in the present folder."""
    monkeypatch.chdir(tmp_path)
    ticks = random_ticks(20)
    write_session(Path("x.part2.mcap"), ticks)
    return write_session(Path("x.mcap"), ticks)


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("link", [os.symlink, os.link])
@pytest.mark.parametrize("part", ["x.mcap", "x.part2.mcap"])
@pytest.mark.parametrize("output", OUTPUTS.values(), ids=OUTPUTS)
def test_an_input_by_another_name_is_never_the_output(
    output: list[str], part: str, link: Callable[[Any, Any], None], session: Path, tmp_path: Path, capsys: Capsys
) -> None:
    target, command, *rest = output
    Path(target).parent.mkdir(exist_ok=True)
    link(tmp_path / part, target)
    before = contents(tmp_path)
    assert run(dcon(), [command, str(session), *rest]) == 2
    err = capsys.readouterr().err
    assert f"{target} is an input, and would be overwritten" in err and err.count("\n") == 1
    assert contents(tmp_path) == before


@pytest.mark.parametrize("arguments", [["replay", "x.mcap", "--out", "x.mcap"], ["export", "x.csv", "./x.csv"]])
def test_nor_by_its_own(arguments: list[str], session: Path, tmp_path: Path, capsys: Capsys) -> None:
    session.rename(arguments[1])
    before = contents(tmp_path)
    assert run(dcon(), arguments) == 2
    assert "is an input, and would be overwritten" in capsys.readouterr().err
    assert contents(tmp_path) == before


def test_commands_are_not_written_over_another_log(session: Path, tmp_path: Path, capsys: Capsys) -> None:
    Path("y.mcap").write_bytes(b"another session")
    assert run(dcon(), ["replay", "x.mcap", "--out", "y.mcap"]) == 2
    assert "y.mcap: commands are written as CSV; name it y.csv" in capsys.readouterr().err
    assert Path("y.mcap").read_bytes() == b"another session"


@pytest.mark.parametrize("sweep", [[], ["--sweep", "gain=9:10:1"]])
def test_a_simulation_destroys_no_session(
    sweep: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = ["simulate", "ambient", "--duration", "0.1", "--out", "runs", "--quiet", *sweep]
    assert run(dcon(), arguments) == 0
    before = contents(tmp_path)
    capsys.readouterr()
    assert run(dcon(), arguments) == 2
    out, err = capsys.readouterr()
    name = "session-1.mcap" if sweep else "session.mcap"
    assert (out, err) == (
        "",
        f"dcon: runs/{name} is there already, and would be overwritten; write to another folder\n",
    )
    assert contents(tmp_path) == before


@pytest.mark.parametrize("suffix", ["csv", "csv.gz", "jsonl", "parquet", "arrow"])
@pytest.mark.parametrize("earlier", [None, b"an earlier table"])
def test_a_failed_export_leaves_what_was_there(
    suffix: str, earlier: bytes | None, session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / f"t.{suffix}"
    if earlier is not None:
        out.write_bytes(earlier)
    before = contents(tmp_path)
    monkeypatch.setattr(export_module, "BATCH_ROWS", 8)
    rows = export_module._Rows.batches

    def failing(self: Any) -> Iterator[Sequence[Any]]:
        yield next(rows(self))
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(export_module._Rows, "batches", failing)
    with pytest.raises(SourceError, match="cannot write: No space left on device"):
        export(session, out)
    assert contents(tmp_path) == before


def test_a_failed_replay_leaves_no_file(session: Path, tmp_path: Path, capsys: Capsys) -> None:
    before = contents(tmp_path)  # its initialisation file names no PMU
    assert run(dcon(), ["replay", "x.mcap", "--out", "o.csv"]) == 2
    assert "no [pmu NAME] section" in capsys.readouterr().err
    assert contents(tmp_path) == before


def test_what_is_no_regular_file_is_written_as_it_stands(tmp_path: Path) -> None:
    with whole(Path("/dev/null")) as path:
        assert path == Path("/dev/null")
    target, link = tmp_path / "a.csv", tmp_path / "b.csv"
    target.write_text("old")
    link.symlink_to(target)
    with whole(link) as path:
        path.write_text("new")
        assert target.read_text() == "old"
    assert link.is_symlink() and target.read_text() == "new" and len(list(tmp_path.iterdir())) == 2
