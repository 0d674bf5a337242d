"""Section V of the paper over sockets: ``pmu play`` with one profile, two ``dcon run`` that get the very same packets.

Closed loop, the command goes to a gateway; the recorded grid does not answer. Every case is judged by what the session
log says arrived and when, at the default limits. What is seen goes into a table of the documentation.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial

import pytest
from support import paper_course as course
from support import paper_facts as see
from support.course_run import AS_SET, SETTINGS, WITHOUT, CourseRun, run
from support.logged import NAMES, RATE
from support.outcomes import Fact, Outcome, complete, keep, relays_of

from dcon.cli import dcon
from dcon.core.values import SystemState
from pmutools.cli.shell import run as run_command

pytestmark = [
    pytest.mark.alone,
    pytest.mark.slow,
    pytest.mark.realtime,
    pytest.mark.timeout(240),
    pytest.mark.skipif(sys.platform != "linux", reason="dcon run is Linux's"),
]


@pytest.fixture(scope="module")
def course_run(tmp_path_factory: pytest.TempPathFactory) -> CourseRun:
    return run(tmp_path_factory.mktemp("paper"))


# --- the cases ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """What is done to the streams, and what has to be seen of it. ``paper`` is where the paper has it."""

    paper: str
    what: str
    from_s: float
    to_s: float
    facts: tuple[Fact, ...]
    session: str = AS_SET
    state: str = "ACTIVE"
    relays: str = "closed"


FIRST_RIGHT, FIRST_WRONG = "the first command helps the south (P > 0)", "the first command hurts the south (P < 0)"
ONE_STAMP = Fact(
    "every Δf, in every tick, is that of the newest stamp that both PMUs have", see.differences_are_of_one_stamp
)
TWO_STAMPS = Fact("Δf is of two stamps, and false", see.differences_are_of_two_stamps)
SPIKE = Fact("the filter alone would have made a spike of it, which is in no command", see.unseen_it_is_a_spike)
LOST = "generation is lost in the south"
CASES = {
    "south-loss": Case(
        "Figs. 13, 14",
        f"{LOST}, all streams alike",
        course.LOSS_S[0] - 1,
        course.LOSS_S[0] + 0.25,
        (
            Fact("frequency falls in the south first", see.fell_in_the_south_first),
            Fact(FIRST_RIGHT, partial(see.first_command, 0, 1)),
            ONE_STAMP,
        ),
    ),
    "two-zero": Case(
        "Figs. 10, 11",
        "of every PMU two frames come in one window, none in the next",
        *course.TWO_ZERO_S,
        (
            Fact("no frequency differs by one bit from that of even arrival", see.no_bit_is_changed),
            Fact("every second tick is held, and nothing else is different", see.every_second_tick_is_held),
            ONE_STAMP,
        ),
    ),
    "two-windows": Case(
        "section IV b",
        "two frames of S1 come with the one after them",
        course.HELD_S,
        course.DROPPED_S - 0.1,
        (
            Fact("its instances hold for two ticks, and the command is repeated", see.two_windows_are_held),
            Fact("all three frames are filtered: not a bit is different", see.held_frames_are_filtered),
        ),
    ),
    "dropout": Case(
        "Fig. 12",
        "one frame of N1 is lost",
        course.DROPPED_S,
        course.GAP_S - 0.1,
        (
            Fact("all four instances of N1 are disabled in the tick of its next frame", see.lost_frame_disables),
            Fact(
                "N2-S1 takes over in that tick without a step",
                partial(see.next_one_takes_over, "stamp_step", "N1", "N2-S1"),
            ),
            SPIKE,
        ),
    ),
    "dropout-bridged": Case(
        "Fig. 12, Algorithm 1",
        "the same, with `interpolate_single_loss`",
        course.DROPPED_S,
        course.GAP_S - 0.1,
        (
            Fact("the frame is bridged, and no instance is lost", see.lost_frame_is_bridged),
            Fact("f of N1 differs from that of the whole stream", see.bridged_within),
        ),
        WITHOUT,
    ),
    "50-ms": Case(
        "section IV b",
        "five frames of S1 come with the one after them",
        course.GAP_S,
        course.STOP_S[0] - 0.1,
        (
            Fact(
                "its instances are disabled in the first tick whose newest frame came more than 50 ms ago",
                partial(see.silent_for_50_ms, "S1"),
            ),
            Fact(
                "N2-S2 takes over in that tick without a step",
                partial(see.next_one_takes_over, "arrival_gap", "S1", "N2-S2"),
            ),
        ),
    ),
    "stream-stop": Case(
        "section IV b",
        "the stream of N2 stops, and returns after 2 s",
        course.STOP_S[0],
        course.STOP_S[1] + 0.5,
        (
            Fact(
                "its instances are disabled in the first tick whose newest frame came more than 50 ms ago",
                partial(see.silent_for_50_ms, "N2"),
            ),
            Fact(
                "N3-S2 takes over in that tick without a step",
                partial(see.next_one_takes_over, "arrival_gap", "N2", "N3-S2"),
            ),
            Fact("N2-S2 is READY again with the 1,200th frequency in a row", see.verified_for_20_s),
            Fact("the controller does not go back to it at once", see.not_gone_back_to),
        ),
    ),
    "south-3": Case(
        "Figs. 13, 14",
        f"{LOST}, whose streams are 3 samples late",
        course.LOSS_S[1] - 1,
        course.LOSS_S[1] + 2,
        (Fact(FIRST_RIGHT, partial(see.first_command, 1, 1)), ONE_STAMP),
    ),
    "south-3-not-aligned": Case(
        "Figs. 13, 14",
        "the same, with `align = false`",
        course.LOSS_S[1] - 1,
        course.LOSS_S[1] + 2,
        (Fact(FIRST_WRONG, partial(see.first_command, 1, -1)), TWO_STAMPS),
        WITHOUT,
    ),
    "south-6": Case(
        "Figs. 13, 14",
        f"{LOST}, whose streams are 6 samples late",
        course.LOSS_S[2] - 1,
        course.ALL_STOP_S,
        (Fact(FIRST_RIGHT, partial(see.first_command, 2, 1)), ONE_STAMP),
    ),
    "south-6-not-aligned": Case(
        "Figs. 13, 14",
        "the same, with `align = false`",
        course.LOSS_S[2] - 1,
        course.ALL_STOP_S,
        (Fact(FIRST_WRONG, partial(see.first_command, 2, -1)), TWO_STAMPS),
        WITHOUT,
    ),
    "all-lost": Case(
        "section II",
        "all eight streams stop, and with them all sixteen instances",
        course.ALL_STOP_S,
        course.END_S,
        (
            Fact("the command comes down to 0 in a second, without a step", see.comes_down_in_a_second),
            Fact("from then on 0 V leaves, and no instance is left", see.nothing_is_driven),
        ),
        state="STANDBY",
        relays="open",
    ),
}


def seen_of(course_run: CourseRun, case: Case) -> see.Seen:
    session = course_run.sessions[case.session]
    return see.Seen(course_run, session, range(session.tick_at(case.from_s), session.tick_at(case.to_s)))


@pytest.mark.parametrize("name", CASES)
def test_what_is_seen_of_it(name: str, course_run: CourseRun) -> None:
    case = CASES[name]
    with course_run.blaming(case.to_s):
        seen = seen_of(course_run, case)
        session = seen.session
        facts = {fact.words: fact.holds(seen) or "" for fact in case.facts}
        state = str(session.records[seen.ticks.stop - 1].state)
        relays = relays_of(event["event"] for at, event in session.watchdog if case.from_s <= at <= case.to_s)
        assert (state, relays) == (case.state, case.relays)
        keep("paper", name, Outcome(case.what, state, relays, events_of(seen), (), facts, case.paper))


def events_of(seen: see.Seen) -> tuple[str, ...]:
    """Of the system and of single streams, and which instance was selected; each once, in order."""
    found = dict[str, None]()
    for k in seen.ticks:
        for event in seen.session.records[k].events:
            if event.subject == "system":
                found[event.name] = None
            elif event.subject in NAMES or event.name == "selected":
                found[f"{event.name} {event.subject}"] = None
    return tuple(found)


def test_the_table_has_every_case() -> None:
    complete("paper", CASES)


# --- of both sessions, from end to end ----------------------------------------------------------------------------

each = pytest.mark.parametrize("name", SETTINGS)


@each
def test_it_was_active_in_time(name: str, course_run: CourseRun) -> None:
    with course_run.blaming(course.ACTIVE_S):
        session = course_run.sessions[name]
        assert session.when("active", "system") and session.when("active", "system")[-1] < course.ACTIVE_S


@each
def test_streams_are_found_faulty_when_they_are_and_never_else(name: str, course_run: CourseRun) -> None:
    """Held to the paper's two rules tick by tick, by what arrived when; so it holds if the machine stood still, too."""
    session = course_run.sessions[name]
    assert session.seen() == session.due()


@each
def test_nothing_but_the_profile_was_done_to_the_streams(name: str, course_run: CourseRun) -> None:
    with course_run.blaming(course.END_S):
        session = course_run.sessions[name]
        lost = "interpolated" if name == WITHOUT else "stamp_step"
        single = [(lost, "N1"), ("arrival_gap", "S1"), ("arrival_gap", "N2")]
        seen = [(fault.check, fault.name) for fault in session.seen()]
        assert seen == [*single, *(("arrival_gap", pmu) for pmu in NAMES)]


@each
def test_what_left_is_what_is_logged(name: str, course_run: CourseRun) -> None:
    session = course_run.sessions[name]
    left = {command.time_ns: command.output_v for command in session.commands}
    driving = [r for r in session.records if r.state in (SystemState.ACTIVE, SystemState.RAMPDOWN)]
    with course_run.blaming(course.END_S):
        assert len(driving) > 25 * RATE
        assert [left.get(record.tick_ns) for record in driving] == [record.output_v for record in driving]


@each
def test_no_tick_is_missing_and_every_one_replays(name: str, course_run: CourseRun) -> None:
    session = course_run.sessions[name]
    assert session.logs == [session.path.name]
    steps = {
        round((b.tick_ns - a.tick_ns) * RATE / 1e9) for a, b in zip(session.records, session.records[1:], strict=False)
    }
    assert steps == {1}
    assert run_command(dcon(), ["replay", str(session.path), "--quiet"]) == 0
