"""PMUs for a controller that runs: a recording of a steady swing, and the player that sends it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from support.swing import Streams

from pmutools.c37118.config import encode_config

LENGTH_S = 20
"""Of the recording that is played over and over: a whole number of swings."""


def recording(path: Path, names: Sequence[str]) -> Path:
    """Some PMUs in a steady swing, as raw bytes; played in a loop, its end fits its beginning."""
    streams = Streams(names)
    with path.open("wb") as file:
        for name in names:
            file.write(encode_config(streams.configs[name]))
        for slot in range(LENGTH_S * 60):
            for name in names:
                file.write(streams.data(name, streams.stamp_ns(slot)))
    return path


def spawn(folder: Path, module: str, *words: str) -> subprocess.Popen[bytes]:
    """A process of ours; what it writes goes to ``stdout`` and ``stderr`` in the folder."""
    with (folder / "stdout").open("ab") as out, (folder / "stderr").open("ab") as said:
        return subprocess.Popen([sys.executable, "-m", module, *words], stdout=out, stderr=said)


def player(folder: Path, played: Path, to: Sequence[str], *options: str) -> subprocess.Popen[bytes]:
    """``pmu play`` of a recording to some endpoints."""
    words = [word for url in to for word in ("--to", url)]
    process = spawn(folder, "pmutools.cli", "play", str(played), *words, *options, "--cfg-period", "1", "--quiet")
    with suppress(OSError):  # where it is permitted: a PMU has no other work
        os.sched_setscheduler(process.pid, os.SCHED_FIFO, os.sched_param(5))
    return process
