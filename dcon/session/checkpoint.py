"""Checkpoints: what the engine remembered before a tick, now and then, so that a replay can begin anew behind a gap.

The memory is written as its values are nested, in the order of their fields, as JSON: a float as the shortest decimal
that gives its eight bytes back, -0.0 and infinities too, any NaN as NaN. How it is nested is worked out from the types,
and so is :data:`LAYOUT`, which a checkpoint carries: one of another layout is passed over.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from enum import Enum
from functools import cache
from itertools import repeat
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from dcon.core.rows import CORE
from dcon.engine import Memory
from pmutools.schema.descriptors import message_class

EVERY_S = 5
"""Between two: what a replay may miss behind a gap. A memory of eight PMUs is 10 kB, 4 compressed: 1 % of the log."""
MOST_BYTES = 64 << 10
"""Of a memory; a larger one is not logged, so that a tick takes few bundles."""


def is_due(tick: int, tick_hz: int) -> bool:
    """Whether the tick of that number in its session, from 0, is logged with a checkpoint."""
    return tick % (EVERY_S * tick_hz) == 0


def encode_checkpoint(tick_ns: int, memory: Memory) -> bytes | None:
    """``/dcon/checkpoint`` of the tick that came next; None where it would be too large."""
    text = text_of(memory)
    if len(text) > MOST_BYTES:
        return None
    return bytes(message_class("Checkpoint")(tick_ns=tick_ns, layout=LAYOUT, memory=text).SerializeToString())


def text_of(memory: Memory) -> str:
    """The same for the same memory, to the last bit, and for no other."""
    state = [list(value.items()) if isinstance(value, Mapping) else value for value in memory.state]
    return _JSON.encode((state, *memory[1:]))


def decode_checkpoint(message: Any | None) -> Memory | None:
    """None where there is none, it is of another layout, or makes no sense."""
    if message is None or message.layout != LAYOUT:
        return None
    try:
        memory: Memory = _made(Memory, json.loads(message.memory))
    except (ValueError, TypeError, RecursionError):
        return None
    return memory


def _pair(value: object) -> list[float]:
    if isinstance(value, complex):
        return [value.real, value.imag]
    raise TypeError(f"{type(value).__name__} in a controller's memory")


_JSON = json.JSONEncoder(separators=(",", ":"), default=_pair)
_PLAIN: dict[Any, tuple[type, ...]] = {int: (int,), float: (float, int), str: (str,), bool: (bool,)}
"""What a value of each type may be: an int where a float is meant stays one."""
_hints = cache(get_type_hints)


def _made(kind: Any, value: Any) -> Any:
    """``value``, as it comes from JSON, as a ``kind``; raises ValueError or TypeError where it is none."""
    origin, args = get_origin(kind), get_args(kind)
    if kind in _PLAIN:
        if not isinstance(value, _PLAIN[kind]) or isinstance(value, bool) is not (kind is bool):
            raise ValueError(f"{value!r} is no {kind.__name__}")
        return value
    if origin in (Union, UnionType):
        return None if value is None else _made(_given(args), value)
    if isinstance(kind, type) and issubclass(kind, Enum):
        return kind(value)
    if not isinstance(value, list):
        raise ValueError(f"{value!r} is no list")
    if kind is complex:
        real, imag = value
        return complex(_made(float, real), _made(float, imag))
    if origin is tuple:
        return tuple(map(_made, *_paired(args, value)))
    if origin is Mapping:
        return {_made(args[0], key): _made(args[1], each) for key, each in value}
    return kind(*map(_made, *_paired(tuple(_hints(kind).values()), value)))


def _paired(kinds: tuple[Any, ...], values: list[Any]) -> tuple[Any, list[Any]]:
    if kinds[1:] == (Ellipsis,):
        return repeat(kinds[0]), values
    if len(kinds) != len(values):
        raise ValueError(f"{len(values)} values for {len(kinds)} fields")
    return kinds, values


def _given(args: tuple[Any, ...]) -> Any:
    """What an optional value is where there is one."""
    (kind,) = (each for each in args if each is not NoneType)
    return kind


def _described(kind: Any) -> str:
    """How a ``kind`` is nested, in words: names of fields and types."""
    origin, args = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return f"{_described(_given(args))}?"
    if args:
        return f"({' '.join('...' if each is Ellipsis else _described(each) for each in args)})"
    if issubclass(kind, tuple):
        return f"({' '.join(f'{name}:{_described(each)}' for name, each in _hints(kind).items())})"
    return "str" if issubclass(kind, Enum) else str(kind.__name__)


def _layout(kind: Any, checks: Sequence[str]) -> str:
    return hashlib.sha256(" ".join((_described(kind), *checks)).encode()).hexdigest()[:16]


LAYOUT = _layout(Memory, CORE.names)
"""Of this program's memory: the fields, and the checks whose bits are in them."""
