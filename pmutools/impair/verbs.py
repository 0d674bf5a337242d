"""The player's verbs, in a timeline and in live control, with their arguments as typed values.

::

    pause [S]    resume    step [N]    seek T    speed X    loop A B | loop off    stats

S in seconds; T, A and B in seconds into the source, or ISO-8601 UTC; X times real time, 0.001 to 1000.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from decimal import Decimal, InvalidOperation
from fractions import Fraction
from typing import NamedTuple

from pmutools.parsers import duration_ns, integer, number, seconds_ns
from pmutools.timebase import NS, parse_utc


class Place(NamedTuple):
    """A time in the source: ns from its first stamp (``relative``), or POSIX UTC."""

    ns: int
    relative: bool


Value = int | Fraction | Place
Values = tuple[Value, ...]


def place(text: str) -> Place:
    """``12.5`` (seconds into the source) or ``2016-09-08T17:05:11Z``; raises ValueError."""
    try:
        Decimal(text)
    except InvalidOperation:
        pass
    else:
        return Place(seconds_ns(text), relative=True)
    try:
        return Place(parse_utc(text), relative=False)
    except ValueError:
        raise ValueError(
            f"{text!r} is no time; write seconds into the source (12.5) or UTC (2016-09-08T17:05:11Z)"
        ) from None


_pause_ns = duration_ns(NS, 0.001)
_steps = integer(1, 1_000_000)
_speed = number(0.001, 1000)


def _pause(words: Sequence[str]) -> Values:
    return tuple(_pause_ns(word) for word in words)


def _step(words: Sequence[str]) -> Values:
    return (_steps(words[0]) if words else 1,)


def _seek(words: Sequence[str]) -> Values:
    return (place(words[0]),)


def _factor(words: Sequence[str]) -> Values:
    _speed(words[0])
    return (Fraction(words[0]).limit_denominator(SPEED_DENOMINATOR),)


def _loop(words: Sequence[str]) -> Values:
    if len(words) == 1:
        if words[0].lower() != "off":
            raise ValueError("a loop has two ends")
        return ()
    first, last = place(words[0]), place(words[1])
    if first.relative is last.relative and last.ns <= first.ns:
        raise ValueError(f"{words[0]} {words[1]} runs backwards")
    return first, last


def _nothing(words: Sequence[str]) -> Values:
    return ()


class Verb(NamedTuple):
    """How a verb is written, how many words may follow it, and how they are read."""

    usage: str
    least: int
    most: int
    read: Callable[[Sequence[str]], Values]
    unscheduled: str = ""
    """Why a timeline cannot have it."""


SPEED_DENOMINATOR = 1_000_000
"""A speed is the nearest fraction with no greater one: deadlines are computed in 64 bits."""
_STILL = "stream time stands still in a pause, so it would never come; write 'pause SECONDS', which ends by itself"
PLAYER: dict[str, Verb] = {
    "pause": Verb("pause [SECONDS]", 0, 1, _pause),
    "resume": Verb("resume", 0, 0, _nothing, _STILL),
    "step": Verb("step [FRAMES]", 0, 1, _step, _STILL),
    "seek": Verb("seek SECONDS|UTC", 1, 1, _seek),
    "speed": Verb("speed FACTOR", 1, 1, _factor),
    "loop": Verb("loop FROM TO | loop off", 1, 2, _loop),
    "stats": Verb("stats", 0, 0, _nothing, "it answers whoever asks; the ledger and the summary tell what was done"),
}


def player_values(verb: str, text: str) -> Values:
    """The arguments of one of :data:`PLAYER`; raises ValueError.

    pause: () or (ns,). step: (frames,). seek: (Place,). speed: (Fraction,). loop: (Place, Place), or () for off.
    """
    usage, least, most, read, _ = PLAYER[verb]
    words = text.split()
    if not least <= len(words) <= most:
        raise ValueError(f"{verb} {text}".rstrip() + f": write '{usage}'")
    try:
        return read(words)
    except ValueError as error:
        raise ValueError(f"{verb}: {error}; write '{usage}'") from None


def refuse_unscheduled(verb: str, values: Values) -> None:
    """Raise ValueError for a player's verb that a timeline cannot have, saying why."""
    if why := PLAYER[verb].unscheduled:
        raise ValueError(f"{verb} cannot be scheduled: {why}")
    if verb == "pause" and not values:
        raise ValueError("pause for how long? stream time stands still meanwhile; write 'pause SECONDS'")
