"""When the relays close, open, trip, and stay tripped."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.guarded import RELEASED, RULES, TICK_NS, Bench, with_limits

from dcon.watchdog.codec import CLOSED, LOOPS, RELAYS, Beat, Malformed, Readback, Word
from dcon.watchdog.core import TRANSITIONS, Decision, Trigger, safe_volts, step
from dcon.watchdog.limits import Limits, Rules
from dcon.watchdog.memory import MS, Contact, Driven, Inputs, Item, Memory, State
from dcon.watchdog.rules import BIT, CAUSES, Action, names_of
from dcon.watchdog.rules import RULES as TABLE

# --- all states x all triggers -----------------------------------------------------------------------------------


def opened() -> Bench:
    bench = Bench()
    bench.tick()
    return bench


def tripped() -> Bench:
    bench = Bench().closed()
    bench.tick(Malformed("crc"))
    bench.relays = False
    bench.tick(after_ns=1_100 * MS)  # what is held against the sender for a second is over
    bench.tick()
    return bench


BROUGHT: dict[State, Callable[[], Bench]] = {
    State.OPEN: opened,
    State.CLOSED: lambda: Bench().closed(),
    State.TRIPPED: tripped,
}


def ask(bench: Bench, relays: bool) -> None:
    bench.relays = relays
    bench.tick()


MOVES: dict[Trigger, Callable[[Bench], Any]] = {
    Trigger.LATCH: lambda bench: bench.tick(Word("estop", "op")),
    Trigger.TRIP: lambda bench: bench.tick(Malformed("crc")),
    Trigger.RESET: lambda bench: bench.tick(Word("reset", "op")),
    Trigger.OPEN: lambda bench: ask(bench, False),
    Trigger.CLOSE: lambda bench: ask(bench, True),
}


@pytest.mark.parametrize("state", State)
@pytest.mark.parametrize("trigger", Trigger)
def test_every_trigger_in_every_state(state: State, trigger: Trigger) -> None:
    bench = BROUGHT[state]()
    assert bench.state is state
    MOVES[trigger](bench)
    after = TRANSITIONS.get((state, trigger), state)
    assert bench.state is after
    decision = bench.decision
    assert decision is not None
    assert (decision.relay_a, decision.relay_b) == ((after is State.CLOSED,) * 2)


def test_the_table_has_one_way_to_closed_and_one_out_of_tripped() -> None:
    assert [key for key, after in TRANSITIONS.items() if after is State.CLOSED] == [(State.OPEN, Trigger.CLOSE)]
    assert {key: after for key, after in TRANSITIONS.items() if key[0] is State.TRIPPED} == {
        (State.TRIPPED, Trigger.RESET): State.OPEN
    }


# --- closing -----------------------------------------------------------------------------------------------------


def test_it_closes_when_asked_near_zero_and_passes_the_command_on() -> None:
    bench = Bench().closed(volts=5.0)
    assert bench.named == ["close"]
    assert bench.left == [(0, 0.0), (RELAYS | CLOSED, 0.0), (RELAYS | CLOSED, 5.0)]
    decision = bench.decision
    assert decision is not None and decision.forward is not None
    assert decision.forward.mw == 62.5
    assert (decision.healthy, decision.causes, decision.estop) == (True, 0, 7)


@pytest.mark.parametrize(("volts", "closes"), [(0.1, True), (-0.1, True), (0.1001, False), (-0.1001, False)])
def test_it_closes_only_near_zero(volts: float, closes: bool) -> None:
    bench = opened()
    bench.relays, bench.volts = True, volts
    bench.tick()
    assert (bench.state is State.CLOSED) is closes


def test_it_does_not_close_on_a_request_that_was_there_at_the_start() -> None:
    bench = Bench()
    bench.relays = True
    for _ in range(50):
        bench.tick()
    assert bench.state is State.OPEN
    ask(bench, False)
    ask(bench, True)
    assert bench.state is State.CLOSED


def test_a_request_that_is_refused_is_spent() -> None:
    bench = opened()
    for _ in range(12):
        bench.tick(leave_out=("udp",))
    bench.relays = True
    bench.tick(leave_out=("udp",))
    assert bench.named == ["refused"] and bench.causes == ("udp",)
    assert [finding.rule.name for finding in bench.events[0].found] == ["udp_silent"]
    for _ in range(50):
        bench.tick()
    assert bench.state is State.OPEN and bench.named == ["refused"]
    ask(bench, False)
    ask(bench, True)
    assert bench.state is State.CLOSED


def test_a_loop_that_starts_or_ends_keeps_the_relays_open_and_does_not_trip() -> None:
    for state in (0, 2):
        bench = opened()
        bench.relays = True
        gps = LOOPS.index("gps")
        bench.tick(Beat(gps, bench.counter + 2, state))
        assert bench.state is State.OPEN and not bench.decision.healthy  # type: ignore[union-attr]
        bench = Bench().closed()
        bench.tick(Beat(gps, bench.counter + 2, state))
        assert bench.state is State.CLOSED and not bench.decision.healthy  # type: ignore[union-attr]
        assert bench.causes == ("gps",)


def test_it_opens_when_the_request_falls_and_closes_anew() -> None:
    bench = Bench().closed(5.0)
    bench.volts = 0.0
    bench.tick()
    ask(bench, False)
    assert bench.state is State.OPEN and bench.left[-1] == (0, 0.0)
    ask(bench, True)
    assert bench.named == ["close", "open", "close"]


# --- tripping ----------------------------------------------------------------------------------------------------


def commanding(**changed: Any) -> Callable[[Bench], None]:
    return lambda bench: void(bench.tick(bench.command(**changed), leave_out=("command",)))


def void(_: object) -> None:
    return


def silence(*names: str, ticks: int) -> Callable[[Bench], None]:
    def made(bench: Bench) -> None:
        for _ in range(ticks):
            bench.tick(leave_out=names)

    return made


def with_inputs(ticks: int, **changed: Any) -> Callable[[Bench], None]:
    def made(bench: Bench) -> None:
        bench.inputs = bench.inputs._replace(**changed)
        for _ in range(ticks):
            bench.tick()

    return made


def reading_back(*volts: float) -> Callable[[Bench], None]:
    def made(bench: Bench) -> None:
        for value in volts:
            bench.tick(Readback(bench.memory.sent[-1][0], value))

    return made


def standing(name: str, ticks: int) -> Callable[[Bench], None]:
    def made(bench: Bench) -> None:
        at, counter = LOOPS.index(name), bench.counter
        for _ in range(ticks):
            bench.tick(Beat(at, counter, 1), leave_out=(name,))

    return made


def racing(name: str, each: int, ticks: int) -> Callable[[Bench], None]:
    def made(bench: Bench) -> None:
        at, counter = LOOPS.index(name), bench.counter
        for _ in range(ticks):
            counter += each
            bench.tick(Beat(at, counter, 1), leave_out=(name,))

    return made


TRIPS: dict[str, tuple[str, Callable[[Bench], None]]] = {
    "control silent": ("control", silence("control", ticks=11)),
    "udp silent": ("udp", silence("udp", ticks=11)),
    "parse silent": ("parse", silence("parse", ticks=11)),
    "gps silent": ("gps", silence("gps", ticks=201)),
    "gui silent": ("gui", silence("gui", ticks=201)),
    "pdci silent": ("pdci", silence("pdci", ticks=201)),
    "control stands": ("control", standing("control", 11)),
    "pdci stands": ("pdci", standing("pdci", 201)),
    "control races": ("control", racing("control", 2, 62)),
    "udp races": ("udp", racing("udp", 40, 26)),
    "gps races": ("gps", racing("gps", 10, 21)),
    "gui goes back": ("gui", racing("gui", -1, 1)),
    "parse failed": ("parse", lambda bench: void(bench.tick(Beat(2, bench.counter + 2, 3)))),
    "the server failed": ("", lambda bench: void(bench.tick(Beat(6, bench.counter + 2, 3)))),
    "no command": ("command_silent", silence("command", ticks=11)),
    "a bad datagram": ("malformed", lambda bench: void(bench.tick(Malformed("crc")))),
    "more than 10 V": ("range", commanding(volts=10.001)),
    "less than -10 V": ("range", commanding(volts=-10.001)),
    "MW and volts disagree": ("mismatch", commanding(volts=1.0, mw=13.001)),
    "a command again": ("sequence", lambda bench: void(bench.tick(bench.command(sequence=bench.sequence)))),
    "a command from before": ("sequence", lambda bench: void(bench.tick(bench.command(sequence=1)))),
    "an old command": ("stamp", commanding(age_ms=100.1)),
    "a command of the future": ("stamp", commanding(age_ms=-100.1)),
    "volts without relays": ("unasked", commanding(volts=0.01, relays=False)),
    "three readbacks off": ("readback", reading_back(0.0, 0.21, -0.21, 0.21)),
    "readbacks stop": ("readback_silent", lambda bench: (reading_back(0.0)(bench), silence(ticks=21)(bench))[1]),
    "an operator's word": ("estop_software", lambda bench: void(bench.tick(Word("estop", "op")))),
    "line a": ("estop_a", with_inputs(1, estop_a=False)),
    "line b": ("estop_b", with_inputs(1, estop_b=False)),
    "a contact opens": ("relay_open", with_inputs(12, contact_a=Contact.OPEN)),
    "a relay cannot be driven": ("drive", lambda bench: void(bench.tick(Driven(False)))),
    "the watchdog is late": ("late", lambda bench: void(bench.tick(after_ns=61 * MS))),
}
WARNS = frozenset(("the server failed",))


@pytest.mark.parametrize("name", TRIPS)
def test_a_fault_opens_the_relays_and_latches(name: str) -> None:
    cause, fault = TRIPS[name]
    bench = Bench().closed()
    fault(bench)
    if name in WARNS:
        assert bench.state is State.CLOSED and bench.named == ["close", "warning"]
        return
    assert bench.state is State.TRIPPED and cause in bench.causes
    assert bench.left[-1] == (0, 0.0)
    assert [name for name in bench.named if name != "estop"] == ["close", "trip"]
    assert cause in {finding.rule.cause for finding in bench.events[-1].found}


ALMOST: dict[str, Callable[[Bench], None]] = {
    "a beat missed for 100 ms": silence("control", "udp", "parse", "command", ticks=9),
    "slow beats missed for 2 s": silence("gps", "gui", "pdci", ticks=199),
    "a counter that stands for 100 ms": standing("control", 10),
    "the control loop catches up": racing("control", 11, 10),
    "a full turn of the counter": lambda bench: void(wrapped(bench)),
    "10 V": lambda bench: void([bench.tick(bench.command(volts=v), leave_out=("command",)) for v in (10, -10)]),
    "a little disagreement": commanding(volts=1.0, mw=13.0),
    "lost commands": lambda bench: void(bench.tick(bench.command(sequence=bench.sequence + 2**31 - 9))),
    "100 ms old": commanding(age_ms=100.0),
    "two readbacks off, one good, two off": reading_back(0.0, 9.0, 9.0, 0.2, -9.0, -9.0, -0.2),
    "late by 50 ms": lambda bench: void(bench.tick(after_ns=60 * MS)),
    "a contact that takes its time": with_inputs(10, contact_b=Contact.OPEN),
    "a server that was never there": silence(ticks=300),
}


def wrapped(bench: Bench) -> None:
    bench.memory = bench.memory._replace(
        loops=tuple(loop and loop._replace(counter=2**32 - 1) for loop in bench.memory.loops),
        command=bench.command(sequence=2**32 - 1),
    )
    bench.counter = bench.sequence = -1
    for _ in range(5):
        bench.tick()
        assert bench.state is State.CLOSED


@pytest.mark.parametrize("name", ALMOST)
def test_what_is_within_its_limits_does_not(name: str) -> None:
    bench = Bench().closed()
    ALMOST[name](bench)
    assert bench.state is State.CLOSED, bench.causes


LATCHES: dict[str, Callable[[Bench], None]] = {
    **{name: TRIPS[name][1] for name in ("an operator's word", "line a", "line b")},
    "the lines differ": with_inputs(7, estop_a=False),
    "a welded contact": with_inputs(12, contact_a=Contact.CLOSED),
    "a contact that cannot be read": with_inputs(12, contact_b=Contact.UNKNOWN),
}


@pytest.mark.parametrize("name", LATCHES)
def test_what_latches_does_so_with_open_relays_too(name: str) -> None:
    bench = opened()
    LATCHES[name](bench)
    assert bench.state is State.TRIPPED and bench.named[-1] == "trip"


@pytest.mark.parametrize("name", [name for name in TRIPS if name not in LATCHES and name not in WARNS])
def test_what_trips_only_blocks_while_the_relays_are_open(name: str) -> None:
    if name == "a contact opens":
        return
    bench = opened()
    TRIPS[name][1](bench)
    assert bench.state is State.OPEN and not bench.decision.healthy  # type: ignore[union-attr]
    assert TRIPS[name][0] in bench.causes


def test_the_discrepancy_of_the_lines_latches_after_50_ms() -> None:
    bench = opened()
    bench.inputs = Inputs(True, False)
    for _ in range(6):
        bench.tick()
        assert "estop_discrepancy" not in bench.causes
    bench.tick()
    assert bench.causes == ("estop_b", "estop_discrepancy")
    bench.inputs = RELEASED
    bench.tick()
    assert bench.causes == ("estop_b", "estop_discrepancy") and bench.state is State.TRIPPED
    bench.reset()
    assert bench.causes == () and bench.state is State.OPEN


def test_every_bad_command_of_a_round_counts() -> None:
    bench = Bench().closed()
    bad, good = bench.command(volts=11.0), bench.command()
    bench.tick(bad, good, bench.command(), leave_out=("command",))
    assert bench.state is State.TRIPPED and bench.causes == ("range",)


def test_a_server_that_was_heard_and_is_silent_is_told_once() -> None:
    bench = Bench().closed()
    server = LOOPS.index("server")
    bench.tick(Beat(server, 1, 1))
    for _ in range(300):
        bench.tick()
    assert bench.named == ["close", "warning"] and bench.state is State.CLOSED
    assert [finding.rule.name for finding in bench.events[-1].found] == ["server_silent"]
    assert bench.causes == ("server",) and bench.decision.healthy  # type: ignore[union-attr]
    bench.tick(Beat(server, 2, 1))
    bench.tick(Beat(server, 3, 1))
    assert bench.named == ["close", "warning", "warning_over"]


# --- reset -------------------------------------------------------------------------------------------------------


def test_a_reset_waits_until_the_causes_are_gone_and_never_closes() -> None:
    bench = Bench().closed()
    bench.tick(Word("estop", "Ann"))
    bench.reset("Ben")
    assert bench.state is State.TRIPPED and bench.named == ["close", "estop", "trip", "refused"]
    assert [finding.rule.name for finding in bench.events[-1].found] == ["estop_software"]
    bench.tick(Word("estop_release", "Ann"))
    assert bench.state is State.TRIPPED and bench.causes == ("estop_software",)
    bench.reset("Ben")
    assert bench.state is State.OPEN and bench.events[-1].name == "reset" and bench.events[-1].who == "Ben"
    for _ in range(100):  # the controller goes on asking
        bench.tick()
    assert bench.state is State.OPEN
    ask(bench, False)
    ask(bench, True)
    assert bench.state is State.CLOSED


def test_a_low_request_while_tripped_does_not_count_for_after_the_reset() -> None:
    bench = tripped()
    bench.relays = True
    bench.reset()
    for _ in range(10):
        bench.tick()
    assert bench.state is State.OPEN


def test_a_reset_where_nothing_is_tripped_is_refused() -> None:
    for bench in (opened(), Bench().closed()):
        before = bench.state
        bench.reset("op")
        assert bench.state is before and bench.named[-1] == "refused"


def test_a_reset_does_not_hide_that_the_request_fell() -> None:
    bench = Bench().closed()
    bench.relays = False
    bench.reset()
    assert bench.state is State.OPEN and bench.named == ["close", "refused", "open"]


def test_causes_that_come_after_the_trip_are_kept() -> None:
    bench = Bench().closed()
    bench.tick(Malformed("crc"))
    bench.tick(bench.command(volts=11.0), leave_out=("command",))
    bench.tick()
    assert bench.causes == ("malformed", "range")


# --- what leaves -------------------------------------------------------------------------------------------------


def test_open_relays_send_zero_each_20_ms_with_a_sequence_of_their_own() -> None:
    bench = opened()
    sequences = []
    for _ in range(20):
        decision = bench.tick(after_ns=5 * MS)
        if decision.forward:
            sequences.append(decision.forward.sequence)
            assert decision.forward[1:] == (None, 0.0, 0.0, 0)
    assert sequences == [1, 2, 3, 4, 5]


def test_closed_relays_send_each_command_once() -> None:
    bench = Bench().closed(1.0)
    before = len(bench.left)
    bench.tick(leave_out=("command",))
    assert len(bench.left) == before
    decision = bench.tick()
    assert decision.forward is not None and decision.forward.time_ns == bench.now_ns
    assert len(bench.left) == before + 1


def test_a_status_is_told_each_20_ms_and_when_something_changes() -> None:
    bench = opened()
    assert [bench.tick(after_ns=5 * MS).tell for _ in range(8)] == [False, False, False, True] * 2
    assert bench.tick(Word("estop", "op"), after_ns=MS).tell
    assert not bench.tick(after_ns=MS).tell


@pytest.mark.parametrize(
    ("volts", "safe"), [(10.5, 10.0), (-10.5, -10.0), (1e300, 10.0), (math.nan, 0.0), (math.inf, 0.0), (-3.0, -3.0)]
)
def test_the_limiter(volts: float, safe: float) -> None:
    assert safe_volts(volts) == safe


def test_a_readback_is_judged_by_the_command_that_it_answers() -> None:
    bench = Bench().closed(5.0)
    sequence = bench.memory.sent[-1][0]
    bench.volts = -5.0
    for _ in range(5):
        bench.tick(Readback(sequence, 5.0))
    assert bench.state is State.CLOSED
    for _ in range(70):
        bench.tick(Readback(bench.memory.sent[-1][0], -5.0))
    assert bench.state is State.CLOSED  # so many commands later it answers none that is remembered
    for _ in range(3):
        bench.tick(Readback(sequence, 5.0))
    assert bench.state is State.TRIPPED and "readback" in bench.causes


def test_required_readbacks_and_other_beats() -> None:
    bench = Bench(RULES._replace(readback_required=True, beats=("control",)))
    bench.tick()
    assert bench.causes == ("readback_silent",)
    bench.tick(Readback(bench.memory.sent[-1][0], 0.0))
    assert bench.causes == ()
    ask(bench, True)
    assert bench.state is State.CLOSED


# --- no sequence of news -----------------------------------------------------------------------------------------

FLOATS = st.one_of(st.sampled_from([0.0, 0.05, 0.1, 5.0, -10.0, 10.0]), st.floats())
WRONG: list[Item] = [
    Malformed("crc"),
    Driven(False),
    Word("estop", "op"),
    Inputs(False, True),
    Inputs(False, False),
    Inputs(True, True, Contact.OPEN, Contact.CLOSED),
    Beat(0, 5, 3),
    Beat(3, 1, 0),
    Beat(6, 7, 1),
    Readback(0, 9.0),
]
ACTS = st.lists(
    st.one_of(
        st.tuples(st.just("relays"), st.booleans()),
        st.tuples(st.just("volts"), FLOATS),
        st.tuples(st.just("good"), st.integers(1, 15)),
        st.tuples(st.just("wrong"), st.sampled_from(WRONG)),
        st.tuples(st.just("quiet"), st.integers(1, 15)),
        st.tuples(st.just("late"), st.integers(1, 300)),
        st.tuples(st.just("right"), st.sampled_from([Word("estop_release", "op"), Word("reset", "op"), RELEASED])),
    ),
    max_size=40,
)


def acted(bench: Bench, act: tuple[str, Any]) -> None:
    match act:
        case ("relays", bool(value)):
            bench.relays = value
        case ("volts", float(value)):
            bench.volts = value if math.isfinite(value) else 0.0  # the codec lets no other pass
        case ("good", int(ticks)):
            for _ in range(ticks):
                bench.tick()
        case ("quiet", int(ticks)):
            for _ in range(ticks):
                bench.only()
        case ("late", int(ms)):
            bench.tick(after_ns=ms * MS)
        case (_, Inputs() as inputs):
            bench.inputs = inputs
            bench.tick()
        case (_, item):
            bench.tick(item)


STOPS = sum(1 << bit for bit, name in enumerate(CAUSES) if name != "server")


class Watched(Bench):
    """Looks after every step whether what must always hold does."""

    def only(self, *news: Item, after_ns: int = TICK_NS) -> Decision:
        before = self.memory
        decision = super().only(*news, after_ns=after_ns)
        self.judged(before, decision, news)
        return decision

    def judged(self, before: Memory, decision: Decision, news: tuple[Item, ...]) -> None:
        closes = decision.state is State.CLOSED
        assert decision.relay_a == decision.relay_b == closes
        blocks = self.trips_up()
        if closes:
            assert not blocks and self.memory.command is not None and self.memory.command.relays
        if closes and before.state is not State.CLOSED:
            assert before.state is State.OPEN and decision.healthy
            assert abs(self.memory.command.volts) <= 0.1  # type: ignore[union-attr]
            assert before.low_seen or any(getattr(item, "relays", True) is False for item in news)
        if before.state is State.TRIPPED and decision.state is not State.TRIPPED:
            assert decision.state is State.OPEN and any(isinstance(i, Word) and i.verb == "reset" for i in news)
            assert not blocks
        if before.state is State.CLOSED and blocks:
            assert decision.state is State.TRIPPED
        if decision.state is State.TRIPPED:
            assert decision.causes & STOPS
        if (forward := decision.forward) is not None:
            assert math.isfinite(forward.volts) and abs(forward.volts) <= 10.0
            assert forward.mw == forward.volts * 12.5
            assert closes or (forward.volts == 0.0 and forward.flags == 0)
        assert decision.healthy <= (not decision.causes & STOPS)

    def trips_up(self) -> bool:
        """From the table itself, by the names of its actions."""
        for rule in TABLE:
            value = rule.value(self.rules, self.memory, rule.at, self.now_ns)
            limit = getattr(self.rules.limits, rule.limit) if rule.limit else 0.0
            if value is not None and rule.action in (Action.TRIP, Action.LATCH):
                state_was_closed = rule.cause in ("relay_open", "relay_welded")  # judged by the state before
                if not state_was_closed and (value >= limit if rule.reached else not value <= limit):
                    return True
        return False


@settings(max_examples=80, deadline=None)
@given(ACTS, st.booleans())
def test_no_sequence_of_news_closes_the_relays_while_a_cause_is_up(acts: list[tuple[str, Any]], warm: bool) -> None:
    bench = Watched()
    if warm:
        bench.closed()
    for act in acts:
        acted(bench, act)


@settings(max_examples=60, deadline=None)
@given(ACTS)
def test_a_trip_survives_everything_but_a_reset(acts: list[tuple[str, Any]]) -> None:
    bench = Watched().closed()
    bench.tick(Malformed("crc"))
    for act in acts:
        if act != ("right", Word("reset", "op")):
            acted(bench, act)
    assert bench.state is State.TRIPPED and "malformed" in bench.causes
    assert all(volts == 0.0 for _, volts in bench.left[-3:])


@settings(max_examples=20, deadline=None)
@given(ACTS)
def test_the_same_news_give_the_same_decisions(acts: list[tuple[str, Any]]) -> None:
    benches = [Bench().closed() for _ in range(2)]
    for bench in benches:
        for act in acts:
            acted(bench, act)
    assert benches[0].memory == benches[1].memory and benches[0].left == benches[1].left


ITEMS = st.one_of(
    st.sampled_from(WRONG),
    st.builds(Beat, st.integers(0, 7), st.integers(0, 2**32 - 1), st.integers(0, 3)),
    st.builds(Readback, st.integers(0, 2**32 - 1), st.floats(allow_nan=False)),
    st.builds(
        Bench().command,
        volts=st.floats(),
        mw=st.floats(),
        relays=st.booleans(),
        sequence=st.integers(0, 2**32 - 1),
        age_ms=st.floats(),
    ),
)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.lists(ITEMS, max_size=8), st.integers(-100, 10_000)), max_size=30))
def test_no_news_makes_it_raise_or_drive_too_much(rounds: list[tuple[list[Item], int]]) -> None:
    memory, now_ns = Bench().closed(5.0).memory, 6_000_000_000
    for news, ms in rounds:
        now_ns += ms * MS
        memory, decision = step(Rules(Limits()), memory, news, now_ns)
        if decision.forward is not None:
            assert abs(decision.forward.volts) <= 10.0 and math.isfinite(decision.forward.mw)


def test_the_memory_does_not_grow() -> None:
    bench = Bench().closed(1.0)
    for _ in range(500):
        bench.tick(Readback(bench.memory.sent[-1][0], 1.0))
    assert len(bench.memory.sent) == 64 and bench.memory.words == ()


def test_names_of_causes() -> None:
    assert names_of(BIT["late"] | BIT["control"]) == ("control", "late")
    assert with_limits(late_max_ms=9.0).limits.late_max_ms == 9.0
