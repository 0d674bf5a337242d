"""The form of an option's value, the same on the command line, in a profile and in live control.

::

    VALUE  HEAD [KEY=WORDS]...      normal(16,2) corr=30% when=type data and 5..8
           none                     nothing: switches off what was set before

The head is the first field of the stage's dataclass, each KEY another of its fields.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Generic, NamedTuple, TypeVar

from pmutools.parsers import Call, Parser, bind, probability

T = TypeVar("T")

_KEY = re.compile(r"(?:^|(?<=\s))([a-z_]+)=(?!=)")


def phrase(text: str) -> Call:
    """A value taken apart; a ``KEY=`` inside parentheses belongs to the head."""
    depth, depths = 0, list[int]()
    for character in text:
        depth += (character == "(") - (character == ")")
        depths.append(depth)
    keys = [match for match in _KEY.finditer(text) if depths[match.start()] == 0]
    ends = [match.start() for match in keys[1:]] + [len(text)]
    named = dict[str, str]()
    for match, end in zip(keys, ends, strict=False):
        if match[1] in named:
            raise ValueError(f"{match[1]}= is given twice")
        named[match[1]] = text[match.end() : end].strip()
    head = text[: keys[0].start() if keys else None].strip()
    return Call("", (head,) if head else (), named)


def parse_stage(cls: type[T], text: str) -> T:
    """A stage's dataclass from its value; raises ValueError."""
    return bind(cls, phrase(text))


class Chanced(NamedTuple, Generic[T]):
    """What is done, and how likely it is for a frame."""

    p: float
    kind: T


def with_probability(kind: Parser[T], example: str, alone: T | None = None) -> Parser[Chanced[T]]:
    """A parser of ``[P%] KIND(...)``: every frame where no probability is given, ``alone`` where no kind is."""

    def parse(text: str) -> Chanced[T]:
        head, _, rest = text.partition(" ")
        if head[:1] not in "0123456789.":
            return Chanced(1.0, kind(text))
        if rest.strip():
            return Chanced(probability(head), kind(rest))
        if alone is None:
            raise ValueError(f"{text}: write what is done, as in {head} {example}")
        return Chanced(probability(head), alone)

    return parse


def named_parts(option: str, parts: Sequence[T]) -> Iterator[tuple[str, T]]:
    """An option's parts, each with the name that keys its draws: one that is added leaves those before it alone."""
    return ((f"{option}.{number}" if number else option, part) for number, part in enumerate(parts))
