"""What the reader logs plays back: played, logged, played again and logged again, values and flags stay the same."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.chain import assert_same_values, batches_of, pass_through

pytestmark = pytest.mark.realtime

CAPTURE = Path(__file__).parents[2] / "captures" / "cjb-pdc-30fps.pcapng"
FRAMES = 600
SUFFIXES = (".csv.gz", ".jsonl", ".parquet", ".arrow", ".mcap", ".pcapng", ".c37118.zst")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_log_is_played_and_logged_again(suffix: str, tmp_path: Path) -> None:
    played = batches_of(CAPTURE)
    (first,) = pass_through(CAPTURE, "udp", tmp_path / f"first{suffix}").paths
    logged = batches_of(first)
    assert_same_values(played, logged)
    assert sum(map(len, logged)) == FRAMES
    (second,) = pass_through(first, "udp", tmp_path / f"second{suffix}").paths
    again = batches_of(second)
    assert_same_values(logged, again)
    if suffix != ".csv.gz":  # which has no place for a configuration
        assert {batch.config for batch in logged} == {batch.config for batch in again}
