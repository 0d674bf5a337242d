"""What is read from cyclictest and from a session log, and how a long run is judged."""

from __future__ import annotations

import math

import pytest
from bench.host import growth_mib
from bench.running import account, ended_well
from bench.waking import Histogram, histogram, summed

from dcon.session.codec import Timing
from pmutools.timebase import NS

PRINTED = """# /dev/cpu_dma_latency set to 0us
# Histogram
000000 000000
000031 000002
000042 000096
000133 000001
# Total: 000000099
# Min Latencies: 00031
# Avg Latencies: 00043
# Max Latencies: 20159
# Histogram Overflows: 00001
# Histogram Overflow at cycle number:
# Thread 0: 00077
"""


@pytest.mark.parametrize(
    ("code", "restarts", "killed", "well"),
    [
        (130, {}, 0, True),
        (130, {"server": 2}, 2, True),
        (130, {"server": 3}, 2, False),
        (130, {"server": 2, "platform": 1}, 2, False),
        (130, {}, 1, False),
        *((code, {}, 0, False) for code in (0, 1, 2, 3, -9)),  # 0 and 3 are those of a time that is over
    ],
)
def test_how_a_long_run_must_end(code: int, restarts: dict[str, int], killed: int, well: bool) -> None:
    assert ended_well(code, restarts, killed) is well


def test_the_histogram_of_cyclictest() -> None:
    found = histogram(PRINTED)
    assert found == Histogram({31: 2, 42: 96, 133: 1}, 1, 20159)
    assert found.total == 100
    assert [found.quantile_us(share) for share in (0.0, 0.02, 0.021, 0.5, 0.98, 0.99, 0.991, 1.0)] == [
        *(31, 31, 42, 42, 42, 133, 20159, 20159)
    ]


@pytest.mark.parametrize(
    "text", ["", "unable to change scheduling policy!", "# Histogram\n000000 000000\n# Total: 0\n"]
)
def test_one_that_has_counted_nothing_is_no_measurement(text: str) -> None:
    with pytest.raises(ValueError, match="cyclictest has counted nothing"):
        histogram(text)


def test_a_turn_of_the_loop() -> None:
    turn = summed([Timing(1000.0 - k, float(k)) for k in range(101)])
    assert turn == (101, (50.0, 99.0), (950.0, 999.0))


def test_every_tick_is_accounted_for() -> None:
    ticks = [k * NS // 60 for k in range(600) if k not in (7, 8, 100)]
    assert account(ticks, 2, 1).unexplained == 0
    assert account(ticks, 2, 0).unexplained == 1
    assert account(ticks, 0, 0) == (600, 597, 0, 0)
    with pytest.raises(ValueError, match="not in order"):
        account([0, 17, 17], 0, 0)


def test_memory_grows_or_does_not() -> None:
    still = [(7, 1000)] * 40
    assert growth_mib(still) == 0
    assert growth_mib([(7, 1024 * k) for k in range(40)]) == 15  # from 22 to 37
    assert growth_mib([(1, 1000)] * 20 + [(2, 5000)] * 20) == 0  # it was another in the first half
    assert math.isnan(growth_mib([*still[:-1], (8, 1000)]))
