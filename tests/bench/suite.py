"""All that is measured, as one table; :mod:`bench.run` is how it is called."""

from __future__ import annotations

import argparse
import subprocess
from collections.abc import Iterator
from pathlib import Path

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
from bench.layouts import BLOCK, LAYOUTS
from bench.table import Row

PAGE = Path(__file__).resolve().parents[2] / "docs" / "speed-table.md"
PEERS = ("synchrophasor", "pyc37", "numpy", "fastcrc")


def measured(*, quick: bool) -> Iterator[Row]:
    """All rows, as they are measured."""
    yield from codec.rows(codec.QUICK if quick else codec.FULL)
    yield from capture.rows(capture.QUICK if quick else capture.FULL)
    yield from startup.rows(startup.QUICK if quick else startup.FULL)
    yield from control.rows(control.QUICK if quick else control.FULL)
    yield from waking.rows(waking.QUICK if quick else waking.FULL)
    yield from analyzing.rows(analyzing.QUICK if quick else analyzing.FULL)
    yield from measuring.rows(measuring.QUICK if quick else measuring.FULL)
    yield from receiving.rows(receiving.QUICK if quick else receiving.FULL)
    yield from reading.rows(reading.QUICK if quick else reading.FULL)
    yield from characterizing.rows(characterizing.QUICK if quick else characterizing.FULL)
    yield from pacing.rows(pacing.QUICK if quick else pacing.FULL)


def method() -> list[str]:
    """What a reader must know to judge the table."""
    layouts = "; ".join(f"**{layout.name}** {layout.text}" for layout in LAYOUTS)
    return [
        f"Measured on {table.today()} on a {table.machine()}, with {table.versions(PEERS)} (synchrophasor is pypmu) "
        f"and {_tshark()}. cyclictest is that of Debian's rt-tests.",
        "",
        "One run on one machine: in every round each contender works once, in turn with the others; figures are "
        "medians over the rounds, `±` is half the distance between the quartiles, and a result is the median of the "
        f"rounds' ratios. Rates are frames per second of processor time. Batches are of {BLOCK} frames, as readers of "
        "recordings make them. Before anything is timed, all contenders' values are held to each other.",
        "",
        f"Frames: {layouts}.",
    ]


def _tshark() -> str:
    try:
        first = subprocess.run(["tshark", "--version"], capture_output=True, text=True, timeout=20, check=True).stdout
    except OSError:
        return "no tshark"
    return " ".join(first.split()[:3]).replace("TShark (Wireshark)", "tshark").rstrip(".")


def main() -> int:
    parser = argparse.ArgumentParser(description="Measure speed beside other programs; see the table's head.")
    parser.add_argument("--quick", action="store_true", help="run everything once on next to nothing")
    quick: bool = parser.parse_args().quick
    rows = list(measured(quick=quick))
    print(table.text(rows))
    if quick:
        return 0
    PAGE.write_text(table.markdown(rows, method()), encoding="utf-8")
    missed = [row for row in rows if row.missed and row.group in table.BINDING]
    for row in missed:
        print(f"missed: {row.what}, against {row.against}")
    return 1 if missed else 0
