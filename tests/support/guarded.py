"""A watchdog in virtual time: its core stepped each 10 ms with the news that a healthy platform sends, or another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dcon.watchdog.codec import LOOPS, RUNNING, Beat, Command, Word
from dcon.watchdog.core import Decision, Event, step
from dcon.watchdog.limits import Limits, Rules
from dcon.watchdog.memory import MS, Driven, Inputs, Item, Memory, State
from dcon.watchdog.rules import names_of

T0_NS = 5_000_000_000
TICK_NS = 10 * MS
RELEASED = Inputs(True, True)
RULES = Rules()


class Bench:
    """Steps one watchdog. ``volts`` and ``relays`` are what the controller commands from now on."""

    def __init__(self, rules: Rules = RULES, inputs: Inputs = RELEASED) -> None:
        self.rules, self.inputs = rules, inputs
        self.now_ns = T0_NS
        self.memory = Memory(self.now_ns)
        self.counter, self.sequence = 0, 0
        self.relays, self.volts = False, 0.0
        self.decision: Decision | None = None
        self.events: list[Event] = []
        self.left: list[tuple[int, float]] = []

    def command(self, **changed: Any) -> Command:
        """The next command."""
        self.sequence += 1
        volts = changed.pop("volts", self.volts)
        usual = Command(self.sequence, self.now_ns, volts * 12.5, volts, self.relays, 1.0)
        return usual._replace(**changed)

    def beats(self, leave_out: Sequence[str] = (), state: int = RUNNING) -> list[Item]:
        """A beat of each loop that must beat, with a counter that has gone on."""
        self.counter += 1
        return [Beat(LOOPS.index(name), self.counter, state) for name in self.rules.beats if name not in leave_out]

    def usual(self, leave_out: Sequence[str] = ()) -> list[Item]:
        """What a healthy platform sends in 10 ms; ``leave_out`` takes loops, ``command`` and ``inputs``."""
        news = self.beats(leave_out)
        news += [] if "command" in leave_out else [self.command()]
        news += [] if "inputs" in leave_out else [self.inputs]
        return [*news, Driven(True)]

    def tick(self, *more: Item, leave_out: Sequence[str] = (), after_ns: int = TICK_NS) -> Decision:
        """The usual news and ``more``, ``after_ns`` after the last."""
        self.now_ns += after_ns
        return self.only(*self.usual(leave_out), *more, after_ns=0)

    def only(self, *news: Item, after_ns: int = TICK_NS) -> Decision:
        """This news and no other."""
        self.now_ns += after_ns
        self.memory, decision = step(self.rules, self.memory, news, self.now_ns)
        self.decision = decision
        self.events += decision.events
        if decision.forward is not None:
            self.left.append((decision.forward.flags, decision.forward.volts))
        return decision

    def closed(self, volts: float = 0.0) -> Bench:
        """Brought to CLOSED, at ``volts``."""
        self.tick()
        self.relays = True
        assert self.tick().state is State.CLOSED, self.causes
        self.volts = volts
        self.tick()
        return self

    def reset(self, who: str = "op") -> Decision:
        """The operator's word, with the usual news."""
        return self.tick(Word("reset", who))

    @property
    def state(self) -> State:
        return self.memory.state

    @property
    def causes(self) -> tuple[str, ...]:
        return names_of(0 if self.decision is None else self.decision.causes)

    @property
    def named(self) -> list[str]:
        """Events so far, by name."""
        return [event.name for event in self.events]


def with_limits(**changed: float) -> Rules:
    """The usual rules with other limits."""
    return RULES._replace(limits=Limits(**changed))
