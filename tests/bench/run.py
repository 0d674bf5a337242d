"""``make bench``: measure, print a table, and write ``docs/speed-table.md``.

Exit code 1 where a budget of codec, capture or start-up is missed. ``--quick`` runs everything on next to nothing, to
see that it runs; it writes and judges nothing.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # processor time is counted: idle threads must not spin
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

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
        f"and {_tshark()}.",
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
    """Exits with one line where something is not installed that is measured."""
    if lacking := [name for name in NEEDED if importlib.util.find_spec(name) is None]:
        sys.exit(f"bench: not installed: {', '.join(lacking)}; pip install -e '.[dev]' brings all that is measured")
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # processor time is counted: idle threads must not spin
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from bench import suite

    return suite.main()


if __name__ == "__main__":
    sys.exit(main())
