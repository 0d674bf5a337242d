"""The benchmark runs, and what it compares is equal. No timings: those are for ``make bench``."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from bench import (
    analyzing,
    capture,
    characterizing,
    codec,
    control,
    measuring,
    pacing,
    reading,
    receiving,
    startup,
    table,
    waking,
)
from bench.layouts import BLOCK, LAYOUTS, A, B, C, Layout
from bench.stopwatch import Rate
from bench.table import Budget, Row

from pmutools import linux

NAMES = [layout.name for layout in LAYOUTS]


@pytest.mark.parametrize(("layout", "size"), list(zip(LAYOUTS, (34, 68, 352), strict=True)), ids=NAMES)
def test_layouts_are_those_of_the_table(layout: Layout, size: int) -> None:
    assert layout.config.frame_size == size
    assert str(size) in layout.text
    frames = layout.frames(BLOCK + 1)
    assert [len(batch) for batch in frames.batches] == [BLOCK, 1]
    assert b"".join(frames.singles) == frames.data


@pytest.mark.peer
@pytest.mark.parametrize("layout", LAYOUTS, ids=NAMES)
def test_all_contenders_read_the_same_values(layout: Layout) -> None:
    codec.check(layout.frames(60))


@pytest.mark.peer
@pytest.mark.parametrize("layout", [B, C], ids=["B", "C"])
def test_columns_are_what_tshark_prints(layout: Layout, tmp_path: Path, requires: Callable[[str], Path]) -> None:
    requires("tshark")
    capture.check(capture.write(tmp_path / "check.pcap", layout.frames(50)))


@pytest.mark.peer
def test_every_group_gives_its_rows() -> None:
    rows = [*codec.rows(codec.QUICK), *startup.rows(startup.QUICK), *control.rows(control.QUICK)]
    rows += [*analyzing.rows(analyzing.QUICK), *measuring.rows(measuring.QUICK), *reading.rows(reading.QUICK)]
    rows += [*characterizing.rows(characterizing.QUICK)]
    if shutil.which("tshark"):
        rows += capture.rows(capture.QUICK)
        assert {row.group for row in rows} == {"codec", "capture", "start-up", "control", "measure", "read"}
    assert all(row.result > 0 for row in rows)
    assert {row.group for row in rows if row.budget} == {row.group for row in rows}
    lines = table.markdown(rows, ["How."]).splitlines()
    assert len(lines) == len(rows) + 4
    assert {line.count("|") for line in lines[2:]} == {len(table.HEAD) + 1}


@pytest.mark.peer
@pytest.mark.realtime
def test_the_player_is_watched_beside_tcpreplay(requires: Callable[[str], Path]) -> None:
    requires("tcpreplay")
    requires("tcpdump")
    if os.geteuid():
        pytest.skip("tcpdump and tcpreplay need root to look at loopback")
    rows = list(pacing.rows(pacing.QUICK))
    assert len(rows) == 4
    assert all(row.budget is not None and row.group == "player" for row in rows)


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.skipif(sys.platform != "linux", reason="dcon run is Linux's")
def test_the_control_loop_is_judged_beside_cyclictest() -> None:
    rows = list(waking.rows(waking.QUICK))
    assert [row.group for row in rows] == ["control"] * 3
    assert [row.budget is not None for row in rows] == [bool(shutil.which("cyclictest"))] * 2 + [True]
    assert all(row.result > 0 and "steal" in row.ours for row in rows)


@pytest.mark.realtime
@pytest.mark.skipif(not linux.NATIVE, reason="the sender needs sendmmsg")
def test_receiving_is_measured_over_udp_and_tcp() -> None:
    for cost in (receiving.taken(20, 10, A, 0.3), receiving.connected(5, A, 0.3)):
        assert cost.frames > 0
        assert 0 < cost.cpu_s < cost.wall_s * 2
        assert cost.us > 0


def test_what_is_not_installed_is_one_line() -> None:
    program = Path(__file__).with_name("run.py")
    done = subprocess.run([sys.executable, "-I", "-S", program, "--quick"], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("bench: not installed: pmutools, pytest, synchrophasor, pyc37, fastcrc; pip install")
    assert done.stderr.count("\n") == 1


def test_a_ratio_is_that_of_the_rounds() -> None:
    """One slow round of both is no news; a mean would make it some."""
    ours, theirs = Rate((100.0, 10.0, 120.0)), Rate((10.0, 1.0, 10.0))
    assert ours.over(theirs) == 10
    row = table.faster("codec", "this", ours, "that", theirs, at_least=11)
    assert row.missed
    assert row.cells == ("this", "100/s ±28 %", "that: 10/s ±22 %", "10x", "at least 11x", "missed")
    assert table.within("codec", "this", theirs, "that", ours, at_most=10).missed is False


def test_a_budget_has_a_side() -> None:
    assert Budget("at most", 1).met(1)
    assert not Budget("at most", 1).met(1.01)
    assert Budget("at least", 30).met(30)
    assert not Budget("at least", 30).met(29.9)
    assert not Row("control", "", "", "", 1e9, "x").missed
