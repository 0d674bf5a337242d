"""Text to typed values: numbers, probabilities, durations, lists, calls such as ``normal(16, sd=2)``, dataclasses.

Parsers take text and raise ValueError("what is wrong; remedy"); who calls them adds where. A dataclass says how its
fields are read: ``gain: float = field(default=9.0, metadata=parsed_by(number(0, 15)))``; :func:`bind` fills it from a
call's arguments, :func:`pmutools.settings.fill` from a section of a file.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_right
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields
from decimal import Decimal, InvalidOperation
from difflib import get_close_matches
from typing import Any, NamedTuple, TypeVar

from pmutools.timebase import NS, parse_utc

T = TypeVar("T")
Parser = Callable[[str], T]


def suggestion(word: str, known: Iterable[str]) -> str:
    """The nearest known word, or all of them."""
    words = list(known)
    close = [known_ for known_ in words if known_.startswith(f"{word} ")] or get_close_matches(word, words, 1)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(words) or 'none'}"


NAMED_STREAMS = 20
"""More streams than these are not listed in a sentence."""


def no_such_stream(asked: object, there: Sequence[str]) -> str:
    """That what was asked for concerns no stream, and which there are."""
    names = ", ".join(there[:NAMED_STREAMS]) + (" ..." if len(there) > NAMED_STREAMS else "")
    return f"{asked}: no such stream; there are {names}"


def unique(names: Iterable[str], taken: Iterable[str] = ()) -> list[str]:
    """``names`` with ``#2``, ``#3`` ... after those that came before, or are ``taken``."""
    seen = set(taken)
    out = []
    for name in names:
        fresh, count = name, 1
        while fresh in seen:
            count += 1
            fresh = f"{name}#{count}"
        seen.add(fresh)
        out.append(fresh)
    return out


def number(low: float = -math.inf, high: float = math.inf) -> Parser[float]:
    """A parser of finite floats within ``low`` to ``high``, both allowed."""

    def parse(text: str) -> float:
        try:
            value = float(_ascii(text))
        except ValueError:
            raise ValueError(f"{text!r} is not a number") from None
        return _within(value, text, low, high)

    return parse


def integer(low: float = -math.inf, high: float = math.inf) -> Parser[int]:
    """A parser of whole numbers (decimal, or 0x hexadecimal) within ``low`` to ``high``, both allowed."""

    def parse(text: str) -> int:
        try:
            value = int(_ascii(text), 16 if text.strip().lower().startswith("0x") else 10)
        except ValueError:
            raise ValueError(f"{text!r} is not a whole number") from None
        return _within(value, text, low, high)

    return parse


N = TypeVar("N", int, float)


def _ascii(text: str) -> str:
    """``text``, unless it is one that Python only takes for a number: digits of other scripts, underscores."""
    if not text.isascii() or "_" in text:
        raise ValueError(text)
    return text


def _within(value: N, text: str, low: float, high: float) -> N:
    if not math.isfinite(value):
        raise ValueError(f"{text!r} is not a finite number")
    if not low <= value <= high:
        bounds = f"at least {low:g}" if high == math.inf else f"at most {high:g}" if low == -math.inf else ""
        raise ValueError(f"{text} is out of range; it must be {bounds or f'{low:g} to {high:g}'}")
    return value


def boolean(text: str) -> bool:
    words = {"yes": True, "true": True, "on": True, "1": True, "no": False, "false": False, "off": False, "0": False}
    if (value := words.get(text.strip().lower())) is None:
        raise ValueError(f"{text!r} is neither yes nor no")
    return value


def probability(text: str) -> float:
    """``5%`` or ``0.05``."""
    percent = text.strip().endswith("%")
    try:
        value = float(_ascii(text).strip().removesuffix("%")) / (100 if percent else 1)
    except ValueError:
        raise ValueError(f"{text!r} is not a probability; write 5% or 0.05") from None
    if not 0 <= value <= 1:
        remedy = f"did you mean {text.strip()}%?" if not percent and 1 < value <= 100 else "write 0% to 100%"
        raise ValueError(f"{text} is not a probability; {remedy}")
    return value


def choice(*allowed: str) -> Parser[str]:
    """A parser of one of ``allowed``, in any case."""

    def parse(text: str) -> str:
        if text.strip().lower() not in allowed:
            raise ValueError(f"{text!r} is not one of {', '.join(allowed)}")
        return text.strip().lower()

    return parse


def duration_ns(unit_ns: int, low: float = 0.0) -> Parser[int]:
    """A parser of a plain number of ``unit_ns`` (the key names the unit), not below ``low``, to exact nanoseconds."""

    def parse(text: str) -> int:
        try:
            value = Decimal(_ascii(text).strip())
        except (InvalidOperation, ValueError):
            raise ValueError(f"{text!r} is not a number") from None
        _within(float(value), text, low, math.inf)
        return round(value * unit_ns)

    return parse


seconds_ns = duration_ns(NS)
milliseconds_ns = duration_ns(NS // 1000)


_SPANS_NS = {"ms": NS // 1000, "s": NS, "min": 60 * NS, "h": 3600 * NS, "d": 86400 * NS}
_SIZES = {"kB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12, "KiB": 1 << 10, "MiB": 1 << 20, "GiB": 1 << 30}
_MEASURE = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*([A-Za-z]+)", re.ASCII)


def span_ns(text: str) -> int:
    """A span of time with its unit (``10s``, ``1.5min``, ``1h``) as nanoseconds, more than 0."""
    return _measured(text, _SPANS_NS, "a span of time; write as in 10s or 1.5h")


def size_bytes(text: str) -> int:
    """A size with its unit (``100MB``, ``1GiB``) as bytes, more than 0."""
    return _measured(text, _SIZES, "a size; write as in 100MB or 1GiB")


def span_or_size(text: str) -> tuple[int | None, int | None]:
    """:func:`span_ns` or :func:`size_bytes`, by the unit; the other is None."""
    value = _measured(text, _SIZES | _SPANS_NS, "a size or a span of time; write as in 100MB or 1h")
    return (None, value) if _unit(text) in {unit.lower() for unit in _SIZES} else (value, None)


def _measured(text: str, units: Mapping[str, int], what: str) -> int:
    match = _MEASURE.fullmatch(text.strip())
    factor = {unit.lower(): each for unit, each in units.items()}.get(_unit(text))
    if match is None or factor is None:
        raise ValueError(f"{text!r} is not {what} (units: {', '.join(units)})")
    if not (value := round(Decimal(match[1]) * factor)):
        raise ValueError(f"{text} is nothing; it must be more than 0")
    return value


def _unit(text: str) -> str:
    """The letters after a number, in lower case; empty where there is no such thing."""
    match = _MEASURE.fullmatch(text.strip())
    return "" if match is None else match[2].lower()


class Place(NamedTuple):
    """A time in a recording: ns into it (``relative``), or POSIX UTC.

    A window counts from the first stamp, the player from when its first frame is due.
    """

    ns: int
    relative: bool


def parse_place(text: str, low: float = -math.inf) -> Place:
    """``12.5`` (seconds into the recording, not below ``low``) or an ISO-8601 UTC time such as 2016-09-08T17:05:11Z."""
    try:
        if text.isascii() and Decimal(text.strip()).is_finite():
            return Place(duration_ns(NS, low)(text), relative=True)
    except InvalidOperation:
        pass
    try:
        return Place(parse_utc(text), relative=False)
    except ValueError:
        raise ValueError(
            f"{text!r} is no time; write seconds into the source (12.5) or UTC (2016-09-08T17:05:11Z)"
        ) from None


def words(text: str) -> tuple[str, ...]:
    """A comma list; empty items are errors."""
    return tuple(split_top(text)) if text.strip() else ()


def split_top(text: str, separator: str = ",") -> list[str]:
    """Split at separators outside parentheses; items trimmed. Raises ValueError for an empty item or odd brackets."""
    depth, start, items = 0, 0, list[str]()
    for at, character in enumerate(f"{text}{separator}"):
        depth += (character == "(") - (character == ")")
        if depth < 0:
            raise ValueError(f"{text!r} has a ')' without '('")
        if character == separator and (depth == 0 or at == len(text)):
            items.append(text[start:at].strip())
            start = at + 1
    if depth:
        raise ValueError(f"{text!r} has a '(' without ')'")
    if not all(items):
        raise ValueError(f"{text!r} has an empty item; remove the extra {separator!r}")
    return items


@dataclass(frozen=True, slots=True)
class Indices:
    """A set of whole numbers >= 0: inclusive ranges, sorted and apart, and (period, offset) of every nth."""

    starts: tuple[int, ...] = ()
    ends: tuple[float, ...] = ()
    every: tuple[tuple[int, int], ...] = ()

    def __contains__(self, index: int) -> bool:
        at = bisect_right(self.starts, index) - 1
        if at >= 0 and index <= self.ends[at]:
            return True
        return any(index >= offset and (index - offset) % period == 0 for period, offset in self.every)


_RANGE = re.compile(r"(\d+)(?:\s*-\s*(\d*))?", re.ASCII)
_EVERY = re.compile(r"every\s+(\d+)(?:\s+offset\s+(\d+))?", re.ASCII)


def indices(text: str) -> Indices:
    """LIST: ``10,50-59,every 100 offset 3``; ``50-`` has no end, ``every 100`` begins at 0."""
    return index_set(words(text))


def index_set(items: Collection[str]) -> Indices:
    """:func:`indices` of items already split."""
    ranges, every = list[tuple[int, float]](), list[tuple[int, int]]()
    for item in items:
        if match := _RANGE.fullmatch(item):
            first = int(match[1])
            last = first if match[2] is None else int(match[2]) if match[2] else math.inf
            if last < first:
                raise ValueError(f"{item!r} runs backwards; write the smaller index first")
            ranges.append((first, last))
        elif match := _EVERY.fullmatch(item.lower()):
            if not int(match[1]):
                raise ValueError(f"{item!r} has no period; write every 1 or more")
            every.append((int(match[1]), int(match[2] or 0)))
        else:
            raise ValueError(f"{item!r} is not an index, a range like 50-59, or 'every 100 offset 3'")
    merged = list[tuple[int, float]]()
    for first, last in sorted(ranges):
        if merged and first <= merged[-1][1] + 1:
            merged[-1] = (merged[-1][0], max(merged[-1][1], last))
        else:
            merged.append((first, last))
    return Indices(tuple(first for first, _ in merged), tuple(last for _, last in merged), tuple(every))


def parsed_by(parse: Parser[Any], *, rest: bool = False) -> Mapping[str, Any]:
    """Field metadata: the parser of its text. ``rest``: :func:`bind` gives it all further arguments, as a tuple."""
    return {"parse": parse, "rest": rest}


def settable(cls: Any) -> dict[str, Field[Any]]:
    return {item.name.rstrip("_"): item for item in fields(cls) if "parse" in item.metadata}


def is_optional(item: Field[Any]) -> bool:
    return item.default is not MISSING or item.default_factory is not MISSING


class Call(NamedTuple):
    """``name(a, b, key=c)`` taken apart; arguments are still text."""

    name: str
    args: tuple[str, ...] = ()
    named: Mapping[str, str] = {}


def bind(cls: type[T], call: Call) -> T:
    """An instance of the dataclass ``cls`` from a call's arguments, positional in the order of its fields.

    A call without a name stands for ``VALUE key=... key=...``. Raises ValueError naming the call and the parameter.
    """
    known = settable(cls)
    usage = f"{call.name}({', '.join(known)})" if call.name else _phrase_usage(known)
    texts: dict[str, Any] = {}
    for position, text in enumerate(call.args):
        slots = list(known.values())
        if slots and position >= len(slots) - 1 and slots[-1].metadata["rest"]:
            texts.setdefault(slots[-1].name, []).append(text)
        elif position < len(slots):
            texts[slots[position].name] = text
        else:
            raise ValueError(f"{len(call.args)} arguments are too many; write {usage}")
    for key, text in call.named.items():
        if key not in known:
            raise ValueError(
                f"{call.name or 'there'} {'has' if call.name else 'is'} no {key!r}; {suggestion(key, known)}"
            )
        if known[key].name in texts:
            raise ValueError(f"{key} is given twice; write {usage}")
        texts[known[key].name] = text
    values: dict[str, Any] = {}
    for key, item in known.items():
        if item.name in texts:
            values[item.name] = _argument(call, key, item, texts[item.name])
        elif not is_optional(item):
            raise ValueError(f"{key if call.name else 'the value'} is missing; write {usage}")
    return cls(**values)


def _phrase_usage(known: Collection[str]) -> str:
    return " ".join(["VALUE", *(f"[{key}=...]" for key in list(known)[1:])])


def _argument(call: Call, key: str, item: Field[Any], text: str | list[str]) -> Any:
    parse = item.metadata["parse"]
    try:
        if item.metadata["rest"]:
            return tuple(parse(one) for one in ([text] if isinstance(text, str) else text))
        return parse(text)
    except ValueError as error:
        place = f"{call.name} {key}: " if call.name else f"{key}: " if key in call.named else ""
        raise ValueError(f"{place}{error}") from None


_CALL = re.compile(r"([A-Za-z][\w-]*)\s*(?:\((.*)\))?", re.DOTALL)
_NAMED = re.compile(r"([A-Za-z]\w*)\s*=(.*)", re.DOTALL)


def call(text: str) -> Call:
    """``normal(16, sd=2)`` or a bare ``normal``, taken apart."""
    match = _CALL.fullmatch(text.strip())
    if match is None:
        raise ValueError(f"{text!r} is not of the form name(value, ...)")
    args, named = list[str](), dict[str, str]()
    for item in split_top(match[2]) if match[2] and match[2].strip() else ():
        if pair := _NAMED.fullmatch(item):
            if pair[1].lower() in named:
                raise ValueError(f"{match[1]}: {pair[1]} is given twice")
            named[pair[1].lower()] = pair[2].strip()
        elif named:
            raise ValueError(f"{match[1]}: {item!r} stands after a named value; put it before")
        else:
            args.append(item)
    return Call(match[1].lower(), tuple(args), named)


def one_of(models: Mapping[str, type[T]], what: str) -> Parser[T]:
    """A parser of calls whose name picks the dataclass."""

    def parse(text: str) -> T:
        parts = call(text)
        if parts.name not in models:
            raise ValueError(f"{parts.name!r} is no {what}; {suggestion(parts.name, models)}")
        return bind(models[parts.name], parts)

    return parse
