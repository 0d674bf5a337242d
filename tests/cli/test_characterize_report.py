"""``pmu characterize`` with its report."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from support.commands import run_here
from support.webpage import parsed

PDC = Path(__file__).parents[2] / "captures" / "cjb-pdc-30fps.pcapng"


def test_a_recording_gets_a_page_with_its_intervals_and_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    arguments = ["characterize", PDC, "--out", out, "--interval", 2, "--require", "delay_p99<=1s"]
    monkeypatch.setattr(sys, "argv", ["/usr/bin/pmu", *map(str, arguments)])
    result = run_here(*arguments)
    assert result.code == 0, result.err
    assert f"{out / 'report.html'}, {out / 'figures'}" in result.err
    words = parsed((out / "report.html").read_text(encoding="utf-8")).words()
    assert "Acceptable" in words and "Interval by interval" in words
    assert f"pmu characterize {PDC} --out {out}" in words and "'delay_p99<=1s'" in words
    assert (out / "figures" / "intervals.svg").exists()
    assert "(receiver clock: a recording does not say how good its clock was): they have no ±." in words
