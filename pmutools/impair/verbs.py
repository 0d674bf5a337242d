"""The player's verbs, in a timeline and in live control, with their arguments as typed values.

::

    pause [SECONDS]    resume    step [FRAMES]    seek SECONDS|UTC    speed FACTOR    loop FROM TO | loop off

Times in seconds into the source, from when its first frame is due, or ISO-8601 UTC; FACTOR times real time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import NamedTuple

from pmutools.parsers import Place, duration_ns, integer, number, parse_place
from pmutools.timebase import NS

Value = int | Fraction | Place
Values = tuple[Value, ...]

_pause_ns = duration_ns(NS, 0.001)
_steps = integer(1, 1_000_000)
SPEEDS = (0.001, 1000.0)
"""Limits of a speed."""
SPEED_DENOMINATOR = 1_000_000
"""A speed is the nearest fraction with no greater one: deadlines are computed in 64 bits."""
_speed = number(*SPEEDS)


def speed(text: str) -> Fraction:
    """Source seconds per second, within :data:`SPEEDS`; raises ValueError."""
    _speed(text)
    return Fraction(text.strip()).limit_denominator(SPEED_DENOMINATOR)


def _pause(words: Sequence[str]) -> Values:
    return tuple(_pause_ns(word) for word in words)


def _step(words: Sequence[str]) -> Values:
    return (_steps(words[0]) if words else 1,)


def _seek(words: Sequence[str]) -> Values:
    return (parse_place(words[0], 0),)


def _factor(words: Sequence[str]) -> Values:
    return (speed(words[0]),)


def _loop(words: Sequence[str]) -> Values:
    if len(words) == 1:
        if words[0].lower() != "off":
            raise ValueError("a loop has two ends")
        return ()
    first, last = parse_place(words[0], 0), parse_place(words[1], 0)
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


_STILL = "stream time stands still in a pause, so it would never come; write 'pause SECONDS', which ends by itself"
PLAYER: dict[str, Verb] = {
    "pause": Verb("pause [SECONDS]", 0, 1, _pause),
    "resume": Verb("resume", 0, 0, _nothing, _STILL),
    "step": Verb("step [FRAMES]", 0, 1, _step, _STILL),
    "seek": Verb("seek SECONDS|UTC", 1, 1, _seek),
    "speed": Verb("speed FACTOR", 1, 1, _factor),
    "loop": Verb("loop FROM TO | loop off", 1, 2, _loop),
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
