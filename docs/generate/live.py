"""The pictures of the live displays, ``docs/img/live-frequency.svg`` and ``live-delay.svg``; to make them anew::

    PYTHONPATH=.:docs python docs/generate/live.py

They are drawn by the code that draws on the terminal, of a recording that is looked at round by round as if it were
live: N2 loses frames here, N4 says that it is not synchronised, S1 has a late quarter of a second, S3 falls silent.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from generate.display import exported
from generate.markdown import code, table
from pmutools.c37118.batch import Batch
from pmutools.c37118.constants import Stat
from pmutools.cli.watch_columns import MEANINGS, SIGNS, VIEWS
from pmutools.cli.watch_keys import KEYS, Ui
from pmutools.cli.watch_screen import lines
from pmutools.formats import open_source
from pmutools.formats.source import Block
from pmutools.timebase import NS
from pmutools.tools.watch import Snapshot, Watch

ROOT = Path(__file__).parents[2]
SIZE = (112, 20)
COMMANDS = {"frequency": "pmu read live.parquet", "delay": "pmu characterize quality"}
ROUND_NS = NS // 4
ROUNDS = 64
LATE_NS = 230_000_000


def picture(view: str) -> Path:
    return ROOT / "docs" / "img" / f"live-{view}.svg"


def changed(block: Block, number: int) -> Block | None:
    """What became of a station's frames in one round."""
    flow, batch = block
    match batch.config.stations[0].name:
        case "N2":
            batch = _only(batch, np.arange(len(batch)) % 29 != number % 29)
        case "N4":
            batch = replace(batch, stat=batch.stat | np.uint16(Stat.NOT_SYNCHRONISED))
        case "S1" if number == ROUNDS - 9:
            batch = replace(batch, arrival_ns=batch.arrival_ns + LATE_NS)
        case "S3" if number > ROUNDS - 14:
            return None
    return Block(flow, batch)


def _only(batch: Batch, rows: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Batch:
    kept = {name: getattr(batch, name) for name in batch.__dataclass_fields__}
    return Batch(**{name: value if name == "config" or value is None else value[rows] for name, value in kept.items()})


def rounds() -> Iterator[list[Block]]:
    """The recording, by time of arrival."""
    blocks = [item for item in open_source(ROOT / "captures" / "cjb-8pmu.pcap").blocks() if isinstance(item, Block)]
    blocks.sort(key=lambda block: block.batch.config.stations[0].name)
    start_ns = min(int(block.batch.arrival_ns[0]) for block in blocks)
    for number in range(ROUNDS):
        of_round = []
        for block in blocks:
            at_ns = block.batch.arrival_ns - start_ns
            rows = (at_ns >= number * ROUND_NS) & (at_ns < (number + 1) * ROUND_NS)
            if (made := changed(Block(block.flow, _only(block.batch, rows)), number)) is not None:
                of_round.append(made)
        yield of_round


@cache
def snapshot() -> Snapshot:
    """All streams after the last round."""
    watch = Watch()
    for number, of_round in enumerate(rounds(), 1):
        watch.add(of_round, number * ROUND_NS)
    return watch.look(ROUNDS * ROUND_NS)


def svg(view: str) -> str:
    """A view's picture."""
    command = COMMANDS[view]
    ui = Ui(view=view, selected=1, events=("udp://0.0.0.0:4713: bound: receive buffer 8388608 bytes",))
    facts = ("clock within 0.082 ms, by chrony", f"{command.split()[-1]} 1.4 MB")
    drawn = lines(snapshot(), ui, f"{command} ← udp://0.0.0.0:4713", facts, *SIZE)
    return exported(drawn, SIZE, f"{command} --live", f"live-{view}")


def keys() -> str:
    """Keys of ``--live``."""
    return table(("key", "meaning"), ((" ".join(map(code, key.shown.split())), key.meaning) for key in KEYS))


def columns() -> str:
    """What the columns mean, and in which view they are."""
    titles = {view: [shown.column.title for shown in columns] for view, columns in VIEWS.items()}
    rows = (
        (code(title), ", ".join(view for view, there in titles.items() if title in there), meaning)
        for title, meaning in MEANINGS.items()
    )
    return table(("column", "view", "meaning"), rows)


def signs() -> str:
    """The marks before the names."""
    return table(("mark", "meaning"), ((code(sign), meaning) for sign, meaning in SIGNS.items()))


GENERATORS = {"live-keys": keys, "live-columns": columns, "live-signs": signs}

if __name__ == "__main__":
    for name in VIEWS:
        picture(name).write_text(svg(name), encoding="utf-8")
