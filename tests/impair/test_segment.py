"""How frames meet a TCP connection: the plan that goes with a frame, and which frames have one."""

from __future__ import annotations

import math

import pytest
from support.impairment import CONFIG_FRAME, frame, options, pipeline, play

from pmutools.flow import Cut, Segmentation
from pmutools.impair import Fate
from pmutools.impair.stages import parse_setting


@pytest.mark.parametrize(
    ("text", "write", "mark"),
    [
        ("split", Segmentation(Cut.SPLIT, 2, 5_000_000), "segment:split2x5ms"),
        ("split(parts=3, gap=0.5)", Segmentation(Cut.SPLIT, 3, 500_000), "segment:split3x0.5ms"),
        ("coalesce(frames=4)", Segmentation(Cut.COALESCE, 4), "segment:coalesce4"),
        ("stall(time=200)", Segmentation(Cut.STALL, 0, 200_000_000), "segment:stall200ms"),
        ("reset", Segmentation(Cut.RESET), "segment:reset"),
        ("reset(bytes=20)", Segmentation(Cut.RESET, 20), "segment:reset20"),
    ],
)
def test_what_is_asked_for(text: str, write: Segmentation, mark: str) -> None:
    (row,) = play(pipeline(f"segment={text}"), 1)
    assert (row.write, row.marks, row.data, row.offset_ns) == (write, (mark,), frame(0), 0)


def test_chance_and_selection() -> None:
    n = 5000
    rows = play(pipeline("segment=20% split when=not 0-999"), n)
    hit = [row.index for row in rows if row.write]
    assert min(hit) >= 1000
    assert abs(len(hit) / 4000 - 0.2) < 5 * math.sqrt(0.16 / 4000)
    assert all(row.write is None and not row.marks for row in rows if row.index not in hit)
    fewer = {row.index for row in play(pipeline("segment=10% split when=not 0-999"), n) if row.write}
    assert fewer < set(hit)


def test_the_first_part_that_applies_decides() -> None:
    rows = play(pipeline("segment=stall when=5\nsplit when=5-6\ncoalesce when=every 2"), 9)
    assert [row.write and row.write.cut for row in rows] == [
        *("coalesce", None, "coalesce", None, "coalesce", "stall", "split", None, "coalesce")
    ]


def test_it_comes_last_and_to_what_is_sent() -> None:
    profile = options("loss=30%", "duplicate=30%", "reorder=20%", "rate=60k queue=3", "slot=40", "segment=50% split")
    rows = play(pipeline(profile), 400)
    assert {row.fate for row in rows if row.write} == {Fate.SENT}
    assert all(row.marks[-1].startswith("segment:") for row in rows if row.write)
    plain = play(pipeline(options("loss=30%", "duplicate=30%", "reorder=20%", "rate=60k queue=3", "slot=40")), 400)
    assert [row[:6] for row in rows] == [row[:6] for row in plain]
    copies = [row.write is None for row in rows if row.copy and row.fate is Fate.SENT]
    assert 0 < sum(copies) < len(copies), "a copy draws for itself"


def test_configuration_frames_are_written_whole_unless_selected() -> None:
    assert pipeline("segment=split").apply(0, CONFIG_FRAME, 0)[0].write is None
    assert pipeline("segment=split when=type config").apply(0, CONFIG_FRAME, 0)[0].write is not None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("5%", "5%: write what is done, as in 5% split(parts=2, gap=5)"),
        ("spilt", "'spilt' is no way to write; did you mean 'split'?"),
        ("split(1)", "split parts: 1 is out of range; it must be 2 to 1000"),
        ("split(2, -1)", "split gap: -1 is out of range; it must be at least 0"),
        ("stall(0)", "stall time: 0 is out of range; it must be at least 1e-06"),
        ("coalesce(frames=x)", "coalesce frames: 'x' is not a whole number"),
    ],
)
def test_errors(text: str, message: str) -> None:
    with pytest.raises(ValueError) as error:
        parse_setting("segment", text)
    assert str(error.value) == message
