"""``--trigger``: what a recording is begun for, as text and as values. Judging them is :mod:`.watch`'s part.

::

    signal                     SIGUSR1 is sent to the reader
    key                        a key is pressed
    stat:trigger               a flag of STAT is set: see FLAGS
    freq<59.95   rocof>1       Hz, Hz/s
    mag<280e3                  V or A RMS, of any phasor
    |freq-60|>0.05  |rocof|>1  distance from a value
    N1.freq<59.95  N*.V1.mag<280e3  N1.stat:trigger     of these stations and channels only
    loss  loss>5               frames are missing (more than 5 in a row)
    silence>2s                 a stream has stopped
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

from pmutools.c37118.constants import STAT_DATA_ERROR_MASK, Stat
from pmutools.parsers import number, span_ns, suggestion, words

FLAGS = {
    "data-error": STAT_DATA_ERROR_MASK,
    **{
        flag.name.lower().replace("_", "-"): int(flag)
        for flag in Stat
        if flag.name and not int(flag) & STAT_DATA_ERROR_MASK
    },
}
"""Flags of STAT by name; ``data-error`` is either bit of the two."""
QUANTITIES = {
    "freq": "freq_hz",
    "freq_hz": "freq_hz",
    "rocof": "rocof_hz_s",
    "rocof_hz_s": "rocof_hz_s",
    "mag": "mag",
}
"""What is compared, by the name that is written."""
EXAMPLES = (
    "signal",
    "key",
    *(f"stat:{flag}" for flag in FLAGS),
    "freq<59.95",
    "rocof>1",
    "mag<1",
    "loss",
    "silence>2s",
)
UNITS = {"freq_hz": "Hz", "rocof_hz_s": "Hz/s", "mag": ""}


@dataclass(frozen=True)
class Manual:
    """A person or a program asks for it: ``signal`` or ``key``."""

    text: str


@dataclass(frozen=True)
class Flag:
    """Any bit of ``mask`` is set in the STAT of a station that fits ``where``."""

    text: str
    mask: int
    where: str = "*"


@dataclass(frozen=True)
class Limit:
    """A value of ``quantity`` (its distance from ``reference``, where there is one) is above or below ``limit``."""

    text: str
    quantity: str
    above: bool
    limit: float
    distance: bool = False
    reference: float = 0.0
    where: str = "*"


@dataclass(frozen=True)
class Gap:
    """More than ``frames`` frames of a stream are missing between two."""

    text: str
    frames: int = 0


@dataclass(frozen=True)
class Silence:
    """A stream that was there has brought nothing for ``span_ns``."""

    text: str
    span_ns: int


Condition = Manual | Flag | Limit | Gap | Silence

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_STAT = re.compile(r"(?:(?P<where>.+)\.)?stat:(?P<flag>[\w-]+)")
_GAP = re.compile(r"loss(?:\s*>\s*(?P<frames>\d+))?")
_SILENCE = re.compile(r"silence\s*>\s*(?P<span>.+)")
_DISTANCE = re.compile(
    rf"\|(?P<what>[^|<>]+?)(?:\s*-\s*(?P<reference>{_NUMBER}))?\|\s*(?P<sign>[<>])\s*(?P<limit>{_NUMBER})"
)
_LIMIT = re.compile(rf"(?P<what>[^|<>]+?)\s*(?P<sign>[<>])\s*(?P<limit>{_NUMBER})")


def parse_triggers(text: str) -> tuple[Condition, ...]:
    """A comma list of conditions. Raises ValueError for what is none, with what may be meant."""
    found = tuple(map(parse_condition, words(text)))
    if not found:
        raise ValueError("names no trigger; write as in signal,freq<59.95")
    return found


def parse_condition(text: str) -> Condition:
    """One condition."""
    text = text.strip()
    if text in ("signal", "key"):
        return Manual(text)
    for form, make in _FORMS:
        if match := form.fullmatch(text):
            return make(text, match)
    raise ValueError(f"{text!r} is no trigger; {suggestion(text, EXAMPLES)}")


def _flag(text: str, match: re.Match[str]) -> Condition:
    if match["flag"] not in FLAGS:
        raise ValueError(f"STAT has no flag {match['flag']!r}; {suggestion(match['flag'], FLAGS)}")
    return Flag(text, FLAGS[match["flag"]], match["where"] or "*")


def _gap(text: str, match: re.Match[str]) -> Condition:
    return Gap(text, int(match["frames"] or 0))


def _silence(text: str, match: re.Match[str]) -> Condition:
    return Silence(text, span_ns(match["span"]))


def _limit(text: str, match: re.Match[str]) -> Condition:
    where, _, name = match["what"].strip().rpartition(".")
    if name not in QUANTITIES:
        raise ValueError(f"{name!r} cannot be compared; {suggestion(name, ('freq', 'rocof', 'mag'))}")
    groups = match.groupdict()
    return Limit(
        text,
        QUANTITIES[name],
        match["sign"] == ">",
        number()(match["limit"]),
        text.startswith("|"),
        number()(groups.get("reference") or "0"),
        where or "*",
    )


_FORMS: tuple[tuple[re.Pattern[str], Callable[[str, re.Match[str]], Condition]], ...] = (
    (_STAT, _flag),
    (_GAP, _gap),
    (_SILENCE, _silence),
    (_DISTANCE, _limit),
    (_LIMIT, _limit),
)
