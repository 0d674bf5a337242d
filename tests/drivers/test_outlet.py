"""What the output drives: a table of datagrams and times, and properties that hold for any of them."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcon.link.command import CommandOut, encode
from dcon.link.sealed import follows
from dcon.output.outlet import CLOSED, Drive, Outlet

HOLD_NS = 100_000_000
MS = 1_000_000


def command(sequence: int, volts: float = 5.0, flags: int = CLOSED | 1, time_ns: int = 7) -> bytes:
    return encode(CommandOut(sequence, time_ns, 12.5 * volts, volts, flags))


def outlet() -> Outlet:
    return Outlet(HOLD_NS, 0)


def test_a_command_is_driven() -> None:
    out = outlet()
    assert out.turn([], 0) is None and out.held
    assert out.turn([command(3, -4.5)], 10 * MS) == Drive(-4.5, 3, 7)
    assert out.turn([], 20 * MS) is None, "no change"
    assert not out.held and out.due_ns == 110 * MS


@pytest.mark.parametrize("flags", [0, 1, ~CLOSED & 0xFFFFFFFF])
def test_a_command_that_the_watchdog_did_not_let_through_is_0_v(flags: int) -> None:
    assert outlet().turn([command(1, 5.0, flags)], MS) == Drive(0.0, 1, 7)


@pytest.mark.parametrize(("volts", "driven"), [(math.nan, 0.0), (math.inf, 0.0), (1e9, 10.0), (-10.5, -10.0)])
def test_what_is_no_voltage(volts: float, driven: float) -> None:
    out = outlet()
    found = out.turn([command(1, volts)], MS)
    assert found is not None and found.output_v == driven
    assert out.refused["not a number"] == (not math.isfinite(volts))


def test_the_newest_of_what_had_queued() -> None:
    out = outlet()
    assert out.turn([command(1, 1.0), command(2, 2.0), command(3, 3.0)], MS) == Drive(3.0, 3, 7)
    assert out.commands == 3


def test_old_and_malformed_datagrams_are_no_sign_of_life() -> None:
    out = outlet()
    out.turn([command(10)], 0)
    bad = bytearray(command(11))
    bad[20] ^= 1
    for now_ns in range(10 * MS, HOLD_NS, 10 * MS):
        assert out.turn([command(10), command(9), bytes(bad), b"", b"x" * 40, command(11)[:-1]], now_ns) is None
    assert out.turn([command(10)], HOLD_NS) == Drive(0.0)
    assert (out.refused["old"], out.refused["malformed"], out.commands, out.holds) == (19, 36, 1, 1)


def test_without_commands_it_goes_to_0_v_and_says_so_again() -> None:
    out = outlet()
    out.turn([command(1)], 50 * MS)
    assert out.turn([], 149 * MS) is None
    assert out.turn([], 150 * MS) == Drive(0.0)
    assert out.turn([], 160 * MS) is None
    assert out.turn([], 250 * MS) == Drive(0.0)
    assert out.holds == 1, "it is one silence"
    assert out.turn([command(1, 2.0)], 260 * MS) == Drive(2.0, 1, 7), "whoever comes next begins anew"


def test_what_queued_while_it_did_not_run_is_not_driven() -> None:
    out = outlet()
    out.turn([command(1)], 0)
    out.turn([], 90 * MS)
    assert out.turn([command(2), command(3)], 191 * MS) == Drive(0.0)
    assert out.refused["slept"] == 2
    assert out.turn([command(4, 1.0)], 192 * MS) == Drive(1.0, 4, 7)


def test_sequences_wrap() -> None:
    out = outlet()
    out.turn([command(2**32 - 1)], 0)
    assert out.turn([command(2**32)], MS) == Drive(5.0, 0, 7)
    assert follows(0, 2**32 - 1) and not follows(2**32 - 1, 0) and not follows(5, 5)


EVENTS = st.lists(
    st.tuples(
        st.integers(0, 250),
        st.lists(
            st.one_of(
                st.binary(max_size=50),
                st.builds(command, st.integers(0, 20), st.floats(), st.integers(0, 7)),
            ),
            max_size=3,
        ),
    ),
    max_size=40,
)


@given(EVENTS)
def test_whatever_comes_it_is_a_voltage_and_never_held_for_longer(events: list[tuple[int, list[bytes]]]) -> None:
    """The caller wakes when it is due, as the process does."""
    out, now, driven, since = outlet(), 0, 0.0, 0
    for wait_ms, datagrams in events:
        until = now + wait_ms * MS
        while out.due_ns < until:
            now = out.due_ns
            drive = out.turn([], now)
            assert drive == Drive(0.0)
            driven, since = 0.0, now
        now = until
        drive = out.turn(datagrams, now)
        if drive is not None:
            assert -10 <= drive.output_v <= 10
            if drive.output_v:
                assert any(
                    datagram == command(drive.sequence or 0, drive.output_v, flags)
                    or (len(datagram) == 40 and int.from_bytes(datagram[32:36], "big") & CLOSED)
                    for datagram in datagrams
                    for flags in range(8)
                )
            driven, since = drive.output_v, now
        assert driven == 0.0 or now - since < HOLD_NS
