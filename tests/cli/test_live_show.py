"""What the live display tells of the recording."""

from __future__ import annotations

from pathlib import Path

from pmutools.cli.live_show import _size
from pmutools.formats import JOURNAL


def test_the_size_of_a_recording_is_that_of_its_journal_too(tmp_path: Path) -> None:
    recording = tmp_path / "run.parquet"
    assert _size([recording]) == 0
    recording.with_name(recording.name + JOURNAL).write_bytes(bytes(700))
    assert _size([recording]) == 700
    recording.write_bytes(bytes(40))
    assert _size([recording]) == 740


def test_one_journal_of_a_folder_of_tables_is_counted_once(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    tables = [folder / "N1.parquet", folder / "S1.parquet"]
    (folder / f"run.parquet{JOURNAL}").write_bytes(bytes(700))
    for table in tables:
        table.write_bytes(bytes(4))
    assert _size(tables) == 708
