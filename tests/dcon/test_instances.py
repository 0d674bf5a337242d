"""States of the control instances, re-initialisation, priority."""

from __future__ import annotations

import math

import pytest
from support.loop import params
from support.streams import MS, START_NS, play, samples, ticks

from dcon.core.instance import TRANSITIONS, choose, update
from dcon.core.params import Params, Thresholds
from dcon.core.rows import CORE
from dcon.core.state import Instance, Pmu, State, initial_state
from dcon.core.values import InstanceState, Record, Sample

PAIR = Params.paired(("N1",), ("S1",), nominal_kv=500.0)
STEADY = list(samples(lambda _: 0.0, 1400))


def states(history: list[tuple[State, Record]]) -> list[InstanceState]:
    return [record.instances[0].state for _, record in history]


def test_ready_after_twenty_seconds_of_valid_frames() -> None:
    history = play(PAIR, ticks((STEADY, STEADY), 1300), state=initial_state(PAIR))
    seen = states(history)
    first, ready = seen.index(InstanceState.INITIALISING), seen.index(InstanceState.READY)
    assert ready - first == 1199  # 1,200 aligned frames, the first of them at ``first``
    assert set(seen[:first]) == {InstanceState.DISABLED}
    assert set(seen[ready:]) == {InstanceState.READY}


def test_any_fault_restarts_the_count() -> None:
    broken = [*STEADY[:600], STEADY[600]._replace(stat=0x8000), *STEADY[601:]]
    history = play(PAIR, ticks((STEADY, broken), 1400), state=initial_state(PAIR))
    assert InstanceState.READY not in states(history)
    assert history[620][1].instances[0].reason == "S1: stat_error"
    assert history[-1][0].instances[0].verified < 1200


def test_verified_sessions_are_ready_with_the_first_frequency() -> None:
    history = play(PAIR, ticks((STEADY[:60], STEADY[:60]), 30))
    seen = states(history)
    assert InstanceState.INITIALISING not in seen and seen[-1] is InstanceState.READY


def test_a_window_without_frames_holds() -> None:
    late = [frame._replace(arrival_ns=frame.arrival_ns + 20 * MS * (k == 50)) for k, frame in enumerate(STEADY[:100])]
    late[51] = late[51]._replace(arrival_ns=late[50].arrival_ns)
    history = play(PAIR, ticks((STEADY[:100], late), 90))
    assert states(history).count(InstanceState.HELD) == 1
    assert InstanceState.DISABLED not in states(history)[20:]


def test_the_first_reason_stands_until_the_instance_comes_back() -> None:
    params = Params.paired(("N1",), ("S1",), init_s=0.5)
    bad = [frame._replace(stat=0x8000 * (90 <= k < 95 or k == 200)) for k, frame in enumerate(STEADY[:300])]
    stopped = [*bad[:60], *bad[90:]]
    reasons = [record.instances[0].reason for _, record in play(params, ticks((stopped, STEADY[:300]), 290))]
    assert list(dict.fromkeys(reasons)) == ["", "N1: arrival_gap", "N1: stat_error"]
    assert reasons[95:200] == ["N1: arrival_gap"] * 105


def fresh(slot: int, f: float = 0.0, **fields: object) -> Pmu:
    time_ns = START_NS + round(slot * 1e9 / 60)
    base = START_NS // 1_000_000_000 * 60
    return Pmu(slot=base + slot, time_ns=time_ns, arrival_ns=time_ns, ring=(f,) * 32, **fields)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("north", "south", "age_ms", "want"),
    [
        (fresh(10), fresh(10), 71, ""),
        (fresh(10), fresh(2), 60, ""),
        (fresh(10), fresh(1), 30, "alignment_skew"),
        (fresh(10), fresh(10), 200, ""),
        (fresh(10), fresh(10), 201, "alignment_age"),
        (fresh(10), fresh(10)._replace(time_ns=fresh(10).time_ns + 9_000), 71, ""),
        (fresh(10), fresh(10)._replace(time_ns=fresh(10).time_ns + 12_000), 71, "stamps_differ"),
        (fresh(10), fresh(10)._replace(time_ns=fresh(10).time_ns + 900_000, time_base=1000), 71, ""),
    ],
)
def test_checks_of_a_pair(north: Pmu, south: Pmu, age_ms: float, want: str) -> None:
    now_ns = max(north.time_ns, south.time_ns) + round(age_ms * MS)
    last = (Instance(InstanceState.READY, 2000),)
    ((after,), _) = update(PAIR, CORE, CORE.tables(PAIR), last, (north, south), now_ns)
    assert after.reason == want and (after.state is InstanceState.DISABLED) == bool(want)
    assert after.verified == (0 if want else 2001)


def test_a_lost_pmu_leaves_the_other_instances_alone() -> None:
    settings = params()
    streams = [STEADY[:200] for _ in range(8)]
    streams[2] = streams[2][:80]
    history = play(settings, ticks(streams, 160))
    for pair, instance in zip(settings.instances, history[-1][1].instances, strict=True):
        assert instance.state is (InstanceState.DISABLED if pair.north == 2 else InstanceState.READY)
        assert instance.reason == ("N3: arrival_gap" if pair.north == 2 else "")


def instance(ready: bool, verified: int = 1200) -> Instance:
    return Instance(InstanceState.READY if ready else InstanceState.DISABLED, verified)


def test_priority_and_no_flapping_back() -> None:
    settings = params()  # 20 s to be READY, 60 s more to take over
    no, yes, old = instance(False), instance(True), instance(True, 1200 + 3600)
    assert choose(settings, (no, yes, yes), None, keep=True) == 1
    assert choose(settings, (yes, yes, yes), 1, keep=True) == 1
    assert choose(settings, (yes, yes, yes), 1, keep=False) == 0
    assert choose(settings, (old, yes, yes), 1, keep=True) == 0
    assert choose(settings, (yes, no, old), 1, keep=True) == 0
    assert choose(settings, (no, yes, old), 1, keep=True) == 1
    assert choose(settings, (no, no, no), 1, keep=True) is None


def test_every_state_and_trigger() -> None:
    triggers = ("pair", "verified", "hold", "new", "fault")
    want = {
        "DISABLED": {"pair": "INITIALISING"},
        "INITIALISING": {"verified": "READY", "fault": "DISABLED"},
        "READY": {"hold": "HELD", "fault": "DISABLED"},
        "HELD": {"new": "READY", "fault": "DISABLED"},
    }
    for state in InstanceState:
        for trigger in triggers:
            assert TRANSITIONS.get((state, trigger), "") == want[state].get(trigger, "")


def test_at_other_rates() -> None:
    for rate in (30, 50, 100, 120):
        settings = Params.paired(("N1",), ("S1",), rate_hz=rate, init_s=1.0, thresholds=Thresholds(rocof_max_hz_s=5))
        north = list(samples(lambda t: 0.01 * math.sin(2.5 * t), 5 * rate, rate=rate))
        south: list[Sample] = list(samples(lambda t: -0.01 * math.sin(2.5 * t), 5 * rate, rate=rate))
        history = play(settings, ticks((north, south), 290), state=initial_state(settings))
        assert history[-1][1].instances[0].state in (InstanceState.READY, InstanceState.HELD)
        # 104 ms of filter and 2 to 6 periods of arrival behind a swing of 20 mHz.
        assert abs(history[-1][1].delta_f_mhz - 20 * math.sin(2.5 * (289 / 60 - 0.17))) < 1.0
