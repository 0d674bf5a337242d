"""What the host and the kernel say of this machine and its processes."""

from __future__ import annotations

import os
import statistics
from collections.abc import Sequence
from pathlib import Path

Look = tuple[int, int]
"""A process and its resident memory in KiB."""


def steal_s() -> float:
    """Seconds that the host has taken from this machine's processors."""
    return int(Path("/proc/stat").read_text().split()[8]) / os.sysconf("SC_CLK_TCK")


def rss_kib(pid: int) -> int:
    """Resident memory of a process; 0 where there is none."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("VmRSS")), 0)


def growth_mib(looks: Sequence[Look]) -> float:
    """Of one process in the second half of all looks: medians of its first and its last quarter.

    Not a number where it was another process then.
    """
    second = looks[len(looks) // 2 :]
    if len({pid for pid, _ in second}) != 1 or len(second) < 4:
        return float("nan")
    quarter = len(second) // 4
    first, last = ([kib for _, kib in part] for part in (second[:quarter], second[-quarter:]))
    return (statistics.median(last) - statistics.median(first)) / 1024
