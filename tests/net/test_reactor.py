"""The loop: timers in order and cancellable, virtual time that jumps, sockets forgotten while others are handled."""

from __future__ import annotations

import socket
from collections import Counter

from hypothesis import given, settings
from hypothesis import strategies as st

from pmutools.clock import VirtualClock
from pmutools.net.reactor import READ, WRITE, Reactor


@settings(deadline=None)
@given(st.lists(st.tuples(st.integers(0, 1000), st.booleans()), max_size=30))
def test_timers_ring_in_order_unless_cancelled(timers: list[tuple[int, bool]]) -> None:
    clock = VirtualClock()
    reactor = Reactor(clock)
    rung: list[tuple[int, int]] = []
    for number, (at_ns, cancelled) in enumerate(timers):
        timer = reactor.call_at(at_ns, lambda number=number, at_ns=at_ns: rung.append((at_ns, number)))  # type: ignore[misc]
        timer.cancelled = cancelled
    while clock.monotonic_ns() < 1000:
        reactor.run(1000 - clock.monotonic_ns())
    assert rung == sorted((at_ns, number) for number, (at_ns, cancelled) in enumerate(timers) if not cancelled)
    reactor.close()


def test_virtual_time_waits_for_no_socket() -> None:
    clock = VirtualClock()
    reactor = Reactor(clock)
    left, right = socket.socketpair()
    heard: list[int] = []
    reactor.watch(left, READ, lambda _: heard.append(clock.monotonic_ns()))
    reactor.run(5_000_000_000_000)
    assert (clock.monotonic_ns(), heard) == (5_000_000_000_000, [])
    right.send(b"x")
    reactor.run(1)
    assert heard == [5_000_000_000_000]
    assert clock.monotonic_ns() == 5_000_000_000_000
    reactor.close()
    left.close()
    right.close()


def test_a_socket_closed_by_another_handler_is_not_handled() -> None:
    reactor = Reactor(VirtualClock())
    pairs = [socket.socketpair() for _ in range(2)]
    called: list[int] = []

    def handle(number: int) -> None:
        called.append(number)
        for ours, _ in pairs:
            reactor.forget(ours)
            ours.close()

    for number, (ours, theirs) in enumerate(pairs):
        theirs.send(b"x")
        reactor.watch(ours, READ, lambda _, number=number: handle(number))  # type: ignore[misc]
    reactor.run(0)
    assert len(called) == 1
    reactor.forget(pairs[0][0])  # once more does no harm
    reactor.run(0)
    assert len(called) == 1
    reactor.close()
    for _, theirs in pairs:
        theirs.close()


def test_watching_again_replaces() -> None:
    reactor = Reactor(VirtualClock())
    left, right = socket.socketpair()
    heard: list[str] = []
    reactor.watch(left, READ | WRITE, lambda events: heard.append(f"first {events}"))
    reactor.run(0)
    reactor.watch(left, READ, lambda events: heard.append(f"second {events}"))
    right.send(b"x")
    reactor.run(0)
    assert heard == [f"first {WRITE}", f"second {READ}"]
    reactor.close()
    left.close()
    right.close()


class Slow(VirtualClock):
    """Each reading takes a millisecond, as if handlers took that long."""

    def monotonic_ns(self) -> int:
        self.advance(1_000_000)
        return super().monotonic_ns()


def test_beyond_its_budget_a_turn_leaves_sockets_to_the_next_and_each_has_its_turn() -> None:
    reactor = Reactor(Slow())
    pairs = [socket.socketpair() for _ in range(10)]
    called: list[int] = []
    for number, (ours, theirs) in enumerate(pairs):
        theirs.send(b"x")  # never read: all are ready all the time
        reactor.watch(ours, READ, lambda _, number=number: called.append(number))  # type: ignore[misc]
    turns = []
    for _ in range(10):
        before = len(called)
        reactor.run(0, 3_000_000)
        turns.append(len(called) - before)
    assert turns == [3] * 10
    assert set(Counter(called).values()) <= {2, 3, 4}
    reactor.run(0, 0)
    assert len(called) == 31  # one, whatever the budget
    for ours, _ in pairs[:5]:
        reactor.forget(ours)  # some of them owed their turn
    reactor.run(0)
    assert sorted(called[31:]) == [5, 6, 7, 8, 9]
    reactor.close()
    for pair in pairs:
        for sock in pair:
            sock.close()


def test_a_handler_that_left_off_is_called_again_without_news() -> None:
    reactor = Reactor(VirtualClock())
    left, right = socket.socketpair()
    heard: list[bytes] = []

    def handle(_events: int) -> None:
        heard.append(left.recv(1) if not heard else b"")
        if len(heard) < 3:
            reactor.again(left, READ)

    reactor.watch(left, READ, handle)
    right.send(b"x")
    for _ in range(5):
        reactor.run(10)
    assert heard == [b"x", b"", b""]
    reactor.close()
    left.close()
    right.close()
