"""``--fields``: which columns of a table, in which order."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from fnmatch import fnmatchcase

from pmutools.parsers import words

NAMED_COLUMNS = 8
"""More columns than these are not listed in a sentence."""


@dataclass(frozen=True)
class Fields:
    """Names of columns, or patterns with ``*``, ``?`` and ``[...]``, in the order wanted; ``time`` is ``time_ns``."""

    items: tuple[str, ...]

    def chosen(self, names: Sequence[str]) -> tuple[str, ...]:
        """Those of ``names`` that are wanted: item after item, each once."""
        known = frozenset(names)
        found: dict[str, None] = {}
        for item in self.items:
            found |= dict.fromkeys(_matching(item, names, known))
        return tuple(found)

    def unknown(self, names: Iterable[str]) -> tuple[str, ...]:
        """The items that fit none of ``names``."""
        listed = list(names)
        known = frozenset(listed)
        return tuple(item for item in self.items if not any(_matching(item, listed, known)))

    @property
    def of_frames_only(self) -> bool:
        """Whether nothing but columns of the frame itself is named."""
        from pmutools.formats.columns import FRAME_COLUMNS  # with numpy, and an option is read before sockets are bound

        return all(item in FRAME_COLUMNS for item in self.items)


def parse_fields(text: str) -> Fields:
    """``time,*.freq_hz,N1.V1.*``. Raises ValueError for an empty list or item."""
    items = words(text)
    if not items:
        raise ValueError("names no column; write as in time,*.freq_hz")
    return Fields(tuple("time_ns" if item == "time" else item for item in items))


def no_such_column(item: str, names: Collection[str]) -> str:
    """That no column fits an item, and which come near it."""
    from pmutools.formats.columns import FRAME_COLUMNS

    near = get_close_matches(item, names, 3, 0.5)
    if near:
        return f"no column fits {item!r}; did you mean {' or '.join(map(repr, near))}?"
    some = [name for name in names if name not in FRAME_COLUMNS] or list(names)
    listed = ", ".join(some[:NAMED_COLUMNS]) + (" ..." if len(some) > NAMED_COLUMNS else "")
    return f"no column fits {item!r}; there are {listed}"


def _matching(item: str, names: Sequence[str], known: frozenset[str]) -> Iterable[str]:
    if item in known:  # names may hold brackets
        return (item,)
    return (name for name in names if fnmatchcase(name, item))
