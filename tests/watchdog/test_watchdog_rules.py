"""Each rule below, at and above its limit, and what it does then."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
from support.guarded import RELEASED, RULES, T0_NS, Bench

from dcon.watchdog.codec import FAILED, LOOPS, RUNNING
from dcon.watchdog.limits import BOUNDS, Limits, refusal
from dcon.watchdog.memory import MS, Contact, Inputs, Loop, Memory, Offences, State, Worst
from dcon.watchdog.rules import BIT, CAUSES, Action, Rule, causes_of, judge
from dcon.watchdog.rules import RULES as TABLE

USUAL = Bench().closed().memory
"""Of a watchdog whose relays are closed, with nothing wrong."""
NOW_NS = USUAL.now_ns


def loop(at: int, **changed: Any) -> Callable[[float], Memory]:
    """Memory whose loop is changed: each change is a function of the value."""

    def made(value: float) -> Memory:
        old = USUAL.loops[at] or Loop(0, NOW_NS, NOW_NS, RUNNING, NOW_NS)
        new = old._replace(**{key: change(value) for key, change in changed.items()})
        return USUAL._replace(loops=(*USUAL.loops[:at], new, *USUAL.loops[at + 1 :]))

    return made


def ago(ms: float) -> int:
    return NOW_NS - round(ms * MS)


def plain(**changed: Callable[[float], Any]) -> Callable[[float], Memory]:
    return lambda value: USUAL._replace(**{key: change(value) for key, change in changed.items()})


def worst(**changed: Callable[[float], float]) -> Callable[[float], Memory]:
    return lambda value: USUAL._replace(
        worst=Worst(0.0, 0.0, 0.0, 0.0)._replace(**{key: change(value) for key, change in changed.items()})
    )


def pressed(field: str) -> Callable[[float], Memory]:
    return lambda value: USUAL._replace(inputs=RELEASED._replace(**{field: not value}))


def contact(at: int, state: State) -> Callable[[float], Memory]:
    def made(value: float) -> Memory:
        return USUAL._replace(state=state, wrong_ns=(ago(value), None) if at == 0 else (None, ago(value)))

    return made


MADE: dict[str, Callable[[float], Memory]] = {
    "command_silent": plain(command_ns=ago),
    "malformed": plain(malformed=lambda value: Offences(int(value), NOW_NS)),
    "sequence": plain(disorder=lambda value: Offences(int(value), NOW_NS)),
    "range": worst(volts=float),
    "mismatch": worst(mismatch_mw=float),
    "stamp": worst(stamp_ms=float),
    "unasked": worst(unasked_v=float),
    "readback_silent": plain(readback_ns=ago),
    "readback": plain(readbacks_off=int),
    "estop_software": plain(estop=bool),
    "estop_a": pressed("estop_a"),
    "estop_b": pressed("estop_b"),
    "estop_discrepancy": plain(differ_ns=ago),
    "relay_a_open": contact(0, State.CLOSED),
    "relay_b_open": contact(1, State.CLOSED),
    "relay_a_welded": contact(0, State.OPEN),
    "relay_b_welded": contact(1, State.OPEN),
    "drive": plain(drive_failed=bool),
    "late": plain(late_ms=float),
}
for _at, _name in enumerate(LOOPS):
    MADE |= {
        f"{_name}_silent": loop(_at, heard_ns=ago, advanced_ns=ago),
        f"{_name}_stuck": loop(_at, advanced_ns=lambda value: NOW_NS - round(value * MS), heard_ns=lambda _: NOW_NS),
        f"{_name}_racing": loop(_at, per_s=float),
        f"{_name}_failed": loop(_at, state=lambda value: FAILED if value else RUNNING),
        f"{_name}_not_running": loop(_at, state=lambda value: 2 if value else RUNNING),
    }


def test_every_rule_is_tried() -> None:
    assert set(MADE) == {rule.name for rule in TABLE}
    assert {rule.cause for rule in TABLE} | {"latch_unreadable"} == set(CAUSES) == set(BIT)
    assert judge(RULES, USUAL, NOW_NS) == ()


def up(rule: Rule, memory: Memory) -> bool:
    return rule.name in {finding.rule.name for finding in judge(RULES, memory, NOW_NS)}


@pytest.mark.parametrize("rule", TABLE, ids=lambda rule: rule.name)
def test_below_at_and_above_the_limit(rule: Rule) -> None:
    limit = getattr(RULES.limits, rule.limit) if rule.limit else 0.0
    whole = not rule.limit or rule.limit in ("malformed_max", "readback_count") or rule.unit == ""
    above = limit + 1 if whole else limit + max(1e-6, limit * 1e-6)
    below = limit - 1 if whole else limit - max(1e-6, limit * 1e-6)
    assert up(rule, MADE[rule.name](above))
    assert up(rule, MADE[rule.name](limit)) is rule.reached
    if below >= 0:
        assert not up(rule, MADE[rule.name](below))


@pytest.mark.parametrize("rule", TABLE, ids=lambda rule: rule.name)
def test_what_a_rule_does_from_each_state(rule: Rule) -> None:
    limit = getattr(RULES.limits, rule.limit) if rule.limit else 0.0
    memory = MADE[rule.name](limit + max(1, limit))
    found = judge(RULES, memory, NOW_NS)
    bit = BIT[rule.cause]
    assert bool(causes_of(found, rule.action) & bit)
    assert all(
        not causes_of(found, other) & bit or rule.name.endswith("_failed")
        for other in Action
        if other is not rule.action
    )


def test_only_the_server_just_warns() -> None:
    assert {rule.cause for rule in TABLE if rule.action is Action.WARN} == {"server"}
    assert all(rule.action is Action.WARN for rule in TABLE if rule.cause == "server")
    latching = {rule.cause for rule in TABLE if rule.action is Action.LATCH}
    assert latching == {"estop_software", "estop_a", "estop_b", "estop_discrepancy", "relay_welded"}


def test_what_was_never_heard() -> None:
    found = {finding.rule.name: finding.value for finding in judge(RULES, Memory(T0_NS), T0_NS)}
    silent = {f"{name}_silent": math.inf for name in RULES.beats}
    assert found == {**silent, "command_silent": math.inf, "estop_a": 1.0, "estop_b": 1.0}
    required = RULES._replace(readback_required=True, beats=("server", "output"))
    found = {finding.rule.name: finding.value for finding in judge(required, Memory(T0_NS, inputs=Inputs()), T0_NS)}
    assert found == dict.fromkeys(("server_silent", "output_silent", "command_silent", "readback_silent"), math.inf)


def test_a_number_that_is_none_is_up() -> None:
    found = judge(RULES, USUAL._replace(worst=Worst(math.nan, 0.0, 0.0, 0.0)), NOW_NS)
    assert [finding.rule.name for finding in found] == ["range"]


def test_limits_have_bounds_and_every_one_is_used() -> None:
    assert set(BOUNDS) == set(Limits._fields)
    assert {rule.limit for rule in TABLE if rule.limit} == set(Limits._fields) - {"readback_max_percent", "close_max_v"}
    for name, value in Limits()._asdict().items():
        low, high = BOUNDS[name]
        assert not refusal(name, value) and not refusal(name, low) and not refusal(name, high)
        assert "out of range" in refusal(name, math.nextafter(low, -math.inf))
        assert "out of range" in refusal(name, math.nextafter(high, math.inf))
        assert "out of range" in refusal(name, math.nan)
    assert refusal("x", 1.0).startswith("x: no such limit; there are fast_timeout_ms, ")
    assert Limits().range_max_v == BOUNDS["range_max_v"][1] == 10.0


def test_contacts_are_wrong_by_what_was_ordered() -> None:
    bench = Bench(inputs=Inputs(True, True, Contact.OPEN, Contact.OPEN)).closed()
    bench.inputs = Inputs(True, True, Contact.CLOSED, Contact.CLOSED)
    for _ in range(20):
        bench.tick()
    assert bench.state is State.CLOSED
    bench.inputs = bench.inputs._replace(contact_b=Contact.UNKNOWN)
    for _ in range(12):
        bench.tick()
    assert bench.state is State.TRIPPED and "relay_open" in bench.causes
