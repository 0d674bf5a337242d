"""``--split``: when a numbered recording ends, as text and as a value."""

from __future__ import annotations

from dataclasses import dataclass

from pmutools.parsers import span_or_size, words


@dataclass(frozen=True)
class Split:
    """When a recording ends and the next one begins, whichever comes first."""

    nbytes: int | None = None
    """As soon as it has so many bytes on the disk."""
    span_ns: int | None = None
    """At multiples of this of UTC."""


def parse_split(text: str) -> Split:
    """``100MB``, ``1h``, or both with a comma between. Raises ValueError for others."""
    parts = [span_or_size(word) for word in words(text)]
    spans = [span for span, _ in parts if span is not None]
    sizes = [size for _, size in parts if size is not None]
    if not parts or len(spans) > 1 or len(sizes) > 1:
        raise ValueError(f"{text!r} is not a size, a span of time, or one of each; write as in 100MB or 100MB,1h")
    return Split(sizes[0] if sizes else None, spans[0] if spans else None)
