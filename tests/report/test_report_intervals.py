"""A run's intervals in the report: read, or said to be left out."""

from __future__ import annotations

from pathlib import Path

import pytest

from pmutools.report import intervals


def test_a_file_that_is_too_long_is_left_out_and_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "intervals.jsonl"
    assert (intervals.read_intervals(path), intervals.too_long(path)) == ([], "")
    path.write_text('{"end": "2024-01-01T00:00:01Z", "all": {"frames": 7}}\n')
    assert intervals.too_long(path) == ""
    assert intervals.read_intervals(path) == [(1_704_067_201_000_000_000, {"frames": 7})]
    monkeypatch.setattr(intervals, "MOST_BYTES", 10)
    assert intervals.read_intervals(path) == []
    assert intervals.too_long(path).startswith("intervals.jsonl is not shown here")
