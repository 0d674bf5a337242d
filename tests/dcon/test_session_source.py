"""A session log of the controller is a recording of its PMUs: every tool of the stream player reads it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dcon.cli import dcon
from pmutools.cli.shell import run
from pmutools.formats import open_source
from pmutools.formats.source import Block
from pmutools.timebase import NS


def test_a_simulated_session_opens_as_a_source(tmp_path: Path) -> None:
    assert run(dcon(), ["simulate", "cjb", "--duration", "5", "--out", str(tmp_path), "--json"]) == 0
    source = open_source(tmp_path / "session.mcap")
    blocks = [item for item in source.blocks() if isinstance(item, Block)]
    assert source.defects() == {}
    by_name: dict[str, list[Block]] = {}
    for block in blocks:
        (station,) = block.batch.config.stations
        assert block.flow.source == f"session.mcap/{station.name}"
        by_name.setdefault(station.name, []).append(block)
    assert sorted(by_name) == ["N1", "N2", "N3", "N4", "S1", "S2", "S3", "S4"]
    for own in by_name.values():
        batches = [block.batch for block in own]
        assert sum(map(len, batches)) == 300
        delays = np.concatenate([batch.arrival_ns - batch.time_ns for batch in batches])
        assert 0 < delays.min() <= delays.max() < NS // 5
        assert all(batch.valid.all() for batch in batches)
