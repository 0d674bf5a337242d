"""The watchdog with every operator flipped and every constant changed, one at a time.

Facts are calls with the results that they must have; for what only shows over several steps, scenarios take their
place. A mutant that gives all facts and passes all scenarios is either equivalent, and listed with the reason, or a
fact is missing. What touches clock, sockets and files, and that no function is left out: test_watchdog_edge_mutants.py.
"""

from __future__ import annotations

import itertools
import math
import os
import struct
import tempfile
import zlib
from collections.abc import Callable
from functools import partial
from types import FunctionType
from typing import Any

import pytest
import test_watchdog_core as scenes
from support.guarded import RELEASED, RULES, T0_NS, TICK_NS, Bench
from support.mutation import survivors

from dcon.watchdog import codec, core, latch, limits, memory, rules
from dcon.watchdog.codec import Beat, Command, Malformed, Readback, Word
from dcon.watchdog.memory import MS, Contact, Driven, Inputs, Loop, Memory, Offences, State, Worst

Fact = tuple[Callable[..., Any], tuple[Any, ...], Any]
S = 1000 * MS
NOW_NS = 50 * S


def of(function: Callable[..., Any], *pairs: tuple[Any, Any]) -> list[Fact]:
    """Facts about a function: (arguments, result); a single argument may stand for itself."""
    return [
        (function, args if isinstance(args, tuple) and not hasattr(args, "_fields") else (args,), want)
        for args, want in pairs
    ]


# --- the codec ---------------------------------------------------------------------------------------------------


def sealed(body: bytes) -> bytes:
    return body + struct.pack(">I", zlib.crc32(body))


def command(flags: int = 0, mw: float = 12.5, volts: float = 1.0) -> bytes:
    return struct.pack(">4sIqddI", b"DCN1", 7, 5 * S, mw, volts, flags)


def beat(name: bytes = b"udp", state: int = 1) -> bytes:
    return struct.pack(">4s8sIqB3x", b"DCB1", name, 9, 8, state)


def readback(volts: float = 2.0) -> bytes:
    return struct.pack(">4sIqd", b"DCR1", 3, 8, volts)


def word(verb: int, who: bytes = b"op") -> bytes:
    return struct.pack(">4sB3x32s", b"DCO1", verb, who)


SENT = Command(7, 5 * S, 12.5, 1.0, False, 250.0)
CODEC = [
    *of(
        codec._command,
        ((command(), 5 * S + 250 * MS), SENT),
        ((command(1), 5 * S + 250 * MS), SENT._replace(relays=True)),
        ((command(2), 5 * S + 250 * MS), SENT),
        ((command(3), 5 * S - 3 * MS), SENT._replace(relays=True, age_ms=-3.0)),
        *(((command(mw=bad), 0), None) for bad in (math.nan, math.inf)),
        *(((command(volts=bad), 0), None) for bad in (math.nan, -math.inf)),
    ),
    *of(codec._beat, *(((beat(state=state), 0), Beat(1, 9, state)) for state in range(4))),
    *of(codec._beat, ((beat(b"output"), 0), Beat(7, 9, 1)), ((beat(b"x"), 0), None), ((beat(state=4), 0), None)),
    *of(codec._readback, ((readback(), 0), Readback(3, 2.0)), ((readback(math.nan), 0), None)),
    *of(codec._word, *(((word(verb), 0), Word(name, "op")) for verb, name in codec.VERBS.items())),
    *of(codec._word, ((word(0), 0), None), ((word(4), 0), None), ((word(1, b"\xff"), 0), Word("estop", "\ufffd"))),
    *of(codec._sealed, (b"abc", sealed(b"abc"))),
    *of(
        codec.decode,
        ((sealed(command()), 5 * S + 250 * MS), SENT),
        ((sealed(beat()), 0), Beat(1, 9, 1)),
        ((sealed(readback()), 0), Readback(3, 2.0)),
        ((sealed(word(3)), 0), Word("reset", "op")),
        ((sealed(beat(state=9)), 0), Malformed("value")),
        ((sealed(beat())[:-1], 0), Malformed("size")),
        ((sealed(beat()) + b"x", 0), Malformed("size")),
        ((beat() + b"1234", 0), Malformed("crc")),
        ((b"DCB", 0), Malformed("magic")),
        ((b"DCW1" + bytes(24), 0), Malformed("magic")),
    ),
    *of(
        codec.encode_command,
        ((7, 5 * S, 12.5, 1.0, 3), sealed(command(3))),
        ((2**32 + 7, 5 * S, 12.5, 1.0, 3), sealed(command(3))),
    ),
    *of(
        codec.encode_status,
        *(
            (
                (counter, 8, 3, 7, 2, True, 5),
                sealed(struct.pack(">4sIqBBBBI", b"DCW1", 9, 8, 3, 7, 2, 1, 5) + b"\xff" * 16),
            )
            for counter in (9, 2**32 + 9)
        ),
        (
            (9, 8, 3, 7, 2, True, 5, range(8)),
            sealed(struct.pack(">4sIqBBBBI8H", b"DCW1", 9, 8, 3, 7, 2, 1, 5, *range(8))),
        ),
    ),
]

# --- memory ------------------------------------------------------------------------------------------------------

LOOP = Loop(5, 1, 1, 1, NOW_NS - S // 2, 30, 40.0)
FIRST = Memory(T0_NS, sequence=7)
COMMAND = Command(10, NOW_NS, 12.5, 1.0, True, 2.0)
HAVE = FIRST._replace(command=COMMAND, command_ns=NOW_NS - S, worst=Worst(9.0, 9.0, 9.0, 9.0))
SENT_ONE = FIRST._replace(sent=((6, 1.0), (7, 2.0)), readbacks_off=1)


HEARD_MS = (250, None, 65_533, 65_534, 65_535, 70_000, 0, None)
HEARD = FIRST._replace(loops=tuple(None if ms is None else LOOP._replace(heard_ns=NOW_NS - ms * MS) for ms in HEARD_MS))


def told_command(before: Memory, now_ns: int = NOW_NS, **changed: Any) -> tuple[Any, ...]:
    after = memory.commanded(before, COMMAND._replace(**changed), now_ns)
    return after.worst, after.disorder.times, after.low_seen, after.command_ns


def read(volts: float, sequence: int = 7) -> tuple[Any, ...]:
    after = memory.answered(RULES, SENT_ONE, Readback(sequence, volts), NOW_NS)
    return after.readbacks_off, after.readback_ns


def look(inputs: Inputs, **changed: Any) -> tuple[Any, ...]:
    after = memory.looked(FIRST._replace(**changed), inputs, NOW_NS)
    return after.differ_ns, after.wrong_ns


def take(*news: Any) -> Memory:
    return memory.absorbed(
        RULES, FIRST._replace(drive_failed=False, words=(Word("reset", "x"),)), news, T0_NS + 30 * MS
    )


USUAL_WORST = Worst(1.0, 0.0, 2.0, 0.0)
MEMORY = [
    *of(
        memory.begun,
        ((5, 9, 0, False), Memory(5, 9)),
        ((5, 9, 3, False), Memory(5, 9, State.TRIPPED, 3)),
        ((5, 9, 3, True), Memory(5, 9, State.TRIPPED, 3, estop=True)),
    ),
    *of(memory.beaten, ((None, Beat(0, 8, 2), 9), Loop(8, 9, 9, 2, 9, 0, 0.0))),
    *of(
        memory.beaten,
        ((LOOP, Beat(0, 8, 2), NOW_NS), Loop(8, NOW_NS, NOW_NS, 2, NOW_NS - S // 2, 33, 40.0)),
        ((LOOP, Beat(0, 5, 2), NOW_NS), Loop(5, NOW_NS, 1, 2, NOW_NS - S // 2, 30, 40.0)),
        ((LOOP, Beat(0, 4, 2), NOW_NS), Loop(4, NOW_NS, NOW_NS, 2, NOW_NS - S // 2, 29 + 2**32, 40.0)),
        ((LOOP._replace(mark_ns=NOW_NS - S), Beat(0, 8, 2), NOW_NS), Loop(8, NOW_NS, NOW_NS, 2, NOW_NS, 0, 33.0)),
        ((LOOP._replace(mark_ns=NOW_NS - 2 * S), Beat(0, 8, 2), NOW_NS), Loop(8, NOW_NS, NOW_NS, 2, NOW_NS, 0, 16.5)),
        (
            (LOOP._replace(mark_ns=NOW_NS - S + 1), Beat(0, 8, 2), NOW_NS),
            Loop(8, NOW_NS, NOW_NS, 2, NOW_NS - S + 1, 33, 40.0),
        ),
    ),
    *of(
        memory.offended,
        ((Offences(3, NOW_NS - S), NOW_NS), Offences(4, NOW_NS)),
        ((Offences(3, NOW_NS - S - 1), NOW_NS), Offences(1, NOW_NS)),
    ),
    *of(
        memory.worst_of,
        (Command(1, 2, 12.5, 1.0, True, -3.0), Worst(1.0, 0.0, 3.0, 0.0)),
        (Command(1, 2, 0.0, -2.0, False, 3.0), Worst(2.0, 25.0, 3.0, 2.0)),
        (Command(1, 2, 30.0, 2.0, True, 3.0), Worst(2.0, 5.0, 3.0, 0.0)),
    ),
    *of(
        told_command,
        (FIRST, (USUAL_WORST, 0, False, NOW_NS)),
        (HAVE._replace(command=COMMAND._replace(sequence=9)), (USUAL_WORST, 0, False, NOW_NS)),
    ),
    *(
        (partial(told_command, HAVE, sequence=number), (), (USUAL_WORST, bad, False, NOW_NS))
        for number, bad in (*((10, 1), (9, 1), (11, 0), (12, 0), (9 + 2**31, 0), (10 + 2**31, 1), (11 + 2**31, 1)),)
    ),
    (
        partial(told_command, HAVE, sequence=11, relays=False),
        (),
        (USUAL_WORST._replace(unasked_v=1.0), 0, True, NOW_NS),
    ),
    (partial(told_command, HAVE._replace(low_seen=True), sequence=11), (), (USUAL_WORST, 0, True, NOW_NS)),
    (
        partial(told_command, HAVE._replace(command_ns=NOW_NS), sequence=11),
        (),
        (Worst(9.0, 9.0, 9.0, 9.0), 0, False, NOW_NS),
    ),
    *of(
        read,
        *((volts, (0, NOW_NS)) for volts in (2.0, 1.8125, 2.1875)),
        *((volts, (2, NOW_NS)) for volts in (1.79, 2.21, -2.0)),
        ((1.0, 6), (0, NOW_NS)),
        ((2.0, 5), (2, NOW_NS)),
    ),
    (
        memory.answered,
        (RULES, SENT_ONE._replace(sent=((7, 0.0),)), Readback(7, 0.2), 3),
        SENT_ONE._replace(sent=((7, 0.0),), readback_ns=3, readbacks_off=0),
    ),
    *of(
        look,
        (Inputs(), (None, (None, None))),
        *((Inputs(a, b), (NOW_NS if a != b else None, (None, None))) for a in (True, False) for b in (True, False)),
        *((Inputs(a, b), (None, (None, None))) for a, b in ((None, True), (None, False), (True, None), (False, None))),
        (Inputs(None, None, Contact.OPEN, Contact.CLOSED), (None, (None, NOW_NS))),
        (Inputs(None, None, Contact.UNKNOWN, Contact.OPEN), (None, (NOW_NS, None))),
    ),
    (partial(look, state=State.CLOSED), (Inputs(None, None, Contact.OPEN, Contact.CLOSED),), (None, (NOW_NS, None))),
    (partial(look, state=State.TRIPPED), (Inputs(None, None, Contact.OPEN, Contact.CLOSED),), (None, (None, NOW_NS))),
    (partial(look, differ_ns=3, wrong_ns=(4, 5)), (RELEASED,), (None, (None, None))),
    (
        partial(look, differ_ns=3, wrong_ns=(4, 5)),
        (Inputs(True, False, Contact.CLOSED, Contact.UNKNOWN),),
        (3, (4, 5)),
    ),
    *of(
        memory._since,
        *(((wrong, before, 9), want) for wrong, before, want in ((True, 3, 3), (True, None, 9), (False, 3, None))),
    ),
    *of(
        memory.spoken,
        *(
            ((FIRST._replace(estop=was), Word(verb, "x")), FIRST._replace(estop=now, words=(Word(verb, "x"),)))
            for verb, was, now in (
                *(("estop", False, True), ("estop", True, True), ("estop_release", True, False)),
                *(("reset", True, True), ("reset", False, False)),
            )
        ),
    ),
    *of(
        memory.absorbed,
        ((RULES, FIRST, (), T0_NS + 30 * MS), FIRST._replace(now_ns=T0_NS + 30 * MS, late_ms=20.0)),
    ),
    (take, (Driven(False),), FIRST._replace(now_ns=T0_NS + 30 * MS, late_ms=20.0, drive_failed=True)),
    (take, (Driven(False), Driven(True)), FIRST._replace(now_ns=T0_NS + 30 * MS, late_ms=20.0)),
    (
        take,
        (Beat(1, 5, 1),),
        FIRST._replace(
            now_ns=T0_NS + 30 * MS,
            late_ms=20.0,
            loops=(None, Loop(5, *(T0_NS + 30 * MS,) * 2, 1, T0_NS + 30 * MS), *(None,) * 6),
        ),
    ),
    *of(memory.ages_ms, ((HEARD, NOW_NS), (250, 65_535, 65_533, 65_534, 65_534, 65_534, 0, 65_535))),
    *of(
        memory.forwarded,
        ((FIRST, 3.0, 9), FIRST._replace(sequence=8, sent=((7, 3.0),), sent_ns=9)),
        ((FIRST._replace(sequence=2**32 - 1), 3.0, 9), FIRST._replace(sequence=0, sent=((2**32 - 1, 3.0),), sent_ns=9)),
        (
            (FIRST._replace(sent=tuple((n, 0.0) for n in range(64))), 3.0, 9),
            FIRST._replace(sequence=8, sent=(*((n, 0.0) for n in range(1, 64)), (7, 3.0)), sent_ns=9),
        ),
    ),
]

# --- rules -------------------------------------------------------------------------------------------------------

AT = 1
FULL = FIRST._replace(
    state=State.CLOSED,
    loops=(None, Loop(5, NOW_NS - 3 * S, NOW_NS - 7 * S, 1, NOW_NS, 30, 40.0), *(None,) * 6),
    command=COMMAND,
    command_ns=NOW_NS - 2 * S,
    worst=Worst(1.0, 2.0, 3.0, 4.0),
    malformed=Offences(5, NOW_NS - S),
    disorder=Offences(6, NOW_NS - S - 1),
    readback_ns=NOW_NS - 4 * S,
    readbacks_off=7,
    inputs=Inputs(True, False),
    differ_ns=NOW_NS - 5 * S,
    wrong_ns=(NOW_NS - 6 * S, None),
    late_ms=8.0,
)


def given(function: Callable[..., Any], want: float | None, at: int = AT, **changed: Any) -> Fact:
    """A fact about the value of a rule."""
    return function, (changed.pop("rules", RULES), FULL._replace(**changed), at, NOW_NS), want


def with_loop(**changed: Any) -> dict[str, Any]:
    loop = FULL.loops[AT]
    assert loop is not None
    return {"loops": (None, loop._replace(**changed), *(None,) * 6)}


NO_BEATS = RULES._replace(beats=())
VALUES = [
    given(rules.silent_ms, 3000.0),
    given(rules.silent_ms, math.inf, 0),
    given(rules.silent_ms, None, 0, rules=NO_BEATS),
    given(rules.stuck_ms, 4000.0),
    given(rules.racing_hz, 40.0),
    given(rules.racing_hz, 50.0, **with_loop(moved=50)),
    *(given(rules.failed, want, **with_loop(state=state)) for state, want in enumerate((0.0, 0.0, 0.0, 1.0))),
    *(given(rules.not_running, want, **with_loop(state=state)) for state, want in enumerate((1.0, 0.0, 1.0, 1.0))),
    *(given(function, None, 0) for function in (rules.stuck_ms, rules.racing_hz, rules.failed, rules.not_running)),
    given(rules.command_silent_ms, 2000.0),
    given(rules.command_silent_ms, math.inf, command=None),
    *of(rules._recent, *(((Offences(3, NOW_NS - S), NOW_NS), 3.0), ((Offences(3, NOW_NS - S - 1), NOW_NS), 0.0))),
    given(rules.malformed, 5.0),
    given(rules.out_of_order, 0.0),
    given(rules.out_of_order, 6.0, disorder=Offences(6, NOW_NS)),
    given(rules.range_v, 1.0),
    given(rules.mismatch_mw, 2.0),
    given(rules.stamp_ms, 3.0),
    given(rules.unasked_v, 4.0),
    given(rules.readback_silent_ms, 4000.0),
    given(rules.readback_silent_ms, None, readback_ns=None),
    given(rules.readback_silent_ms, math.inf, readback_ns=None, rules=RULES._replace(readback_required=True)),
    given(rules.readbacks_off, 7.0),
    *(given(rules.estop_pressed, float(pressed), estop=pressed) for pressed in (True, False)),
    given(rules.line_pressed, 0.0, 0),
    given(rules.line_pressed, 1.0, 1),
    *(given(rules.line_pressed, None, at, inputs=Inputs()) for at in (0, 1)),
    *(given(rules.line_pressed, 1.0, at, inputs=None) for at in (0, 1)),
    given(rules.discrepancy_ms, 5000.0),
    given(rules.discrepancy_ms, 0.0, differ_ns=None),
    *(given(rules.open_ms, want, at) for at, want in ((0, 6000.0), (1, 0.0))),
    *(given(rules.open_ms, 0.0, 0, state=state) for state in (State.OPEN, State.TRIPPED)),
    *(given(rules.welded_ms, want, 0, state=state) for state, want in zip(State, (6000.0, 0.0, 6000.0), strict=True)),
    given(rules.welded_ms, 0.0, 1, state=State.OPEN),
    *(given(rules.drive_failed, float(bad), drive_failed=bad) for bad in (True, False)),
    given(rules.late_ms, 8.0),
]
BY_NAME = {rule.name: rule for rule in rules.RULES}
GOOD = Bench().closed().memory


def found(now_ns: int = GOOD.now_ns, **changed: Any) -> list[tuple[str, float, float]]:
    return [(f.rule.name, f.value, f.limit) for f in rules.judge(RULES, GOOD._replace(**changed), now_ns)]


def finding(name: str) -> rules.Finding:
    return rules.Finding(BY_NAME[name], 1.0, 0.0)


JUDGING = [
    (found, (), []),
    (partial(found, late_ms=50.0), (), []),
    (partial(found, late_ms=50.5), (), [("late", 50.5, 50.0)]),
    (partial(found, late_ms=math.nan), (), [("late", math.nan, 50.0)]),
    (partial(found, readbacks_off=2), (), []),
    *((partial(found, readbacks_off=off), (), [("readback", off, 3.0)]) for off in (3, 4)),
    (partial(found, estop=True, drive_failed=True), (), [("estop_software", 1.0, 0.0), ("drive", 1.0, 0.0)]),
    *of(rules.limit_of, ((RULES, BY_NAME["late"]), 50.0), ((RULES, BY_NAME["drive"]), 0.0)),
    *of(
        rules.causes_of,
        (((finding("late"), finding("estop_a")), rules.Action.TRIP), rules.BIT["late"]),
        (
            ((finding("late"), finding("estop_a")), rules.Action.TRIP, rules.Action.LATCH),
            rules.BIT["late"] | rules.BIT["estop_a"],
        ),
        (((finding("udp_stuck"), finding("udp_silent"), finding("drive")), rules.Action.TRIP), 2 | rules.BIT["drive"]),
        (((finding("late"),), rules.Action.WARN), 0),
        (((), rules.Action.TRIP), 0),
    ),
    *of(rules.names_of, (0, ()), (1, ("control",)), (rules.BIT["late"] | 2, ("udp", "late"))),
]

# --- the latch ---------------------------------------------------------------------------------------------------


def left_there(text: bytes | None) -> int:
    """What is found where a file has been left."""
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "latch")
        if text is not None:
            with open(path, "wb") as file:
                file.write(text)
        return latch.found(path)


def kept(*causes: int) -> tuple[str, list[tuple[str, bytes, int]]]:
    """What the last of some writings says, and the files after it: name, content, mode."""
    with tempfile.TemporaryDirectory() as folder:
        said = [latch.keep(os.path.join(folder, "latch"), cause) for cause in causes][-1]
        files = []
        for entry in os.scandir(folder):
            with open(entry.path, "rb") as file:
                files.append((entry.name, file.read(), entry.stat().st_mode & 0o777))
    return said, files


def kept_on_a_full_disk(causes: int) -> tuple[str, list[str], int]:
    """What is said, which names are there, and what is found."""
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "latch")
        os.symlink("/dev/full", path + ".new")
        said = latch.keep(path, causes).replace(folder, "")
        return said, os.listdir(folder), latch.found(path)


LATCHED = [
    *of(latch.text_of, (3, b'{"causes": ["control", "udp"]}\n'), (rules.BIT["late"], b'{"causes": ["late"]}\n')),
    *of(latch.causes_in, *((text, latch.UNREADABLE) for text in (b"", b"{}", b'{"causes": []}', b'{"causes": ["x"]}'))),
    *of(latch.causes_in, (b'{"causes": ["udp", "late", "udp"]}', 2 | rules.BIT["late"])),
    *of(left_there, (None, 0), (b"", latch.UNREADABLE), (latch.text_of(3), 3)),
    (kept, (3,), ("", [("latch", latch.text_of(3), 0o600)])),
    (kept, (3, 2), ("", [("latch", latch.text_of(2), 0o600)])),
    (kept, (3, 0), ("", [])),
    (kept, (0,), ("", [])),
    (kept_on_a_full_disk, (3,), ("/latch: No space left on device", ["latch"], latch.UNREADABLE)),
]

# --- the limits and the limiter ----------------------------------------------------------------------------------

LIMITS = [
    *of(
        limits.refusal,
        (("range_max_v", 0.0), ""),
        (("range_max_v", 10.0), ""),
        (("range_max_v", -0.1), "range_max_v: -0.1 is out of range; it must be 0 to 10"),
        (("range_max_v", 10.1), "range_max_v: 10.1 is out of range; it must be 0 to 10"),
        (("x", 1.0), f"x: no such limit; there are {', '.join(limits.BOUNDS)}"),
    ),
    *of(core.safe_volts, *((v, v) for v in (10.0, -10.0, 0.0, 3.5))),
    *of(core.safe_volts, (10.5, 10.0), (-10.5, -10.0), (math.nan, 0.0), (math.inf, 0.0), (-math.inf, 0.0)),
    *of(core.asks, (FIRST, False), (HAVE, True), (HAVE._replace(command=COMMAND._replace(relays=False)), False)),
    *of(
        core.estop_bits,
        (FIRST, 1),
        (FIRST._replace(estop=True), 0),
        (FIRST._replace(inputs=Inputs()), 7),
        (FIRST._replace(inputs=Inputs(True, False)), 3),
        (FIRST._replace(inputs=Inputs(False, True)), 5),
        (FIRST._replace(inputs=Inputs(False, None), estop=True), 4),
    ),
]
READY = HAVE._replace(low_seen=True, worst=Worst(0.1, 0.0, 0.0, 0.0))
CLOSING = [
    *of(
        core.may_close,
        ((RULES.limits, READY, 0), True),
        ((RULES.limits, READY, 1), False),
        ((RULES.limits, READY._replace(low_seen=False), 0), False),
        ((RULES.limits, READY._replace(worst=Worst(0.11, 0.0, 0.0, 0.0)), 0), False),
        ((RULES.limits, READY._replace(worst=Worst(0.05, 0.0, 0.0, 0.0)), 0), True),
        ((RULES.limits, READY._replace(command=None), 0), False),
    ),
    *of(
        core.second_relay,
        ((RULES.limits, READY, ()), True),
        ((RULES.limits, READY._replace(low_seen=False), ()), False),
        ((RULES.limits, READY._replace(low_seen=False, relay_b=True), ()), True),
        ((RULES.limits, READY._replace(relay_b=True, command=None), ()), False),
        ((RULES.limits, READY._replace(relay_b=True, latched=2), ()), False),
        ((RULES.limits, READY._replace(relay_b=True), (finding("late"),)), False),
        ((RULES.limits, READY._replace(relay_b=True), (finding("estop_a"),)), False),
        ((RULES.limits, READY._replace(relay_b=True), (finding("gps_not_running"),)), True),
        ((RULES.limits, READY, (finding("gps_not_running"),)), False),
        ((RULES.limits, READY, (finding("server_silent"),)), True),
    ),
    *of(
        core.told,
        ((FIRST, (1,), 9), (FIRST._replace(shown=(1,), told_ns=9), True)),
        (
            (FIRST._replace(shown=(1,), told_ns=9), (1,), 9 + 20 * MS - 1),
            (FIRST._replace(shown=(1,), told_ns=9), False),
        ),
        (
            (FIRST._replace(shown=(1,), told_ns=9), (1,), 9 + 20 * MS),
            (FIRST._replace(shown=(1,), told_ns=9 + 20 * MS), True),
        ),
        ((FIRST._replace(shown=(1,), told_ns=9), (2,), 10), (FIRST._replace(shown=(2,), told_ns=10), True)),
    ),
]

# --- what shows over several steps -------------------------------------------------------------------------------


def every_trigger() -> None:
    for state, trigger in itertools.product(State, core.Trigger):
        scenes.test_every_trigger_in_every_state(state, trigger)


def near_zero() -> None:
    for volts, closes in ((0.1, True), (0.1001, False)):
        scenes.test_it_closes_only_near_zero(volts, closes)


def latching() -> None:
    for name in ("line a", "a welded contact"):
        scenes.test_what_latches_does_so_with_open_relays_too(name)
    for name in ("a bad datagram", "an operator's word", "control silent"):
        scenes.test_a_fault_opens_the_relays_and_latches(name)


def trace() -> None:
    """Numbers that leave: the period of 0 V is 20 ms, kept through a trip, whose own 0 V is at once."""
    bench = scenes.opened()
    sent = [bench.tick(after_ns=ns).forward for ns in (20 * MS - 1, 1, 20 * MS, MS)]
    assert [forward is not None for forward in sent] == [False, True, True, False]
    bench.relays = True
    assert bench.tick(after_ns=MS).forward == core.Forward(3, bench.now_ns, 0.0, 0.0, 3)
    bench.volts = 2.0
    assert bench.tick(after_ns=MS).forward == core.Forward(4, bench.now_ns, 2.0, 25.0, 3)
    tripped = bench.tick(Malformed("crc"), after_ns=MS)
    assert tripped.forward == core.Forward(5, None, 0.0, 0.0, 0)
    assert bench.tick(after_ns=MS).forward is None
    assert not tripped.healthy and tripped.estop == 7 and tripped.causes == rules.BIT["malformed"]


def nothing_yet() -> None:
    """At its first step nothing is healthy, and 0 V leaves."""
    bench = Bench()
    decision = bench.only(RELEASED, after_ns=TICK_NS)
    assert decision.forward == core.Forward(0, None, 0.0, 0.0, 0)
    assert not decision.healthy and decision.tell and decision.events == () and decision.state is State.OPEN


def one_relay() -> None:
    """Both relays must be closed for a command to pass."""
    bench = Bench().closed(5.0)
    bench.memory = bench.memory._replace(relay_b=False, low_seen=False)
    decision = bench.tick()
    assert (decision.relay_a, decision.relay_b) == (True, False)
    assert decision.forward is not None and (decision.forward.volts, decision.forward.flags) == (0.0, 0)


SCENES: list[Callable[[], None]] = [
    trace,
    nothing_yet,
    one_relay,
    every_trigger,
    near_zero,
    latching,
    scenes.test_a_request_that_is_refused_is_spent,
    scenes.test_a_loop_that_starts_or_ends_keeps_the_relays_open_and_does_not_trip,
    scenes.test_it_opens_when_the_request_falls_and_closes_anew,
    scenes.test_the_discrepancy_of_the_lines_latches_after_50_ms,
    scenes.test_a_reset_waits_until_the_causes_are_gone_and_never_closes,
    scenes.test_a_low_request_while_tripped_does_not_count_for_after_the_reset,
    scenes.test_a_reset_where_nothing_is_tripped_is_refused,
    scenes.test_causes_that_come_after_the_trip_are_kept,
    scenes.test_closed_relays_send_each_command_once,
    scenes.test_it_does_not_close_on_a_request_that_was_there_at_the_start,
    scenes.test_a_server_that_was_heard_and_is_silent_is_told_once,
    scenes.test_a_status_is_told_each_20_ms_and_when_something_changes,
]
STEPS: tuple[Any, ...] = (core.trigger_of, core.moved, core.events_of, core.forward_of, core.step)

# --- the trial ---------------------------------------------------------------------------------------------------

FACTS = [*CODEC, *MEMORY, *VALUES, *JUDGING, *LATCHED, *LIMITS, *CLOSING]
ABOUT: dict[Callable[..., Any], FunctionType] = {
    told_command: memory.commanded,
    read: memory.answered,
    look: memory.looked,
    take: memory.absorbed,
    found: rules.judge,
    left_there: latch.found,
    kept: latch.keep,
    kept_on_a_full_disk: latch.keep,
}  # type: ignore[dict-item]
"""What a fact is about, where that is not the function that it calls."""
FUNCTIONS: dict[FunctionType, list[Fact]] = {function: [] for function in STEPS}
for _fact in FACTS:
    _called = _fact[0].func if isinstance(_fact[0], partial) else _fact[0]
    FUNCTIONS.setdefault(ABOUT.get(_called, _called), []).append(_fact)  # type: ignore[arg-type]

EQUIVALENT = {
    "looked line 7: True": "there are two contacts and two times: strict or not",
}
"""Mutants that do what the original does, and why."""


def same(got: object, want: object) -> bool:
    """Equal, with NaN equal to itself."""
    if isinstance(got, float) and isinstance(want, float):
        return got == want or (math.isnan(got) and math.isnan(want))
    if isinstance(got, tuple | list) and isinstance(want, tuple | list):
        return len(got) == len(want) and all(map(same, got, want))
    return got == want and isinstance(got, bool) == isinstance(want, bool)


def holds(fact: Fact) -> bool:
    try:
        return same(fact[0](*fact[1]), fact[2])
    except Exception:
        return False


def passes(scenario: Callable[[], None]) -> bool:
    try:
        scenario()
    except (Exception, SystemExit):
        return False
    return True


def test_the_facts_hold() -> None:
    for function, arguments, want in FACTS:
        got = function(*arguments)
        assert same(got, want), (function, arguments, got, want)
    for scene in SCENES:
        scene()


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda function: f"{function.__module__}.{function.__name__}")
def test_no_mutant_survives(function: FunctionType) -> None:
    facts, scenarios = FUNCTIONS[function], SCENES if function in STEPS else []
    left = survivors(function, lambda: all(map(holds, facts)) and all(map(passes, scenarios)))
    assert [what for what in left if what not in EQUIVALENT] == []
    assert {what for what in EQUIVALENT if what.startswith(f"{function.__name__} ")} <= set(left)
