"""Contenders measured in turn, in processor time: other work on the machine disturbs them little, and all alike."""

from __future__ import annotations

import gc
import resource
import statistics
import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

Work = Callable[[], int]
"""Does something once; returns how many things it has done."""


def cpu_s() -> float:
    """Processor time of this process and of the children it has waited for."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


class Rate(NamedTuple):
    """Things done a second, a value a round."""

    rounds: tuple[float, ...]

    @property
    def median(self) -> float:
        return statistics.median(self.rounds)

    @property
    def spread(self) -> float:
        """Half the distance between the quartiles, as a share of the median."""
        if len(self.rounds) < 3:
            return 0.0
        low, _, high = statistics.quantiles(self.rounds, n=4, method="inclusive")
        return (high - low) / 2 / self.median

    def over(self, other: Rate) -> float:
        """How many times faster than ``other``: the median of the ratios of the rounds."""
        return statistics.median(mine / theirs for mine, theirs in zip(self.rounds, other.rounds, strict=True))


def measure(contenders: Mapping[str, Work], rounds: int) -> dict[str, Rate]:
    """Rates of all contenders: each round runs each of them once, one round more warms up."""
    found: dict[str, list[float]] = {name: [] for name in contenders}
    for number in range(rounds + 1):
        for name, work in contenders.items():
            gc.collect()
            began_s = cpu_s()
            done = work()
            took_s = cpu_s() - began_s
            if number:
                found[name].append(done / max(took_s, 1e-9))
    return {name: Rate(tuple(rates)) for name, rates in found.items()}
