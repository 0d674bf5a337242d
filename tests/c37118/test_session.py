"""The roles: every state and event, silence and back-off, configuration changes, and a server's manners."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmutools.c37118 import (
    Command,
    Format,
    FrameType,
    PhasorChannel,
    Station,
    StreamConfig,
    as_kind,
    decode_command,
    decode_config,
    decode_header,
    decode_prefix,
    encode_command,
    encode_config,
)
from pmutools.c37118.session import (
    CFG2_FIRST,
    CFG3_FIRST,
    CLIENT_TABLES,
    REQUESTS,
    SAVED_CONFIG,
    SERVER,
    SPONTANEOUS,
    ClientAction,
    ClientEvent,
    ClientRole,
    ClientState,
    ClientTable,
    Outcome,
    SendState,
    ServerRole,
    Timing,
    backoff_ns,
    command_for,
    served,
    transitions,
)
from pmutools.timebase import NS

A, E, S = ClientAction, ClientEvent, ClientState
STATION = Station("STATION A", 7, Format(0), (PhasorChannel("VA", 100),))
CONFIG = StreamConfig(7, (STATION,), 60)
TWO = StreamConfig(7, (STATION, replace(STATION, name="B", idcode=8)), 60)


def data(config: StreamConfig, *stats: int) -> bytes:
    """As much of a data frame as a role looks at: STAT of each station in its place."""
    frame = bytearray(config.frame_size)
    at = 14
    for station, stat in zip(config.stations, stats, strict=True):
        frame[at : at + 2] = stat.to_bytes(2, "big")
        at += station.block_size
    return bytes(frame)


# --- tables


@pytest.mark.parametrize("table", CLIENT_TABLES.values(), ids=CLIENT_TABLES)
def test_every_state_is_reached_and_left(table: ClientTable) -> None:
    reached = {S.IDLE}
    while grown := {step.state for (state, _), step in table.items() if state in reached} - reached:
        reached |= grown
    assert reached == {state for state, _ in table}
    for state in reached - {S.IDLE}:
        assert table[state, E.CLOSED].state is S.IDLE
        assert table[state, E.STOP].state is S.IDLE


@pytest.mark.parametrize("table", CLIENT_TABLES.values(), ids=CLIENT_TABLES)
def test_tables_for_diagrams_are_complete_and_ordered(table: ClientTable) -> None:
    rows = list(transitions(table))
    assert {(state, event): step for state, event, step in rows} == dict(table)
    order = [list(S).index(state) for state, _, _ in rows]
    assert order == sorted(order)


@pytest.mark.parametrize("table", [CFG2_FIRST, CFG3_FIRST, SAVED_CONFIG])
def test_whoever_waits_on_a_server_has_a_time_out_and_an_end(table: ClientTable) -> None:
    for state in (S.WAIT_CFG2, S.WAIT_DATA):
        assert (state, E.TIMEOUT) in table
        assert table[state, E.EXHAUSTED].actions == (A.DISCONNECT,)


def test_spontaneous_streams_are_never_talked_to() -> None:
    assert all(not step.actions for step in SPONTANEOUS.values())


# --- client


def step_through(role: ClientRole, *events: ClientEvent, now_ns: int = 0) -> list[tuple[ClientAction, ...]]:
    return [role.handle(event, now_ns) for event in events]


def test_the_usual_conversation() -> None:
    role = ClientRole(CFG2_FIRST)
    assert role.handle(E.OPENED, 0) == (A.REQUEST_CFG2,)
    assert role.hear_config(CONFIG, 1) == (A.SEND_START,)
    assert role.state is S.WAIT_DATA
    assert role.hear_data(data(CONFIG, 0), CONFIG, 2) == ()
    assert role.state is S.STREAMING
    assert role.handle(E.STOP, 3) == (A.SEND_STOP,)
    assert (role.state, role.deadline_ns) == (S.IDLE, None)


def test_cfg3_is_asked_for_first_and_given_up_on_silence() -> None:
    role = ClientRole(CFG3_FIRST)
    assert role.handle(E.OPENED, 0) == (A.REQUEST_CFG3,)
    assert role.deadline_ns == NS, "most devices know no CFG-3: nobody wants to wait long for each of them"
    assert role.check_time(NS - 1) == ()
    assert role.check_time(NS) == (A.FALL_BACK, A.REQUEST_CFG2)
    assert role.deadline_ns == 4 * NS
    assert role.hear_config(CONFIG, NS + 1) == (A.SEND_START,)
    role.handle(E.CLOSED, 4 * NS)
    assert role.handle(E.OPENED, 5 * NS) == (A.REQUEST_CFG2,)  # it does not know CFG-3: not asked for again


def test_cfg3_that_does_not_fit_the_data_is_given_up_when_it_comes_again() -> None:
    full = as_kind(CONFIG, FrameType.CFG3)
    role = ClientRole(CFG3_FIRST)
    role.handle(E.OPENED, 0)
    assert role.hear_config(full, 1) == (A.SEND_START,)
    assert role.hear_misfit(4 * NS) == (A.REQUEST_CFG3,), "it may have changed"
    assert role.hear_config(full, 4 * NS + 1) == (A.SEND_START,)
    assert role.hear_misfit(5 * NS) == (), "not so soon"
    assert role.hear_misfit(8 * NS) == (A.REQUEST_CFG2,)
    assert role.hear_config(CONFIG, 8 * NS + 1) == (A.SEND_START,)
    assert role.hear_data(data(CONFIG, 0), CONFIG, 8 * NS + 2) == ()
    assert role.state is S.STREAMING


def test_a_cfg2_that_says_less_makes_it_ask_again() -> None:
    """The server has changed its configuration, and told so in the short form."""
    full = as_kind(CONFIG, FrameType.CFG3)
    role = ClientRole(CFG3_FIRST)
    role.handle(E.OPENED, 0)
    role.hear_config(full, 1)
    role.hear_data(data(full, 0), full, 2)
    assert role.hear_config(TWO, 5 * NS) == (A.REQUEST_CFG3,)
    assert role.hear_config(as_kind(TWO, FrameType.CFG3), 5 * NS + 1) == (A.SEND_START,)
    spontaneous = ClientRole(SPONTANEOUS)
    spontaneous.handle(E.OPENED, 0)
    spontaneous.hear_config(full, 1)
    assert spontaneous.hear_config(TWO, 5 * NS) == ()


def test_cfg3_that_is_answered_stays() -> None:
    role = ClientRole(CFG3_FIRST)
    step_through(role, E.OPENED, E.CONFIG, E.DATA)
    assert role.state is S.STREAMING
    assert role.handle(E.CHANGED, 10 * NS) == (A.REQUEST_CFG3,)


def test_unanswered_requests_are_repeated_then_given_up() -> None:
    role = ClientRole(CFG2_FIRST, Timing(answer_ns=NS, tries=3))
    role.handle(E.OPENED, 0)
    assert [role.check_time(k * NS) for k in (1, 2, 3)] == [(A.REQUEST_CFG2,), (A.REQUEST_CFG2,), (A.DISCONNECT,)]
    assert (role.state, role.deadline_ns) == (S.IDLE, None)


def test_silence_starts_anew_then_gives_up() -> None:
    role = ClientRole(CFG2_FIRST, Timing(silence_ns=NS, tries=3))
    step_through(role, E.OPENED, E.CONFIG)
    role.hear_data(data(CONFIG, 0), CONFIG, NS // 2)
    assert role.check_time(NS) == ()
    assert role.deadline_ns == 3 * NS // 2  # data came meanwhile: looked at again when they would be missed
    assert role.check_time(3 * NS // 2) == (A.SEND_START,)
    assert role.state is S.WAIT_DATA
    assert role.check_time(5 * NS // 2) == (A.SEND_START,)
    assert role.check_time(7 * NS // 2) == (A.DISCONNECT,)


def test_slow_streams_may_be_silent_for_longer() -> None:
    role = ClientRole(CFG2_FIRST)
    role.handle(E.OPENED, 0)
    role.hear_config(replace(CONFIG, data_rate=-10), 0)  # a frame every ten seconds
    assert role.silence_ns == 30 * NS
    role.hear_config(replace(CONFIG, data_rate=0), 0)  # undefined
    assert role.silence_ns == 5 * NS


def test_a_saved_configuration_starts_at_once_and_asks_all_the_same() -> None:
    role = ClientRole(SAVED_CONFIG)
    assert role.handle(E.OPENED, 0) == (A.REQUEST_CFG2, A.SEND_START)
    assert role.hear_data(data(CONFIG, 0), CONFIG, 1) == ()
    assert role.state is S.STREAMING


def test_config_change_bit_asks_on_both_edges() -> None:
    role = ClientRole(CFG2_FIRST)
    step_through(role, E.OPENED, E.CONFIG)
    change, none = data(TWO, 0, 0x0400), data(TWO, 0, 0)
    assert role.hear_data(none, TWO, 10 * NS) == ()
    assert role.hear_data(change, TWO, 11 * NS) == (A.REQUEST_CFG2,)
    assert role.hear_config(TWO, 12 * NS) == (A.SEND_START,)
    assert all(role.hear_data(change, TWO, now * NS) == () for now in range(13, 60))
    assert role.hear_data(none, TWO, 60 * NS) == (A.REQUEST_CFG2,)  # from this frame on the new one applies


def test_an_undefined_stat_announces_nothing() -> None:
    role = ClientRole(CFG2_FIRST)
    step_through(role, E.OPENED, E.CONFIG)
    assert role.hear_data(data(TWO, 0xFFFF, 0), TWO, 10 * NS) == ()


def test_misfits_ask_again_but_not_in_a_storm() -> None:
    role = ClientRole(CFG2_FIRST, Timing(answer_ns=NS))
    step_through(role, E.OPENED, E.CONFIG, E.DATA)
    asked = [now_ms for now_ms in range(2000, 7000) if role.hear_misfit(now_ms * 1_000_000) == (A.REQUEST_CFG2,)]
    assert asked == [2000]  # then it waits for the answer, and its own time-out repeats
    for now_ms in range(7000, 12000):  # a server whose answer never fits: request, answer, start, misfit, ...
        if role.hear_misfit(now_ms * 1_000_000):
            asked.append(now_ms)
        role.hear_config(CONFIG, now_ms * 1_000_000)
    assert len(asked) <= 7


moments = st.tuples(
    st.integers(0, 3 * NS), st.sampled_from(["config", "data", "change", "misfit", "time", *ClientEvent])
)


@settings(deadline=None)
@given(st.sampled_from(list(CLIENT_TABLES)), st.lists(moments, max_size=60))
def test_whatever_comes_requests_stay_rare_and_deadlines_ahead(name: str, script: list[tuple[int, str]]) -> None:
    role = ClientRole(CLIENT_TABLES[name])
    now_ns = 0
    asked_ns: list[int] = []
    for gap_ns, event in script:
        now_ns += gap_ns
        match event:
            case "config":
                actions = role.hear_config(CONFIG, now_ns)
            case "data" | "change":
                actions = role.hear_data(data(CONFIG, 0x0400 if event == "change" else 0), CONFIG, now_ns)
            case "misfit":
                actions = role.hear_misfit(now_ns)
            case "time":
                actions = role.check_time(now_ns)
            case _:
                actions = role.handle(ClientEvent(event), now_ns)
        if event in (E.OPENED, E.TIMEOUT, E.CHANGED):
            asked_ns.clear()  # played by hand, not by the role
        elif {A.REQUEST_CFG2, A.REQUEST_CFG3} & set(actions):
            asked_ns.append(now_ns)
        assert all(later - earlier >= 3 * NS for earlier, later in pairwise(asked_ns))
        if role.state is S.IDLE:
            assert role.deadline_ns is None
        if event == "time" and role.deadline_ns is not None:
            assert role.deadline_ns > now_ns


def test_commands_of_actions() -> None:
    for action in A:
        frame = command_for(action, 7, 12 * NS + 5)
        assert (frame is None) == (action not in REQUESTS)
        if frame is not None:
            command = decode_command(frame)
            assert (command.prefix.idcode, command.prefix.soc, command.code) == (7, 12, REQUESTS[action])


def test_back_off_doubles_up_to_its_limit() -> None:
    waits_ns = [backoff_ns(attempt) for attempt in range(12)]
    assert waits_ns[:4] == [NS // 2, NS, 2 * NS, 4 * NS]
    assert waits_ns == sorted(waits_ns)
    assert backoff_ns(10**6) == waits_ns[-1] == 30 * NS


# --- server


def test_the_server_table_is_total() -> None:
    assert set(SERVER) == {(state, command) for state in SendState for command in Command}
    for state in SendState:
        assert SERVER[state, Command.START_DATA].state is SendState.STARTED
        assert SERVER[state, Command.STOP_DATA].state is SendState.STOPPED


def test_a_server_answers_in_its_own_name_and_time() -> None:
    role = ServerRole({7: served(CONFIG, "a substation")})
    now_ns = 1_700_000_000 * NS + 250_000_000
    for code, kind in (
        (Command.SEND_CFG1, FrameType.CFG1),
        (Command.SEND_CFG2, FrameType.CFG2),
        (Command.SEND_CFG3, FrameType.CFG3),
    ):
        answer = role.hear(encode_command(7, code), now_ns)
        assert answer.outcome is Outcome.ANSWERED
        assert answer.frame is not None
        prefix, config = decode_config(answer.frame)
        assert (config.kind, config.idcode, config.rate) == (kind, 7, 60)
        assert (prefix.soc, prefix.fracsec) == (1_700_000_000, 250_000)
    header = role.hear(encode_command(7, Command.SEND_HEADER), now_ns).frame
    assert header is not None
    assert decode_header(header).text == "a substation"


def test_start_and_stop_are_idempotent_and_per_stream() -> None:
    role = ServerRole({7: served(CONFIG), 9: served(replace(CONFIG, idcode=9))})
    start, stop = encode_command(7, Command.START_DATA), encode_command(7, Command.STOP_DATA)
    outcomes = [role.hear(frame, 0).outcome for frame in (stop, start, start)]
    assert outcomes == [Outcome.STOPPED, Outcome.STARTED, Outcome.STARTED]
    assert role.started == {7}
    role.hear(stop, 0)
    assert role.started == set()


@pytest.mark.parametrize(
    ("frame", "outcome"),
    [
        (encode_command(8, Command.START_DATA), Outcome.FOREIGN),
        (encode_command(7, Command.SEND_HEADER), Outcome.UNAVAILABLE),
        (encode_command(7, 0x0007), Outcome.UNKNOWN),
        (encode_command(7, 0x0123, extended=b"ab"), Outcome.UNKNOWN),
        (encode_command(7, Command.EXTENDED, extended=b"abcd"), Outcome.EXTENDED),
        (encode_config(CONFIG), Outcome.NO_COMMAND),
        (b"\xaa\x41\x00\x04\x00\x07", Outcome.NO_COMMAND),
    ],
)
def test_what_a_server_does_not_serve_it_answers_by_silence(frame: bytes, outcome: Outcome) -> None:
    role = ServerRole({7: served(CONFIG)})
    answer = role.hear(frame, 0)
    assert (answer.outcome, answer.frame, role.started) == (outcome, None, set())
    if outcome is Outcome.EXTENDED:
        assert answer.extended == b"abcd"


@settings(deadline=None)
@given(st.binary(max_size=40))
def test_a_server_survives_any_bytes(junk: bytes) -> None:
    role = ServerRole({7: served(CONFIG)})
    assert role.hear(junk.ljust(6, b"\0"), 0).frame is None


def test_version_nibble_2_on_a_command_is_accepted() -> None:
    """pySynphasor's default command is AA42."""
    from pmutools.c37118.frames import encode_message

    plain = decode_command(encode_command(7, Command.START_DATA))
    frame = encode_message(replace(plain, prefix=plain.prefix._replace(sync=0xAA42)))
    assert decode_prefix(frame).version == 2
    assert ServerRole({7: served(CONFIG)}).hear(frame, 0).outcome is Outcome.STARTED
