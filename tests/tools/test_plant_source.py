"""A simulated plant as a source: the frames of ``pmu synth``, in blocks."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from pmutools.c37118.batch import decode_batch
from pmutools.c37118.checksum import chk_array
from pmutools.c37118.demux import Message
from pmutools.errors import SettingsError
from pmutools.formats.source import Block, gather
from pmutools.tools.synth import PlantSource, Recipe


def frames_by_stream(items: Any) -> dict[int, list[tuple[int, bytes]]]:
    """(arrival, bytes) of each stream's data frames."""
    streams: dict[int, list[tuple[int, bytes]]] = {}
    for item in items:
        if isinstance(item, Block):
            assert item.batch.wire is not None
            data = [row.tobytes() for row in item.batch.wire]
            rows = zip(item.batch.arrival_ns.tolist(), data, strict=True)
            streams.setdefault(item.batch.config.idcode, []).extend(rows)
    return streams


@pytest.mark.parametrize(
    "recipe",
    [
        Recipe(duration_s=7.0),
        Recipe("ambient", pmus=3, rate=10, duration_s=5.05, seed=4),
        Recipe("square-pulse", "modal-five", pmus=5, rate=50, duration_s=6, pdc_idcode=300),
        Recipe("bc-us-separation", pmus=1, rate=1, duration_s=3),
    ],
)
def test_blocks_hold_the_frames_of_the_messages(recipe: Recipe) -> None:
    """Each stream's bytes and arrivals; numbers may differ in the last bit of a float32."""
    source = PlantSource(recipe)
    ours, theirs = list(source.blocks()), list(gather(PlantSource(recipe).items()))
    openings = [[item for item in items if isinstance(item, Message)] for items in (ours, theirs)]
    assert openings[0] == openings[1]
    found, expected = frames_by_stream(ours), frames_by_stream(theirs)
    assert found.keys() == expected.keys()
    configs = {item.batch.config.idcode: item.batch.config for item in ours if isinstance(item, Block)}
    for idcode, rows in expected.items():
        theirs_sorted = sorted(rows, key=lambda row: row[1][6:14])
        assert [arrival for arrival, _ in found[idcode]] == [arrival for arrival, _ in theirs_sorted]
        one, other = (
            decode_batch(b"".join(data for _, data in rows), configs[idcode]) for rows in (found[idcode], theirs_sorted)
        )
        assert np.array_equal(one.time_ns, other.time_ns)
        for name in ("phasors", "frequency", "rocof"):
            assert np.allclose(getattr(one, name), getattr(other, name), rtol=3e-7, atol=1e-7)
        same = [mine[1] == yours[1] for mine, yours in zip(found[idcode], theirs_sorted, strict=True)]
        assert np.mean(same) > 0.99


def test_longer_than_the_scenario_and_counted() -> None:
    source = PlantSource(Recipe(pmus=1, rate=10, duration_s=100))
    blocks = [item for item in source.blocks() if isinstance(item, Block)]
    assert sum(len(block.batch) for block in blocks) == 1000
    assert source.tally.frames == {3: 1, 0: 1000}
    assert not any(chk_array(block.batch.wire.view(np.uint8).reshape(-1, 66)).any() for block in blocks)
    steps = np.diff(np.concatenate([block.batch.time_ns for block in blocks]))
    assert set(steps.tolist()) == {100_000_000}


def test_the_first_block_comes_at_once() -> None:
    """A day of plant costs no more than what is read of it."""
    source = PlantSource(Recipe(duration_s=86400))
    first = next(item for item in itertools.islice(source.blocks(), 20) if isinstance(item, Block))
    assert len(first.batch) == 120


@pytest.mark.parametrize("recipe", [Recipe("cbj"), Recipe(plant="nodal"), Recipe("bc-us-separation", "modal-five")])
def test_unknown_names_are_told_before_anything_is_read(recipe: Recipe) -> None:
    with pytest.raises(SettingsError):
        PlantSource(recipe)
