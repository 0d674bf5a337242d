"""What ``dcon analyze`` takes of an hour's session: time and memory of the whole command."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from bench.table import Budget, Row
from support.sessions import log_configs, log_tick

from dcon.session.head import Head
from dcon.session.reader import LoggedTick, SessionReader
from dcon.session.rolling import RollingWriter
from dcon.sim.plan import Plan
from dcon.sim.simulate import simulate

AT_MOST_S = 30.0
AT_MOST_MIB = 1024.0


@dataclass(frozen=True)
class Sizes:
    simulated_s: float
    times: int
    """How often that is written, one after another."""


FULL = Sizes(simulated_s=60.0, times=60)
QUICK = Sizes(simulated_s=12.0, times=2)


def rows(sizes: Sizes) -> Iterator[Row]:
    """The table's rows."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.mcap"
        ticks = write(path, sizes)
        took_s, peak_mib = analysed(path, Path(folder) / "out")
        nbytes = path.stat().st_size
    length_s = ticks / 60
    what = f"`dcon analyze`, a session of {length_s / 60:.1f} min, 8 PMUs at 60/s"
    ours = f"{took_s:.1f} s for {nbytes / 1e6:.0f} MB, {length_s / took_s:.0f} s a second"
    yield Row("control", what, ours, "the budget of an hour", took_s, " s", Budget("at most", AT_MOST_S))
    ours = f"{peak_mib:.0f} MiB at most at once"
    yield Row("control", f"{what}: memory", ours, "the budget", peak_mib, " MiB", Budget("at most", AT_MOST_MIB))


def write(path: Path, sizes: Sizes) -> int:
    """A session log of brakes and their swings, with noise, by the session writer; how many ticks it has."""
    short = path.with_name("short.mcap")
    simulate(Plan(duration_s=sizes.simulated_s, noise_rad=2e-4), str(short))
    reader = SessionReader(short)
    ticks = list(reader.ticks())
    whole_ns = round(sizes.simulated_s) * 10**9
    head = Head(reader.ini_text, reader.pmus, reader.instances, reader.flags, reader.metadata)
    with RollingWriter(path, head) as log:
        log_configs(log, reader.configs)
        for number in range(sizes.times):
            for tick in ticks:
                later = shifted(tick, number * whole_ns)
                log_tick(
                    log,
                    later.record,
                    later.frames,
                    later.orders,
                    surroundings=later.surroundings,
                    instances=reader.instances,
                )
    return len(ticks) * sizes.times


def shifted(tick: LoggedTick, by_ns: int) -> LoggedTick:
    """The same so much later; the bytes of its frames stay as they are."""
    return tick._replace(
        record=tick.record._replace(tick_ns=tick.record.tick_ns + by_ns),
        frames=tuple(
            frame._replace(time_ns=frame.time_ns + by_ns, arrival_ns=frame.arrival_ns + by_ns) for frame in tick.frames
        ),
    )


def analysed(path: Path, out: Path) -> tuple[float, float]:
    """Processor seconds and peak MiB of ``dcon analyze``, from its start to its end."""
    command = [sys.executable, "-m", "dcon.cli", "analyze", str(path), "--out", str(out), "--quiet"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as child:
        _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode or not (out / "report.html").is_file():
        raise RuntimeError(f"dcon analyze ended with {child.returncode}")
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1024
