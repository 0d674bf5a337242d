"""Restarts come later and later, and soon again once a process has stayed."""

from __future__ import annotations

from itertools import pairwise

from dcon.household.backoff import FIRST_S, LONGEST_S, STAYED_S, Backoff


def waits(*ran_s: float) -> list[float]:
    now, found = Backoff(), []
    for ran in ran_s:
        now, wait_s = now.ended(ran)
        found.append(wait_s)
    return found


def test_the_wait_doubles_up_to_its_limit() -> None:
    found = waits(*[0.0] * 2000)
    assert found[0] == FIRST_S and found[-1] == LONGEST_S
    assert all(b == min(2 * a, LONGEST_S) for a, b in pairwise(found))


def test_one_that_stayed_is_started_again_soon() -> None:
    assert waits(0, 0, 0, STAYED_S) == [FIRST_S, 2 * FIRST_S, 4 * FIRST_S, FIRST_S]
    assert waits(0, 0, STAYED_S - 0.1)[-1] == 4 * FIRST_S
