"""The segment stage: how a frame's bytes meet a TCP connection. ``segment = 1% split(parts=3, gap=5) when=10..``

The last stage; the first part that applies decides. Datagrams are always whole, so over UDP nothing comes of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from pmutools.draws import Draws
from pmutools.flow import Cut, Segmentation
from pmutools.impair.blocks import chance
from pmutools.impair.grammar import Chanced, named_parts, with_probability
from pmutools.impair.moment import Moment, Test
from pmutools.impair.outgoing import Outgoing
from pmutools.impair.selectors import DATA, Selector, selector
from pmutools.parsers import duration_ns, integer, milliseconds_ns, one_of, parsed_by

_MS_NS = 1_000_000
_some_milliseconds = duration_ns(_MS_NS, 1e-6)


class Kind(Protocol):
    """A way to write a frame."""

    @property
    def write(self) -> Segmentation: ...

    @property
    def mark(self) -> str: ...


@dataclass(frozen=True, slots=True)
class Split:
    """In ``parts`` writes, ``gap`` ms apart."""

    parts: int = field(default=2, metadata=parsed_by(integer(2, 1000)))
    gap: int = field(default=5 * _MS_NS, metadata=parsed_by(milliseconds_ns))

    @property
    def write(self) -> Segmentation:
        return Segmentation(Cut.SPLIT, self.parts, self.gap)

    @property
    def mark(self) -> str:
        return f"split{self.parts}x{self.gap / _MS_NS:.6g}ms"


@dataclass(frozen=True, slots=True)
class Coalesce:
    """Kept until ``frames`` frames are there, then all in one write."""

    frames: int = field(default=4, metadata=parsed_by(integer(2, 1000)))

    @property
    def write(self) -> Segmentation:
        return Segmentation(Cut.COALESCE, self.frames)

    @property
    def mark(self) -> str:
        return f"coalesce{self.frames}"


@dataclass(frozen=True, slots=True)
class Stall:
    """The connection writes nothing for ``time`` ms, then this frame and what came after."""

    time: int = field(default=200 * _MS_NS, metadata=parsed_by(_some_milliseconds))

    @property
    def write(self) -> Segmentation:
        return Segmentation(Cut.STALL, 0, self.time)

    @property
    def mark(self) -> str:
        return f"stall{self.time / _MS_NS:.6g}ms"


@dataclass(frozen=True, slots=True)
class Reset:
    """The first ``bytes`` of the frame (0: half of them), then RST."""

    bytes_: int = field(default=0, metadata=parsed_by(integer(0, 0xFFFF)))

    @property
    def write(self) -> Segmentation:
        return Segmentation(Cut.RESET, self.bytes_)

    @property
    def mark(self) -> str:
        return f"reset{self.bytes_ or ''}"


KINDS: dict[str, type[Kind]] = {"split": Split, "coalesce": Coalesce, "stall": Stall, "reset": Reset}
_chosen = with_probability(one_of(KINDS, "way to write"), "split(parts=2, gap=5)")


@dataclass(frozen=True, slots=True)
class Segment:
    chosen: Chanced[Kind] = field(metadata=parsed_by(_chosen))
    when: Selector = field(default=DATA, metadata=parsed_by(selector))


class _At(NamedTuple):
    write: Segmentation
    mark: str
    happens: Callable[[Moment], int]
    selected: Test


class Segmenting:
    """The segment stage of one stream."""

    def __init__(self, parts: Sequence[Segment], draws: Callable[[str], Draws]) -> None:
        self._parts = [
            _At(
                part.chosen.kind.write,
                f"segment:{part.chosen.kind.mark}",
                chance(draws(name), part.chosen.p),
                part.when.test(draws(f"{name}.when")),
            )
            for name, part in named_parts("segment", parts)
        ]

    def apply(self, outgoing: Outgoing, at: Moment) -> Outgoing:
        for write, mark, happens, selected in self._parts:
            if happens(at) and selected(at):
                return outgoing._replace(write=write, marks=(*outgoing.marks, mark))
        return outgoing
