"""The limiter and the supervisor with every operator flipped and every constant changed, one at a time.

Below are facts: calls with the results that they must have. A mutant takes the place of the original function, and
the facts about it are asked again. One that gives them all is either equivalent, and listed with the reason, or a
fact is missing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from types import FunctionType
from typing import Any

import pytest
from support.mutation import mutants, survivors

from dcon import limiter
from dcon.core import (
    changes,
    checks,
    feedback,
    instance,
    line,
    quick,
    register,
    rows,
    stamps,
    step,
    system,
    system_rows,
)
from dcon.core import pmu as pmus_of
from dcon.core.checks import Judged, PairView, SystemView
from dcon.core.differentiator import Filter
from dcon.core.feedback import QUIET, Feedback
from dcon.core.params import Line, Params, PmuParams, Required
from dcon.core.rows import CORE
from dcon.core.state import Freq, Instance, Pmu, initial_state
from dcon.core.system import ArmView, Trigger
from dcon.core.thresholds import Thresholds
from dcon.core.values import NOTHING, Event, Flag, InstanceState, Pdci, Sample, Surroundings, SystemState

Fact = tuple[Callable[..., Any], tuple[Any, ...], Any]
NAN, INF = math.nan, math.inf


def of(function: Callable[..., Any], *pairs: tuple[Any, Any]) -> list[Fact]:
    """Facts about a function: (arguments, result); a single argument may stand for itself."""
    return [(function, args if isinstance(args, tuple) else (args,), want) for args, want in pairs]


# --- the limiter -------------------------------------------------------------------------------------------------

TICK = 1 / 60
STEP = 1000 / 60
USUAL = (10.0, 10.0, TICK, 125.0)
LIMITER = [
    *of(limiter._number, (1, 1.0), (-2.5, -2.5), (0.0, 0.0)),
    *of(limiter._number, *((bad, None) for bad in (None, True, False, "1", 1j, NAN, INF, -INF, 10**400))),
    *of(limiter.limit, ((50.0, 50.0, TICK), (50.0, "")), ((0.0, 0.0, TICK), (0.0, ""))),
    *of(
        limiter.limit,
        *(((s * 200.0, s * 125.0, TICK), (s * 125.0, "limit")) for s in (1, -1)),
        *(((s * 100.0, 0.0, TICK), (s * STEP, "slew")) for s in (1, -1)),
        *(((s * 50.0, s * 30.0, TICK), (s * (30 + STEP), "slew")) for s in (1, -1)),
        *(((s * 30.0, s * 50.0, TICK), (s * (50 - STEP), "slew")) for s in (1, -1)),
        *(((s * 100.0, s * 80.0, TICK, 80.0), (s * 80.0, "limit")) for s in (1, -1)),
        *(((s * 120.0, s * 1000.0, TICK), (s * 120.0, "")) for s in (1, -1)),
        *(((200.0, 120.0, TICK, bound), (125.0, "limit")) for bound in (125.0, 126.0, 500.0)),
        ((STEP, 0.0, TICK), (STEP, "")),
        ((100.0, 0.0, 1.0), (100.0, "")),
        *(((110.0, 0.0, dt), (100.0, "slew")) for dt in (0.1, 1.0)),
        ((5.0, 0.0, TICK, 0.0), (0.0, "limit")),
        ((0.0, 0.0, 0.5, 0.5), (0.0, "")),
        *(((10.0, 10.0, dt), (0.0, "invalid")) for dt in (0.0, -1.0)),
        ((10.0, 10.0, TICK, -0.5), (0.0, "invalid")),
    ),
    *of(
        limiter.limit,
        *(((*USUAL[:at], bad, *USUAL[at + 1 :]), (0.0, "invalid")) for at in range(4) for bad in (None, NAN, INF, "x")),
    ),
    *of(limiter.volts, (125.0, 10.0), (-125.0, -10.0), (12.5, 1.0), (500.0, 10.0), (-500.0, -10.0), (0.0, 0.0)),
    *of(limiter.volts, *((bad, 0.0) for bad in (None, NAN, "1"))),
]

# --- frames and instances ----------------------------------------------------------------------------------------

PARAMS = Params.paired(("N1",), ("S1",), nominal_kv=500.0)
SITE, BASE = PARAMS.pmus[0], PARAMS.pmus[0].base_v
BARE, TINY = PmuParams("N1"), PmuParams("N1", 1e-3)
"""Of no known nominal voltage, and of one below a volt."""
T = 1_700_000_000_000_000_000
MS = 1_000_000
SLOT = T * 60 // 10**9


def sample(**changed: Any) -> Sample:
    return Sample(T, T + 60 * MS, complex(BASE, 0), 60.0, 0, 0)._replace(**changed)


def memory(frames: int = 3, **changed: Any) -> Pmu:
    usual = Pmu(SLOT, T, T + 60 * MS, v1=complex(BASE, 0), magnitude_v=BASE, ring=(0.0,), freq=Freq(0.0, 0.0, 0.0, 0.0))
    return usual._replace(**{"filter": Filter(0.0, 0.0, 0.0, 0.0, frames), **changed})


def turned(frames: int = 3, increment: float = 0.0, f: float = 0.0, before: float = 0.0, **changed: Any) -> Pmu:
    return memory(filter=Filter(0.0, increment, f, before, frames), **changed)


def frame(function: Callable[..., Any], want: float | None, **given: Any) -> Fact:
    """A fact about the row of a frame; ``site``, ``last`` and ``new`` are as told, the rest is of the sample."""
    site, last, new = given.pop("site", SITE), given.pop("last", memory()), given.pop("new", memory())
    return function, (PARAMS, site, last, new, sample(**given)), want


def pair(north: Pmu, south: Pmu, delta: float = 0.0, median: float | None = None) -> tuple[Params, PairView]:
    return PARAMS, PairView(north, south, delta, median, T)


FRAMES = [
    frame(rows.not_finite, 0.0),
    *(frame(rows.not_finite, NAN, new=memory(magnitude_v=bad)) for bad in (NAN, INF)),
    *(frame(rows.stat_error, want, stat=stat) for stat, want in ((0x3FFF, 0), (0x4000, 0x4000), (0x8000, 0x8000))),
    *(frame(rows.not_synchronised, want, stat=stat) for stat, want in ((0xDFFF, 0), (0x2001, 0x2000))),
    *(frame(rows.config_change, want, stat=stat) for stat, want in ((0xFBFF, 0), (0x0401, 0x0400))),
    *(frame(rows.time_quality, us, time_quality=0x70 | code) for code, us in ((0, 0), (1, 1e-3), (6, 1e2), (15, INF))),
    *(frame(rows.time_quality, us, stat=code << 6) for code, us in ((0, 0.0), (1, 0.1), (4, 100.0), (7, INF))),
    *(frame(rows.time_quality, INF, stat=code << 4) for code in (1, 2, 3)),
    frame(rows.time_quality, 1000.0, stat=4 << 6, time_quality=7),
    *(frame(rows.latency, ms, arrival_ns=T + round(ms * MS)) for ms in (60.0, -5.0, 200.5)),
    *(frame(rows.voltage, pu, new=memory(magnitude_v=BASE * pu)) for pu in (0.5, 1.0, 2.0)),
    frame(rows.voltage, None, site=BARE),
    frame(rows.voltage, 2.0, site=TINY, new=memory(magnitude_v=2 * TINY.base_v)),
    *(frame(rows.voltage_step, 0.5, new=memory(frames, magnitude_v=BASE * 1.5)) for frames in (2, 3)),
    frame(rows.voltage_step, 0.25, new=memory(magnitude_v=BASE * 0.75)),
    frame(rows.voltage_step, None, new=memory(1, magnitude_v=BASE * 1.5)),
    frame(rows.voltage_step, None, site=BARE, new=memory(magnitude_v=BASE * 1.5)),
    frame(rows.unbalance, None),
    frame(rows.unbalance, 5.0, v2=complex(BASE * 0.03, BASE * 0.04)),
    frame(rows.unbalance, 5.0, new=memory(magnitude_v=0.5), v2=0.025 + 0j),
    *(frame(rows.unbalance, NAN, new=memory(magnitude_v=bad), v2=1 + 1j) for bad in (0.0, NAN)),
    frame(rows.angle_step, 90.0, last=turned(increment=0.0), new=turned(increment=math.pi / 2)),
    frame(rows.angle_step, 90.0, last=turned(increment=math.pi / 4), new=turned(increment=-math.pi / 4)),
    frame(rows.angle_step, None, new=turned(2, increment=1.0)),
    *(frame(rows.frequency, 0.5, new=turned(f=f)) for f in (0.5, -0.5)),
    frame(rows.frequency, None, new=turned(2, f=0.5)),
    *(frame(rows.rocof, 6.0, new=turned(f=f, before=0.25)) for f in (0.35, 0.15)),
    frame(rows.rocof, None, new=turned(2, f=0.5)),
    *(frame(rows.freq_difference, 30.0, new=turned(f=f, freq=Freq(y1=0.02, y2=9.0))) for f in (0.05, -0.01)),
    frame(rows.freq_difference, None, new=turned(2, f=0.05)),
    frame(rows.freq_difference, None, new=memory(freq=Freq())),
    *(frame(rows.frozen, 250.0, frequency_hz=hz) for hz in (60.25, 59.75)),
    frame(rows.frozen, INF, frequency_hz=NAN),
    frame(rows.frozen, None, new=memory(v1=1j), frequency_hz=60.25),
    *of(rows.no_data, ((PARAMS, Pmu(), T), 1.0), ((PARAMS, memory(), T), 0.0)),
    *of(
        rows.arrival_gap,
        ((PARAMS, Pmu(), T), None),
        ((PARAMS, memory(arrival_ns=T - 70 * MS, idle_ticks=3), T), 70.0),
        ((PARAMS, memory(arrival_ns=T + 9 * MS, idle_ticks=4), T), 50.0),
    ),
    *of(rows._longest_gap_ms, (PARAMS, 50.0), (replace(PARAMS, rate_hz=30), 100.0)),
]
INSTANCES = [
    *of(
        rows.alignment_age,
        (pair(memory(time_ns=T - 80 * MS), memory(time_ns=T - 90 * MS)), 90.0),
        (pair(memory(time_ns=T - 1000 * MS), memory(time_ns=T - 80 * MS)), 1000.0),
    ),
    *of(
        rows.alignment_skew,
        *((pair(memory(slot=a), memory(slot=b)), 5) for a, b in ((9, 4), (4, 9))),
        *((pair(memory(slot=a), memory(slot=b)), None) for a, b in ((None, 4), (4, None))),
    ),
    *of(
        rows.stamps_differ,
        *((pair(memory(slot=a), memory(slot=b)), None) for a, b in ((None, 4), (4, None))),
        (pair(memory(), memory()), 0.0),
        *((pair(memory(time_ns=T + ns), memory()), 5.0) for ns in (15_000, -15_000)),
        (pair(memory(time_ns=T + 1_005_000, time_base=1000), memory()), 5.0),
        (pair(memory(slot=SLOT + 60, time_ns=T + 1_000_015_000), memory()), 5.0),
    ),
    *of(rows.off_median, *((pair(memory(), memory(), mhz, 2.0), 3.0) for mhz in (5.0, -1.0))),
    *of(rows.off_median, (pair(memory(), memory(), 5.0), None)),
    *of(stamps.tolerance_ns.__wrapped__, (1_000_000, 10_000), (1000, MS), (999, 1_001_002)),
    *of(
        stamps.is_apart,
        *(((T, T + ns, 1, 50, 1_000_000), True) for ns in (20_000_000, 20_010_000, 19_990_000)),
        *(((T, T + ns, 1, 50, 1_000_000), False) for ns in (20_010_001, 19_989_999, 10_000)),
        ((T, T + 40_000_000, 2, 50, 1_000_000), True),
    ),
]


def told_of(*mhz: float | None) -> tuple[list[Instance], list[tuple[int, float] | None]]:
    """READY instances, and what they found."""
    return [Instance(InstanceState.READY)] * len(mhz), [None if x is None else (1, x) for x in mhz]


def ready(*verified: int) -> list[Instance]:
    """Instances that are READY for so many frames; -1 is one that is not."""
    return [Instance(InstanceState.READY if k >= 0 else InstanceState.DISABLED, k) for k in verified]


INSTANCES += [
    *of(instance.median_mhz, (told_of(1.0, 5.0, 2.0), 2.0), (told_of(1.0, 5.0, 2.0, 4.0), 3.0)),
    *of(instance.median_mhz, (told_of(1.0, None, 2.0, 9.0), 2.0), (told_of(1.0, 2.0, NAN), None)),
    *of(instance.median_mhz, (told_of(1.0, 5.0), None)),
    *of(instance.median_mhz, (([Instance()] + told_of(1.0)[0] * 3, told_of(9.0, 1.0, 2.0, 3.0)[1]), 2.0)),
    *of(
        instance.choose,
        ((PARAMS, ready(-1, 5, 5), None, True), 1),
        ((PARAMS, ready(5, 5, 5), 1, True), 1),
        ((PARAMS, ready(5, 5, 5), 1, False), 0),
        ((PARAMS, ready(4800, 5), 1, True), 0),
        ((PARAMS, ready(4799, 5), 1, True), 1),
        ((PARAMS, ready(5, -1, 9999), 1, True), 0),
        ((PARAMS, ready(-1, -1), 1, True), None),
    ),
]

# --- the short way -----------------------------------------------------------------------------------------------

NEXT = T + 16_667_000
SLOW = replace(CORE, known=((), (), ()))
LIMITS = quick.limits_of(PARAMS)


def short(site: PmuParams = SITE, last: Pmu | None = None, late_ns: int = 65 * MS, **seen: Any) -> str:
    """The memory after one more frame, or that the short way does not apply."""
    return repr(quick.next_frame(LIMITS, site.base_v, last or memory(), next_sample(**seen), NEXT + late_ns))


def next_sample(**seen: Any) -> Sample:
    return sample(**{"time_ns": NEXT, "arrival_ns": NEXT + 60 * MS, **seen})


def tables(site: PmuParams = SITE, last: Pmu | None = None, late_ns: int = 65 * MS, **seen: Any) -> str:
    """By the tables; fails where one of their rows is up."""
    given = (next_sample(**seen),)
    found = pmus_of.update(PARAMS, SLOW, SLOW.tables(PARAMS), site, last or memory(), given, NEXT + late_ns)
    assert not found.raised, CORE.named(found.raised)
    return repr(found)


def at(pu: float = 1.0, deg: float = 0.0) -> complex:
    return complex(BASE * pu * math.cos(math.radians(deg)), BASE * pu * math.sin(math.radians(deg)))


FULL = tuple(1e-3 * k for k in range(32))
PASSED: list[dict[str, Any]] = [
    {},
    {"v1": at(1.0995, 0.1), "frequency_hz": 60.001, "v2": at(0.0549, 30)},
    {"v1": at(0.9005, -0.1), "frequency_hz": 59.999},
    {"v1": at(1.0, 0.2), "last": memory(freq=Freq(0.003, 0.001, 0.002, 0.004), ring=FULL)},
    {
        "v1": at(1.0, 0.2),
        "last": turned(increment=0.003, f=0.02, before=0.018, freq=Freq(0.02, 0.02, 0.02, 0.02)),
        "frequency_hz": 60.02,
    },
    {"v1": at(1.0, -179.9), "last": memory(v1=at(1, 179.9), filter=Filter(math.radians(179.9), 0.0, 0.0, 0.0, 3))},
    {"v1": at(1.0, 179.9), "last": memory(v1=at(1, -179.9), filter=Filter(math.radians(-179.9), 0.0, 0.0, 0.0, 3))},
    {"v1": at(1.19), "last": memory(magnitude_v=1.15 * BASE)},
    {"v1": at(0.81), "last": memory(magnitude_v=0.85 * BASE)},
    {"v1": at(1.3), "site": BARE},
    {"v1": 0.9j, "last": memory(filter=Filter(math.pi / 2, 0.0, 0.0, 0.0, 3)), "site": BARE},
    *(
        {
            "v1": at(1, 6 * f),
            "frequency_hz": 60 + f,
            "last": turned(increment=math.radians(6 * f), f=f, before=f, freq=Freq(f, f, f, f)),
        }
        for f in (0.9, -0.9)
    ),
    *({"stat": stat} for stat in (0x000F, 0x0200, 0x0800, 0x1000, 4 << 6)),
    *({"time_quality": quality} for quality in (1, 6, 0x76)),
    *({"time_ns": NEXT + ns} for ns in (9_000, -10_000)),
    {"time_ns": NEXT + 900_000, "arrival_ns": NEXT + 60 * MS, "time_base": 1000},
    *({"arrival_ns": NEXT + ms * MS, "late_ns": late * MS} for ms, late in ((-4, 40), (89, 65), (66, 65))),
    *({"late_ns": ns} for ns in (60 * MS, 109 * MS, 109_999_000)),
    *({"arrival_ns": NEXT + ns, "late_ns": 40 * MS} for ns in (1000 - 5 * MS, 90 * MS - 1000)),
    {"stat": 4, "time_quality": 6},
    {"last": memory(slot=SLOT + 1, time_ns=T + 10 * MS), "time_ns": NEXT + 10 * MS, "arrival_ns": NEXT + 70 * MS},
    {"last": memory(raised=1, held=(1, 0, 0, 0), evidence=((1, 1.0),), idle_ticks=2)},
]
NOT_PASSED: list[dict[str, Any]] = [
    {"last": memory(2)},
    {"last": memory(slot=None)},
    *({"last": memory(slot=SLOT + off)} for off in (-1, 1)),
    *({"time_ns": NEXT + ns} for ns in (11_000, -11_000)),
    *({"stat": stat} for stat in (0x8000, 0x4000, 0x2000, 0x0400, 0x0010, 0x0020, 5 << 6, 7 << 6)),
    *({"time_quality": quality} for quality in (7, 15)),
    {"stat": 4 << 6, "time_quality": 7},
    *({"arrival_ns": NEXT + ns} for ns in (-5 * MS, 90 * MS, 91 * MS, -6 * MS)),
    {"late_ns": 111 * MS},
    *({"v1": bad, "site": BARE} for bad in (0j, complex(NAN, 0), complex(1e308, 1.7e308), complex(INF, 0))),
    *({"v1": at(pu)} for pu in (1.101, 0.899)),
    *({"v1": at(pu), "last": memory(magnitude_v=pu * BASE)} for pu in (1.201, 0.799)),
    {"v2": at(0.0501)},
    *({"v2": part * at(0.04) + 1j * at(0.031)} for part in (1, -1)),
    *({"v1": at(1.0, deg)} for deg in (5.01, -5.01)),
    *({"v1": at(1.0, deg), "last": turned(f=f)} for deg, f in ((0.0, 1.1), (0.0, -1.1))),
    *({"last": turned(f=f, before=f)} for f in (0.9, -0.9)),
    {"v1": at(1, 4.0)},
    {"v1": at(1, 0.2), "frequency_hz": 61.5},
    {"v1": at(1, 0.2), "frequency_hz": NAN},
    {"frequency_hz": 60.001},
    {"v1": at(1, 0.2), "last": memory(freq=Freq(0.0, 0.0, 0.03, 0.03))},
    {"v1": at(1, 0.2), "last": memory(freq=Freq(0.5, 0.5, 0.0, 0.0))},
]
FIFTY = quick.limits_of(replace(PARAMS, rate_hz=50))
"""At 50 frames/s a stamp can be off by the tolerance exactly."""


def followed(ns: int) -> bool:
    """Whether a frame so long after the last is the next one."""
    last = memory(slot=T * 50 // 10**9)
    return quick.next_frame(FIFTY, BASE, last, sample(time_ns=T + ns, arrival_ns=T + 60 * MS), T + 65 * MS) is not None


PAIR_SLOT = 100


def many(*verified: int, state: InstanceState = InstanceState.READY, **changed: Any) -> list[Instance]:
    return [Instance(state, k, PAIR_SLOT - 2, 0.0, "was")._replace(**changed) for k in verified]


def stood(*hz: float, **changed: Any) -> list[Pmu]:
    return [Pmu(PAIR_SLOT, T, T, ring=(f,))._replace(**changed) for f in hz]


PAIRS = Params.paired(("N1", "N2"), ("S1",)).instances


def together(last: list[Instance], pmus: list[Pmu], age_ms: float = 70.0, disabling: int = 2) -> Any:
    return quick.next_instances(LIMITS, PAIRS, last, pmus, disabling, T + round(age_ms * MS))


def after(*mhz: float) -> tuple[Instance, ...]:
    return tuple(Instance(InstanceState.READY, 9, PAIR_SLOT, pytest.approx(x), "was") for x in mhz)  # type: ignore[arg-type]


NEAR = stood(0.003, 0.0045, 0.001)
SHORT = [
    *((short, (given,), tables(**given)) for given in PASSED),
    *((short, (given,), "None") for given in NOT_PASSED),
    *of(followed, *((ns, True) for ns in (20_010_000, 19_990_000)), *((ns, False) for ns in (20_010_001, 19_989_999))),
    *of(
        together,
        ((many(7, 7), NEAR), after(2.0, 3.5)),
        ((many(7, 7, state=InstanceState.HELD), NEAR), after(2.0, 3.5)),
        ((many(7, 7), stood(0.003, 0.0005, 0.001)), after(2.0, -0.5)),
        ((many(7, 7), NEAR, 199.999), after(2.0, 3.5)),
        ((many(7, 7), NEAR, 200.0), None),
        ((many(7, 7), stood(0.003, 0.0061, 0.001)), None),
        ((many(7, 7), stood(0.0061, 0.003, 0.001)), None),
        ((many(7, 7), stood(0.003, 0.0045, 0.001, raised=1)), after(2.0, 3.5)),
        ((many(7, 7), [*NEAR[:2], NEAR[2]._replace(raised=2)]), None),
        ((many(7, 7), [*NEAR[:2], NEAR[2]._replace(slot=PAIR_SLOT - 1)]), None),
        ((many(7, 7), [*NEAR[:2], NEAR[2]._replace(time_ns=T + 1)]), None),
        ((many(7, 7), [*NEAR[:2], NEAR[2]._replace(ring=())]), None),
        ((many(7, 7), stood(0.003, 0.0045, 0.001, slot=None)), None),
        ((many(7, 7, raised=1), NEAR), None),
        ((many(7, 7, state=InstanceState.INITIALISING), NEAR), None),
        ((many(7, 7, slot=None), NEAR), None),
        ((many(7, 7, slot=PAIR_SLOT), NEAR), None),
        ((many(7, 7, slot=PAIR_SLOT + 1), NEAR), None),
    ),
]

# --- the whole controller ----------------------------------------------------------------------------------------

STRICT = replace(PARAMS, required=Required(True, True, True, True))
STATUS = Pdci(T, 1500.0)
OLD = STATUS._replace(time_ns=T - 2_000_000_000)
OLDER = STATUS._replace(time_ns=T - 2_000_000_001)


def view(**changed: Any) -> SystemView:
    bare = SystemView(SystemState.ACTIVE, 2, None, None, False, 0, QUIET, 0.0, NOTHING, T)
    return bare._replace(**changed)


def seen(params: Params = PARAMS, driven_mw: float = 0.0, **told: Any) -> tuple[Params, SystemView]:
    return params, view(surroundings=Surroundings(**told), driven_mw=driven_mw)


def scheduled(mw: float, power_mw: float = 1500.0, params: Params = PARAMS) -> tuple[Params, Pdci, float]:
    return params, Pdci(T, power_mw, scheduled_mw=mw), 50.0


def rated(north_south: float, south_north: float) -> Params:
    return replace(PARAMS, line=Line(north_south, south_north, 0.0))


def remembered(**changed: Any) -> tuple[Params, SystemView]:
    return PARAMS, view(feedback=QUIET._replace(**changed))


OPEN = Surroundings(relays_closed=False)
RATED = ((0.5, (900.0, 0.6)), (-0.5, (0.6, 900.0)))
"""At half a megawatt: the rating of the other direction does not count."""
PEAKS = (90.0, 80.0, 75.0, 60.0, 50.0, 40.0, 30.0)
"""Over a cycle they grow by 1.2, 1.333, 1.5, 1.5 and 1.667."""
SYSTEM = [
    *of(system_rows.ready_instances, ((PARAMS, view(ready=3)), 3)),
    *of(system_rows.frequency_difference, ((PARAMS, view()), None)),
    *of(system_rows.frequency_difference, ((PARAMS, view(active=Instance(delta_f_mhz=-7.0))), 7.0)),
    *of(system_rows.angle_difference, ((PARAMS, view()), None), ((PARAMS, view(angle_deg=-30.0)), 30.0)),
    *of(system_rows.slipping, ((PARAMS, view(slipped=True)), 1.0), ((PARAMS, view()), 0.0)),
    *of(system_rows.saturation, (remembered(saturated=0b1011), 0.5)),
    *of(system_rows.ringing, (remembered(ringing_mw2=49.0), 7.0)),
    *of(
        system_rows.growing,
        (remembered(peaks_mw=PEAKS), 1.2**3),
        (remembered(peaks_mw=(*PEAKS[:-1], 29.9)), None),
        (remembered(peaks_mw=PEAKS[:-1]), None),
        (remembered(peaks_mw=(90.0, 80.0, 60.0, 50.0, 45.0, 40.0, 40.0)), (45 / 40) ** 3),
    ),
    *of(system_rows.bias, (remembered(means_mw=(-30.0,) * 29), None)),
    *of(system_rows.bias, (remembered(means_mw=(-30.0,) * 15 + (10.0,) * 15), 10.0)),
    *of(system_rows.overrun, *(((PARAMS, view(overruns=bits)), bits & 1) for bits in (0b10, 0b11, 0))),
    *of(
        system_rows.overruns,
        *(((PARAMS, view(overruns=0b1011, state=state)), 3) for state in (SystemState.ARMED, SystemState.RAMPDOWN)),
        ((PARAMS, view(overruns=0b1011, state=SystemState.STANDBY)), None),
    ),
    *of(system_rows.readback, (seen(), None), (seen(driven_mw=75.0, readback_v=4.0), 20.0)),
    *of(system_rows.gps, *((seen(gps_age_s=age), age) for age in (None, 0.0, 7.0)), (seen(STRICT, gps_age_s=0.0), 0.0)),
    *of(system_rows.watchdog, *((seen(watchdog_healthy=ok), ok) for ok in (None, True, False)), (seen(STRICT), NAN)),
    *of(system_rows.emergency_stop, *((seen(estop_released=ok), ok) for ok in (None, True, False))),
    *of(system_rows.emergency_stop, (seen(STRICT), NAN)),
    *of(
        system_rows.relays,
        *((seen(relays_closed=closed), closed) for closed in (None, True, False)),
        *((seen(STRICT), None), ((PARAMS, view(state=SystemState.ARMED, surroundings=OPEN)), 0.0)),
        *(((PARAMS, view(state=state, surroundings=OPEN)), None) for state in (SystemState.RAMPDOWN, SystemState.INIT)),
    ),
    *of(system_rows.server, *((seen(server_age_s=age), age) for age in (None, 0.0, 7.0)), (seen(STRICT), NAN)),
    *of(system_rows.disk, (seen(disk_free_percent=7.0), 7.0)),
    *of(system_rows.gps, (seen(STRICT), NAN)),
    *of(
        system_rows.line_in_service,
        *((seen(pdci=STATUS._replace(in_service=ok)), float(ok)) for ok in (True, False)),
        *((seen(pdci=OLDER), None), (seen(STRICT), NAN)),
    ),
    *of(
        system_rows.line_enabled,
        *((seen(pdci=STATUS._replace(dcon_enabled=ok)), float(ok)) for ok in (True, False)),
        *((seen(pdci=OLDER), None), (seen(STRICT), NAN)),
    ),
    *of(system_rows.line_margin, (seen(pdci=OLDER), None), (seen(driven_mw=100.0, pdci=OLD), 1400.0 - 310 - 125)),
    *of(system_rows.response_gain, (seen(response_gain=0.5), 0.5)),
    *of(system_rows.response_lag, (seen(response_lag_ms=70.0), 70.0)),
    *of(system_rows._told, ((None, True), NAN), ((None, False), None), ((3.0, True), 3.0)),
    *of(
        line.line_status,
        ((PARAMS, NOTHING, T), None),
        *(((PARAMS, Surroundings(pdci=status), T), want) for status, want in ((OLD, OLD), (OLDER, None))),
    ),
    *of(line.margin_mw, (scheduled(1000.0), 565.0), (scheduled(3000.0), 95.0), (scheduled(-3000.0), -25.0)),
    *of(line.margin_mw, (scheduled(-400.0), -35.0), (scheduled(NAN, 1050.0), 565.0), (scheduled(NAN, -350.0), -35.0)),
    *of(line.margin_mw, *((scheduled(mw, params=rated(*ratings)), -124.5) for mw, ratings in RATED)),
]

ARM = ArmView(1, 0.0, Surroundings(0.0, True, True, STATUS, server_age_s=0.0), T)


def arm(params: Params = PARAMS, **told: Any) -> tuple[Params, ArmView]:
    return params, ARM._replace(surroundings=ARM.surroundings._replace(**told))


def lacking(name: str) -> list[tuple[Any, Any]]:
    """Not fitted: allowed, unless it is required."""
    return [(arm(**{name: None}), True), (arm(STRICT, **{name: None}), False)]


FOUR = Params.paired(("N1", "N2"), ("S1", "S2"))
ARMING = [
    *of(system._enough_ready, *(((FOUR, ARM._replace(ready=k)), k >= 2) for k in (1, 2, 3))),
    *of(system._enough_ready, *(((PARAMS, ARM._replace(ready=k)), k >= 1) for k in (0, 1))),
    *of(system._command_small, *(((PARAMS, ARM._replace(command_mw=mw)), True) for mw in (62.5, -62.5))),
    *of(system._command_small, *(((PARAMS, ARM._replace(command_mw=mw)), False) for mw in (63.0, -63.0))),
    *of(system._gps_locked, (arm(gps_age_s=0.0), True), (arm(gps_age_s=0.1), False), (arm(gps_age_s=1.0), False)),
    *of(system._gps_locked, *lacking("gps_age_s")),
    *of(system._watchdog_healthy, (arm(), True), (arm(watchdog_healthy=False), False), *lacking("watchdog_healthy")),
    *of(system._estop_released, (arm(), True), (arm(estop_released=False), False), *lacking("estop_released")),
    *of(system._server_there, (arm(server_age_s=2.0), True), (arm(server_age_s=2.1), False), *lacking("server_age_s")),
    *of(
        system._line_takes_it,
        *((arm(), True), (arm(pdci=STATUS._replace(in_service=False)), False)),
        *((arm(pdci=STATUS._replace(dcon_enabled=False)), False), *lacking("pdci")),
    ),
    *of(system._line_has_room, *((arm(pdci=STATUS._replace(power_mw=mw)), mw >= 435) for mw in (435.0, 435.5, 434.9))),
    *of(system._line_has_room, *lacking("pdci")),
    *of(system._all_acknowledged, (arm(), True), ((PARAMS, ARM._replace(latched=("gps",))), False)),
    *of(system._all_fallen, (arm(), True), ((PARAMS, ARM._replace(still_up=("gps",))), False)),
    *of(
        system.refusal,
        ((PARAMS, SystemState.STANDBY, Trigger.ARM, ARM), ""),
        ((PARAMS, SystemState.ARMED, Trigger.ACTIVATE, ARM), ""),
        ((PARAMS, SystemState.STANDBY, Trigger.ACTIVATE, ARM), "not possible in STANDBY"),
        ((PARAMS, SystemState.FAULT, Trigger.RESET, ARM), ""),
        ((PARAMS, SystemState.FAULT, Trigger.RESET, ARM._replace(causes=("a", "b"))), "still up: a b"),
        ((PARAMS, SystemState.ACTIVE, Trigger.DISARM, ARM._replace(ready=0, causes=("a",))), ""),
        (
            (PARAMS, SystemState.STANDBY, Trigger.ARM, ARM._replace(ready=0, latched=("a",), causes=("a",))),
            "too few control instances are READY; what disarmed or tripped last is not acknowledged",
        ),
    ),
]

# --- what judges, remembers and acts -----------------------------------------------------------------------------


def row(value: float | None, held: int = -1, need: int = 1) -> tuple[float | None, int, int]:
    return value, held, need


def judged(*given: tuple[float | None, int, int], held: tuple[int, ...] = ()) -> Any:
    """Rows that stand from 0 to 1, with bits 1, 2, 4 ..."""
    made = [Judged(1 << k, lambda value=value: value, 0.0, 1.0, at, need) for k, (value, at, need) in enumerate(given)]
    return checks.judge(made, held, ())


def asked(*given: Any, held: tuple[int, ...] = ()) -> tuple[Any, tuple[Any, ...]]:
    return given, held


def judge(case: tuple[Any, tuple[int, ...]]) -> Any:
    return judged(*case[0], held=case[1])


FLAG = Flag("ringing", "system", True, 5, 7, 2, 1.5, 1.0, True)
DOWN = FLAG._replace(up=False)
SEEN = FLAG._replace(acknowledged="A")
KEPT = {("ringing", "system"): FLAG}
LONG = 1200
SWING = tuple(50.0 * math.sin(2 * math.pi * 0.5 * k / 60) for k in range(LONG))
RING = tuple(50.0 * math.sin(2 * math.pi * 4 * k / 60) for k in range(300))
TURNING = QUIET._replace(half_mw=-40.0, peaks_mw=tuple(range(1, 8)))
BIT = CORE.bits


def watch(last: Feedback, command_mw: float, asked_mw: float = 0.0, params: Params = PARAMS) -> Any:
    got = feedback.watched(params, last, command_mw, asked_mw)
    swing = math.copysign(1, got.half_mw) if got.half_mw else 0.0
    return got.ticks, got.saturated, swing, got.peaks_mw, got.second_mw, got.means_mw, got.ringing_mw2 > 0


def watch_all(values: tuple[float, ...]) -> tuple[float, ...]:
    """Number and newest of the peaks of half cycles, RMS of the ringing."""
    state = QUIET
    for mw in values:
        state = feedback.watched(PARAMS, state, mw, mw)
    return len(state.peaks_mw), *state.peaks_mw[:2], feedback.ringing_mw(state)


def passed(hz: float, edge_hz: float) -> float:
    """Of a Butterworth filter of second order."""
    return 1 / math.sqrt(1 + (hz / edge_hz) ** 4)


PEAK = 50 * passed(0.1, 0.5) * passed(0.5, 1.5)
JUDGING = [
    *of(
        judge,
        ((asked(),), (0, (), ())),
        ((asked(row(1.0), row(0.0), row(None)),), (0, (), ())),
        ((asked(row(1.1), row(-0.1)),), (3, (), ((1, 1.1), (2, -0.1)))),
        ((asked(row(NAN)),), (1, (), ((1, NAN),))),
        ((asked(row(9.0, 0, 2)),), (0, (1,), ())),
        *(((asked(row(9.0, 0, 2), held=(k,)),), (1, (2,), ((1, 9.0),))) for k in (1, 2)),
        ((asked(row(9.0, 0, 3), row(0.5, 1, 3), row(9.0), held=(1, 2)),), (4, (2, 0), ((4, 9.0),))),
        ((asked(row(0.5, 0, 3), row(9.0, 1, 3), held=(1, 1)),), (0, (0, 2), ())),
        ((asked(row(9.0), row(9.0, 0, 1)),), (3, (1,), ((1, 9.0), (2, 9.0)))),
        ((asked(row(0.5, 0, 3), held=(2,)),), (0, (), ())),
    ),
    *of(checks.bound, ((PARAMS, 5), 5.0), ((PARAMS, "gap_ms"), 50.0), ((PARAMS, lambda params: params.rate_hz), 60.0)),
    *of(checks.needed, ((PARAMS, "", 30), 1), ((PARAMS, "unbalance_s", 30), 30), ((PARAMS, "freq_warn_s", 30), 15)),
    *of(checks.needed, ((PARAMS, "frozen_frames", 30), 5), ((PARAMS, "readback_ticks", 30), 3)),
    *of(checks.needed, ((replace(PARAMS, thresholds=Thresholds(unbalance_s=0)), "unbalance_s", 60), 1)),
    *of(checks.which, ((False, False), 0), ((True, False), 1), ((False, True), 2), ((True, True), 3)),
    *of(register.with_changes, (({}, []), {}), (({1: FLAG}, [FLAG]), {1: FLAG, **KEPT})),
    *of(register.risen, (({}, "a", "b", 9, 2.5, 2.0), Flag("a", "b", True, 9, 9, 1, 2.5, 2.0, False))),
    *of(
        register.risen,
        (
            ({("ringing", "system"): DOWN._replace(acknowledged="A")}, "ringing", "system", 9, 2.5, 2.0),
            FLAG._replace(last_ns=9, times=3, value=2.5, limit=2.0),
        ),
    ),
    *of(
        register.fallen,
        ((FLAG, 9), DOWN._replace(last_ns=9)),
        ((FLAG._replace(acknowledged="A"), 9), DOWN._replace(last_ns=9, latched=False, acknowledged="A")),
        ((FLAG._replace(latched=False), 9), DOWN._replace(last_ns=9, latched=False)),
    ),
    *of(
        register.acknowledged,
        ((FLAG, "A"), FLAG._replace(acknowledged="A")),
        ((DOWN, "A"), DOWN._replace(latched=False, acknowledged="A")),
        ((FLAG._replace(latched=False), "A"), FLAG._replace(latched=False, acknowledged="A")),
    ),
    *of(register.latched, ({1: FLAG, 2: FLAG._replace(name="b", latched=False)}, ["ringing"])),
    *of(
        register.open_flags,
        *((({1: FLAG, 2: SEEN}, text), [FLAG]) for text in ("", "ringing", "ringing system")),
        *((({1: FLAG}, text), []) for text in ("ringing N1", "x", "x system")),
    ),
    *of(
        watch,
        ((QUIET, 125.0), (1, 1, 1.0, (), 125.0, (), False)),
        ((QUIET._replace(saturated=0b101, ticks=4), -125.0), (5, 0b1011, -1.0, (), -125.0, (), False)),
        ((QUIET._replace(saturated=0b101), 124.9), (1, 0b1010, 1.0, (), 124.9, (), False)),
        ((QUIET._replace(saturated=1 << 599), 125.0), (1, 1, 1.0, (), 125.0, (), False)),
        ((QUIET._replace(saturated=1 << 598), 0.0), (1, 1 << 599, 0.0, (), 0.0, (), False)),
        ((QUIET, 0.0, 0.0, replace(PARAMS, limit_mw=0.0)), (1, 0, 0.0, (), 0.0, (), False)),
        ((QUIET, 0.5, 0.0, replace(PARAMS, limit_mw=0.5)), (1, 1, 1.0, (), 0.5, (), False)),
        ((QUIET._replace(ticks=59, second_mw=60.0, means_mw=(5.0,)), 60.0), (60, 0, 1.0, (), 0.0, (2.0, 5.0), False)),
        ((QUIET._replace(ticks=60, second_mw=60.0), 60.0), (61, 0, 1.0, (), 120.0, (), False)),
        ((QUIET._replace(ticks=59, means_mw=(5.0,) * 30), 0.0), (60, 0, 0.0, (), 0.0, (0.0, *(5.0,) * 29), False)),
        ((QUIET, 0.0, 50.0), (1, 0, 0.0, (), 0.0, (), True)),
        ((TURNING, 125.0), (1, 1, 1.0, (40.0, 1, 2, 3, 4, 5, 6), 125.0, (), False)),
        ((QUIET._replace(half_mw=40.0), 125.0), (1, 1, 1.0, (), 125.0, (), False)),
    ),
    *of(watch_all, ((SWING,), (7, *[pytest.approx(PEAK, rel=0.01)] * 2, pytest.approx(0, abs=1)))),
    *of(watch_all, ((RING,), (7, *[pytest.approx(6.9, abs=0.3)] * 2, pytest.approx(34.3, abs=0.2)))),
    *of(feedback.saturated_percent, ((PARAMS, QUIET._replace(saturated=0b111)), 0.5)),
    *of(feedback.ringing_mw, ((QUIET._replace(ringing_mw2=4.0),), 2.0)),
]

HELD_STATE = initial_state(PARAMS)._replace(active=0, angle_deg=170.0)


def acted(system_: SystemState, raised: int, ready_: int = 0) -> Any:
    """State, events, and what is latched of a register that knows every check."""
    events: list[Event] = []
    flags = {(name, "system"): FLAG._replace(name=name, latched=False) for name in CORE.names}
    after_, kept = step._supervise(CORE, system_, flags, raised, ready_, events)
    return after_, [event.name for event in events], register.latched(kept)


def compare(before: int, now: int, evidence: Any = ()) -> Any:
    kept = {("latency", "N1"): FLAG._replace(name="latency", subject="N1")}
    after_ = changes.compared(CORE, CORE.tables(PARAMS), kept, "N1", before, now, evidence, 9)
    return sorted((f.name, f.up, f.last_ns, f.value, f.limit) for f in after_.values())


LAST = ("latency", True, 7, 1.5, 1.0)
S = SystemState
ACTING = [
    *of(
        step._slipped,
        ((HELD_STATE, 0, -170.0), True),
        ((HELD_STATE, 0, -10.0), False),
        ((HELD_STATE, 0, -10.5), True),
        ((HELD_STATE._replace(angle_deg=-170.0), 0, 170.0), True),
        ((HELD_STATE, 0, None), False),
        ((HELD_STATE._replace(angle_deg=None), 0, -170.0), False),
        ((HELD_STATE._replace(active=1), 0, -170.0), False),
    ),
    *of(
        acted,
        ((S.INIT, 0, 1), (S.STANDBY, ["standby"], [])),
        ((S.INIT, 0, 0), (S.INIT, [], [])),
        ((S.ACTIVE, 0, 1), (S.ACTIVE, [], [])),
        ((S.ACTIVE, BIT["server"] | BIT["bias"], 1), (S.ACTIVE, [], [])),
        ((S.ACTIVE, BIT["gps"], 1), (S.RAMPDOWN, ["rampdown"], ["gps"])),
        ((S.STANDBY, BIT["gps"], 1), (S.STANDBY, [], [])),
        ((S.ACTIVE, BIT["watchdog"], 1), (S.FAULT, ["fault"], ["watchdog"])),
        ((S.FAULT, BIT["watchdog"], 1), (S.FAULT, [], [])),
        ((S.ACTIVE, BIT["estop"], 1), (S.ESTOP, ["estop"], ["estop"])),
        (
            (S.ACTIVE, BIT["gps"] | BIT["watchdog"] | BIT["estop"], 1),
            (S.ESTOP, ["rampdown", "fault", "estop"], ["estop", "gps", "watchdog"]),
        ),
    ),
    *of(
        compare,
        ((5, 5), [LAST]),
        ((BIT["latency"], 0), [("latency", False, 9, 1.5, 1.0)]),
        ((0, BIT["voltage"], ((BIT["voltage"], 1.3),)), [LAST, ("voltage", True, 9, 1.3, 1.2)]),
        ((0, BIT["voltage"], ((BIT["voltage"], 0.7),)), [LAST, ("voltage", True, 9, 0.7, 0.8)]),
        ((BIT["voltage"], BIT["voltage"] | BIT["rocof"], ((BIT["rocof"], 9.0),)), [LAST, ("rocof", True, 9, 9.0, 5.0)]),
        ((BIT["frozen"], 0), [LAST]),
        ((0, BIT["disk"], ((BIT["disk"], NAN),)), [("disk", True, 9, NAN, 10.0), LAST]),
        ((0, BIT["rocof"], ((BIT["rocof"], NAN),)), [LAST, ("rocof", True, 9, NAN, 5.0)]),
    ),
]

# --- the trial ---------------------------------------------------------------------------------------------------

FACTS = [*LIMITER, *FRAMES, *INSTANCES, *SHORT, *SYSTEM, *ARMING, *JUDGING, *ACTING]
ABOUT: dict[Callable[..., Any], tuple[FunctionType, ...]] = {
    short: (quick.next_frame,),
    followed: (quick.next_frame,),
    together: (quick.next_instances,),
    judge: (checks.judge,),
    watch: (feedback.watched,),
    watch_all: (feedback.watched,),
    acted: (step._supervise,),
    compare: (changes.compared,),
    system_rows.growing: (system_rows.growing, feedback.growth),
    system_rows.bias: (system_rows.bias, feedback.bias_mw),
    rows.time_quality: (rows.time_quality, stamps.clock_error_us),
}  # type: ignore[dict-item]
"""What a fact is about, where that is not the function that it calls."""
FUNCTIONS: dict[FunctionType, list[Fact]] = {}
for _fact in FACTS:
    for _function in ABOUT.get(_fact[0], (_fact[0],)):
        FUNCTIONS.setdefault(_function, []).append(_fact)  # type: ignore[arg-type]

HAIR = "a hair inside the limit the tables say the same"
EQUIVALENT = {
    **{f"next_frame line {k}: LtE -> Lt #0": HAIR for k in (29, 32, 47, 48, 49, 50)},
    "next_frame line 29: LtE -> Lt #1": HAIR,
    "next_frame line 36: Gt -> GtE #0": "a turn of 180° in a frame is within no limit of frequency",
    "next_frame line 38: LtE -> Lt #0": "a turn of 180° in a frame is within no limit of frequency",
    "median_mhz line 3: True": "there is one find for each instance: strict or not",
    "next_instances line 15: True": "there is one pair for each instance: strict or not",
    "next_instances line 5: 0 + 1": "any PMU will do: all must stand at one stamp",
    "next_instances line 19: Lt -> LtE #0": "of two equal numbers either is the least",
    "next_instances line 21: Gt -> GtE #0": "of two equal numbers either is the most",
    "next_instances line 24: LtE -> Lt #0": HAIR,
    "margin_mw line 9: GtE -> Gt #0": "at 0 MW the minimum decides, not the rating",
    "watched line 17: Gt -> GtE #0": "the same number in its own place",
    "compared line 20: Gt -> GtE #0": "at its bound a row is down, and nothing is compared",
}
"""Mutants that do what the original does, and why."""


def same(got: object, want: object) -> bool:
    """Equal, with NaN equal to itself, and floats to rounding."""
    if isinstance(got, float) and isinstance(want, float):
        return (math.isnan(got) and math.isnan(want)) or math.isclose(got, want, rel_tol=1e-9, abs_tol=1e-9)
    if isinstance(got, tuple | list) and isinstance(want, tuple | list):
        return len(got) == len(want) and all(map(same, got, want))
    return got == want


def result(fact: Fact) -> Any:
    function, arguments, _ = fact
    return function(**arguments[0]) if function is short else function(*arguments)


def holds(fact: Fact) -> bool:
    try:
        return same(result(fact), fact[2])
    except Exception:
        return False


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda function: f"{function.__module__}.{function.__name__}")
def test_the_facts_hold(function: FunctionType) -> None:
    for fact in FUNCTIONS[function]:
        assert same(result(fact), fact[2]), (fact[1], result(fact), fact[2])


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda function: f"{function.__module__}.{function.__name__}")
def test_no_mutant_survives(function: FunctionType) -> None:
    facts = FUNCTIONS[function]
    left = survivors(function, lambda: all(map(holds, facts)))
    assert [what for what in left if what not in EQUIVALENT] == []
    assert {what for what in EQUIVALENT if what.startswith(f"{function.__name__} ")} <= set(left)


def test_there_are_mutants_and_every_check_is_among_them() -> None:
    values = {row.value for row in CORE.rows if row.value is not None}
    assert values <= set(FUNCTIONS)
    assert {limiter._number, limiter.limit, limiter.volts} <= set(FUNCTIONS)
    assert sum(len(list(mutants(function))) for function in FUNCTIONS) > 400
