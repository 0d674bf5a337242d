"""What the watchdog remembers, and how each piece of news changes it."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import Final, NamedTuple

from dcon.watchdog.codec import LOOPS, UNHEARD, WRAP, Beat, Command, Malformed, Readback, Word
from dcon.watchdog.limits import FULL_SCALE_V, MW_PER_V, REMEMBERED, TICK_MS, WINDOW_MS, Rules

MS: Final = 1_000_000
HALF: Final = WRAP // 2


class State(IntEnum):
    """OPEN and TRIPPED: the relays are open; TRIPPED is left by a reset only."""

    OPEN = 0
    CLOSED = 1
    TRIPPED = 2


class Contact(IntEnum):
    """What the contact of a relay shows; what cannot be read is UNKNOWN, and wrong whatever was ordered."""

    OPEN = 0
    CLOSED = 1
    UNKNOWN = 2


class Inputs(NamedTuple):
    """The input files, read in one go; None where there is none."""

    estop_a: bool | None = None
    """Line a is released."""
    estop_b: bool | None = None
    contact_a: Contact | None = None
    contact_b: Contact | None = None


class Driven(NamedTuple):
    """Whether the files that drive the relays could be written."""

    done: bool


Item = Beat | Command | Readback | Word | Malformed | Inputs | Driven


class Loop(NamedTuple):
    """The beats of one loop."""

    counter: int
    heard_ns: int
    advanced_ns: int
    """When the counter last changed."""
    state: int
    mark_ns: int
    """Where the window began that its advance is counted in."""
    moved: int = 0
    """Advance in this window."""
    per_s: float = 0.0
    """Advance in the window before."""


class Offences(NamedTuple):
    """How often something came that must not, with less than a window between one and the next."""

    times: int = 0
    last_ns: int = 0


class Worst(NamedTuple):
    """Of the commands of one round, by part."""

    volts: float
    mismatch_mw: float
    stamp_ms: float
    unasked_v: float


class Memory(NamedTuple):
    """All of it. ``sequence`` is of the next command to leave."""

    now_ns: int
    """When the last step was."""
    sequence: int = 0
    state: State = State.OPEN
    latched: int = 0
    """Causes of the trip, and those that rose since."""
    low_seen: bool = False
    """Relays were not asked for, since the start, the last reset, or a request that was refused."""
    late_ms: float = 0.0
    """How much later than a tick after the one before the last step came."""
    loops: tuple[Loop | None, ...] = (None,) * len(LOOPS)
    command: Command | None = None
    command_ns: int = 0
    worst: Worst = Worst(0.0, 0.0, 0.0, 0.0)
    malformed: Offences = Offences()
    disorder: Offences = Offences()
    readback_ns: int | None = None
    readbacks_off: int = 0
    """In a row."""
    sent: tuple[tuple[int, float], ...] = ()
    """(sequence, volts) of the last commands that left."""
    sent_ns: int | None = None
    told_ns: int | None = None
    estop: bool = False
    """By an operator's word."""
    inputs: Inputs | None = None
    differ_ns: int | None = None
    """Since when the lines of the emergency stop differ."""
    wrong_ns: tuple[int | None, int | None] = (None, None)
    """Since when each contact is not as ordered."""
    drive_failed: bool = False
    words: tuple[Word, ...] = ()
    """Of this step."""
    relay_b: bool = False
    """Relay a is closed in the state CLOSED; b is decided apart from it."""
    warned: int = 0
    """Causes of the warnings of the last step."""
    shown: tuple[int, ...] = ()
    """What was last told."""


def begun(now_ns: int, sequence: int, latched: int, estop: bool) -> Memory:
    """The memory of a watchdog that starts: tripped where it finds a latch, with its causes; else open. ``estop``: an
    operator's word was among them, and asks to be released as before."""
    return Memory(now_ns, sequence, State.TRIPPED if latched else State.OPEN, latched, estop=estop)


def beaten(last: Loop | None, beat: Beat, now_ns: int) -> Loop:
    """A loop after a beat. A counter that goes back counts as one that has gone nearly all the way round."""
    if last is None:
        return Loop(beat.counter, now_ns, now_ns, beat.state, now_ns)
    step = (beat.counter - last.counter) % WRAP
    moved = last.moved + step
    window_ms = (now_ns - last.mark_ns) / MS
    new = Loop(beat.counter, now_ns, now_ns if step else last.advanced_ns, beat.state, last.mark_ns, moved, last.per_s)
    if window_ms < WINDOW_MS:
        return new
    return new._replace(mark_ns=now_ns, moved=0, per_s=moved / window_ms * 1000)


def offended(offences: Offences, now_ns: int) -> Offences:
    """One more."""
    again = now_ns - offences.last_ns <= WINDOW_MS * MS
    return Offences(offences.times + 1 if again else 1, now_ns)


def worst_of(command: Command) -> Worst:
    """How far a single command is off."""
    volts, mismatch_mw = abs(command.volts), abs(command.mw - command.volts * MW_PER_V)
    return Worst(volts, mismatch_mw, abs(command.age_ms), 0.0 if command.relays else volts)


def commanded(memory: Memory, command: Command, now_ns: int) -> Memory:
    """A command came. It replaces the one before even where it is out of order: that opens the relays anyway."""
    last, worst, disorder = memory.command, worst_of(command), memory.disorder
    if last is not None:
        if memory.command_ns == now_ns:  # not the first of its round
            worst = Worst(*map(max, memory.worst, worst))
        if not 0 < (command.sequence - last.sequence) % WRAP < HALF:
            disorder = offended(disorder, now_ns)
    low_seen = memory.low_seen or not command.relays
    return memory._replace(command=command, command_ns=now_ns, worst=worst, disorder=disorder, low_seen=low_seen)


def answered(rules: Rules, memory: Memory, readback: Readback, now_ns: int) -> Memory:
    """A readback came; one that answers no remembered command is off."""
    wanted = dict(memory.sent).get(readback.sequence)
    within_v = rules.limits.readback_max_percent / 100 * FULL_SCALE_V
    good = wanted is not None and abs(readback.volts - wanted) <= within_v
    return memory._replace(readback_ns=now_ns, readbacks_off=0 if good else memory.readbacks_off + 1)


def _since(wrong: bool, before_ns: int | None, now_ns: int) -> int | None:
    return (now_ns if before_ns is None else before_ns) if wrong else None


def looked(memory: Memory, inputs: Inputs, now_ns: int) -> Memory:
    """The input files were read."""
    differ = None not in (inputs.estop_a, inputs.estop_b) and inputs.estop_a != inputs.estop_b
    ordered = Contact.CLOSED if memory.state is State.CLOSED else Contact.OPEN
    a, b = (
        _since(contact is not None and contact is not ordered, before_ns, now_ns)
        for contact, before_ns in zip((inputs.contact_a, inputs.contact_b), memory.wrong_ns, strict=True)
    )
    return memory._replace(inputs=inputs, differ_ns=_since(differ, memory.differ_ns, now_ns), wrong_ns=(a, b))


def spoken(memory: Memory, word: Word) -> Memory:
    """An operator's word. A reset is judged at the end of the step."""
    estop = {"estop": True, "estop_release": False}.get(word.verb, memory.estop)
    return memory._replace(estop=estop, words=(*memory.words, word))


def absorbed(rules: Rules, memory: Memory, news: Sequence[Item], now_ns: int) -> Memory:
    """The memory with all that is new, in order of arrival."""
    late_ms = (now_ns - memory.now_ns) / MS - TICK_MS
    memory = memory._replace(now_ns=now_ns, late_ms=late_ms, words=())
    for item in news:
        match item:
            case Beat():
                loops = list(memory.loops)
                loops[item.loop] = beaten(loops[item.loop], item, now_ns)
                memory = memory._replace(loops=tuple(loops))
            case Command():
                memory = commanded(memory, item, now_ns)
            case Readback():
                memory = answered(rules, memory, item, now_ns)
            case Word():
                memory = spoken(memory, item)
            case Malformed():
                memory = memory._replace(malformed=offended(memory.malformed, now_ns))
            case Inputs():
                memory = looked(memory, item, now_ns)
            case Driven():
                memory = memory._replace(drive_failed=not item.done)
    return memory


def ages_ms(memory: Memory, now_ns: int) -> tuple[int, ...]:
    """Of each loop's last beat, as a status tells them."""
    return tuple(UNHEARD if loop is None else min((now_ns - loop.heard_ns) // MS, UNHEARD - 1) for loop in memory.loops)


def forwarded(memory: Memory, volts: float, now_ns: int) -> Memory:
    """A command leaves."""
    sent = (*memory.sent[1 - REMEMBERED :], (memory.sequence, volts))
    return memory._replace(sequence=(memory.sequence + 1) % WRAP, sent=sent, sent_ns=now_ns)
