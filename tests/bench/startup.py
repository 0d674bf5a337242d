"""What it costs to ask a command for help, above a Python that does nothing."""

from __future__ import annotations

import statistics
import subprocess
import sys
from collections.abc import Iterator

from bench.stopwatch import cpu_s
from bench.table import Budget, Row

COMMANDS = {
    "pmu --help": "import sys; sys.argv = ['pmu', '--help']; from pmutools.cli import main; main()",
    "dcon --help": "import sys; sys.argv = ['dcon', '--help']; from dcon.cli import main; main()",
}
FULL, QUICK = 15, 1


def rows(rounds: int) -> Iterator[Row]:
    """The table's rows."""
    took: dict[str, list[float]] = {"": [], **{name: [] for name in COMMANDS}}
    for _ in range(rounds):
        for name, times_ms in took.items():
            times_ms.append(_cpu_ms(COMMANDS.get(name, "pass")))
    bare_ms = statistics.median(took.pop(""))
    for name, times_ms in took.items():
        median_ms = statistics.median(times_ms)
        against = f"python -c pass: {bare_ms:.1f} ms"
        result = median_ms - bare_ms
        yield Row("start-up", f"`{name}`", f"{median_ms:.1f} ms", against, result, " ms more", Budget("at most", 150))


def _cpu_ms(program: str) -> float:
    began_s = cpu_s()
    subprocess.run([sys.executable, "-c", program], stdout=subprocess.DEVNULL, timeout=60, check=True)
    return (cpu_s() - began_s) * 1e3
