"""The ``dcon`` command line: exit codes, one line an error, data on stdout, and what starts cheaply."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from support.swing import Streams

from dcon.cli import COMMANDS, dcon
from dcon.core.rows import CORE
from pmutools.cli.shell import run

Capsys = pytest.CaptureFixture[str]
NAMES = ("N1", "N2", "N3", "N4", "S1", "S2", "S3", "S4")
COLUMNS = [
    *("tick_ns", "state", "mode", "active_instance", "gain_mw_per_mhz", "delta_f_mhz", "command_mw"),
    *("output_v", "pdci_mw", "flags"),
    *(f"f_{name}_hz" for name in NAMES),
    *(f"age_{name}_ms" for name in NAMES),
    *("compute_us", "late_us"),
]
"""What follows them has been added since."""


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cli")
    assert run(dcon(), ["simulate", "cjb", "--duration", "6", "--out", str(folder), "--quiet"]) == 0
    return folder / "session.mcap"


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".jsonl"])
def test_a_simulated_session_exports_with_the_documented_columns(
    suffix: str, session: Path, tmp_path: Path, capsys: Capsys
) -> None:
    out = tmp_path / f"ticks{suffix}"
    assert run(dcon(), ["export", str(session), str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"rows": 360, "gaps": 0, "damage": [], "newer": None, "missing": []}
    if suffix == ".csv":
        rows = list(csv.DictReader(out.read_text().splitlines()))
    elif suffix == ".jsonl":
        rows = [json.loads(line) for line in out.read_text().splitlines()]
    else:
        table = pq.read_table(out)
        assert json.loads(table.schema.metadata[b"flags"]) == list(CORE.names)
        assert table["command_mw"].null_count == 0
        rows = table.to_pylist()
    assert list(rows[0])[: len(COLUMNS)] == COLUMNS
    assert len(rows) == 360
    assert all(round((int(b["tick_ns"]) - int(a["tick_ns"])) * 60 / 1e9) == 1 for a, b in pairwise(rows))
    assert rows[-1]["active_instance"] == "N1-S1" and rows[0]["active_instance"] in (None, "")
    assert {row["state"] for row in rows} == {"INIT", "STANDBY", "ARMED", "ACTIVE"}
    assert {row["mode"] for row in rows} == {"closed_loop"}
    assert float(rows[-1]["output_v"]) == pytest.approx(float(rows[-1]["command_mw"]) / 12.5)
    assert float(rows[-1]["f_N1_hz"]) == pytest.approx(60, abs=0.02)
    assert float(rows[-1]["age_N1_ms"]) == pytest.approx(71, abs=0.01)


@pytest.mark.parametrize(("table", "rows"), [("instance", 360 * 16), ("pmu", 360 * 8)])
def test_the_other_tables(table: str, rows: int, session: Path, tmp_path: Path, capsys: Capsys) -> None:
    out = tmp_path / "x.parquet"
    assert run(dcon(), ["export", str(session), str(out), "--table", table]) == 0
    assert capsys.readouterr().err == f"{rows} rows -> {out}\n"
    assert pq.read_metadata(out).num_rows == rows


def test_a_cut_session_exports_what_there_is(session: Path, tmp_path: Path, capsys: Capsys) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(session.read_bytes()[:-5000])
    assert run(dcon(), ["export", str(cut), str(tmp_path / "x.csv")]) == 3
    assert "cut" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["export", "none.mcap", "x.csv"], 1),
        (["export", "none.mcap", "x.txt"], 2),
        (["export", "none.mcap"], 2),
        (["replay", "none.mcap"], 1),
        (["simulate"], 2),
        (["simulate", "cjb", "--gain", "-1"], 2),
        (["simulate", "cjb", "--duration", "0"], 2),
        (["platform"], 2),
        (["platform", "--ini", "none.ini"], 1),
        (["platform", "--ini", "dcon.ini", "--order", "arm"], 2),
        (["platform", "--ini", "dcon.ini", "--start", "yesterday"], 2),
        (["platform", "--ini", "dcon.ini", "--log", "no/such/folder.mcap", "--duration", "1"], 1),
        (["check", "--ini", "none.ini"], 1),
        (["nothing"], 2),
        (["--version"], 0),
        (["--help"], 0),
        *(([name, "--help"], 0) for name in COMMANDS),
    ],
)
def test_exit_codes_and_no_traceback(
    arguments: list[str], code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("dcon.control.loop.prepare", lambda *, fifo: None)
    urls = ["udp://127.0.0.1:0?source=127.0.0.1", "udp://127.0.0.1:0"]
    Path("dcon.ini").write_text(Streams(("N1", "S1")).ini(urls=urls))
    assert run(dcon(), arguments) == code
    out, err = capsys.readouterr()
    assert "Traceback" not in err
    if code == 1:
        assert out == "" and err.startswith("dcon: ") and err.count("\n") == 1


@pytest.mark.parametrize(("pdci", "warns"), [("", True), ("required = no", False)])
def test_a_platform_alone_says_what_nobody_tells_it(
    pdci: str, warns: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("dcon.control.loop.prepare", lambda *, fifo: None)
    urls = ["udp://127.0.0.1:0?source=127.0.0.1", "udp://127.0.0.1:0"]
    Path("dcon.ini").write_text(Streams(("N1", "S1")).ini(urls=urls, pdci=pdci))
    assert run(dcon(), ["platform", "--ini", "dcon.ini", "--log", "no/such/folder.mcap"]) == 1, "it ends at once"
    err = capsys.readouterr().err
    assert err.startswith("warning: alone, nobody tells what is required (line), so nothing can be armed\n") == warns


def test_an_operator_who_may_order_nothing_by_mistake_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(dcon(), ["keys", "Ada", "--file", "k", "--may", ""]) == 2 and not Path("k").exists()
    assert capsys.readouterr().err == "dcon: --may: names no order; leave it out for all of them\n"
    assert run(dcon(), ["keys", "Ada", "--file", "k", "--may", "disarm,estop"]) == 0
    assert "may = disarm,estop" in Path("k").read_text() or "may = estop,disarm" in Path("k").read_text()


def test_an_error_that_nobody_expected_is_one_line_too(
    session: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    monkeypatch.setattr("dcon.replay.replay.replay", lambda *args: 1 // 0)
    assert run(dcon(), ["replay", str(session)]) == 1
    err = capsys.readouterr().err
    assert err == "dcon: internal error: ZeroDivisionError: integer division or modulo by zero (--debug shows where)\n"


@pytest.mark.parametrize("module", ["dcon.cli", "dcon.cli.platform", "dcon.control.loop"])
def test_nothing_heavy_is_imported_before_sockets_are_open(module: str) -> None:
    heavy = ["numpy", "scipy", "pyarrow", "matplotlib", "mcap", "scapy", "rich"]
    code = f"import sys, {module}; print([name for name in {heavy} if name in sys.modules])"
    env = {key: value for key, value in os.environ.items() if not key.startswith("COV")}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30, env=env, check=True)
    assert done.stdout == "[]\n"
