"""Where the nodes of a diagram go, layer by layer (Sugiyama, Tagawa and Toda, 1981), and the ways of its edges.

Edges that lead back are turned round; nodes get ranks; an edge over several ranks is a chain of points, and its text a
node of that chain. Then the nodes of each rank are put in order, and moved towards their neighbours.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

LETTER, CAPITAL, LINE = 7.0, 8.8, 17.0
"""Width of letters, height of a line of text, px."""
GAP, STEP, TEXT_STEP = 26.0, 17.0, 26.0
"""Between neighbours of a rank, and between half ranks without texts and with them."""
TITLE, PAD = 32.0, 14.0
"""Room inside a group: above, where its title is, and at the other sides."""
SWEEPS = 24


def width(line: str) -> float:
    """About what a line takes, px."""
    return sum(CAPITAL if letter.isupper() else LETTER for letter in line)


@dataclass
class Item:
    """A node, a point of an edge, or one side of a group in a rank. ``breadth`` is across the ranks' direction."""

    name: str
    breadth: float = 0.0
    depth: float = 0.0
    rank: int = 0
    group: str = ""
    side: int = 0
    """-1 and 1 of a group's borders."""
    at: float = 0.0
    """Middle, in the direction of ``breadth``."""
    links: list[tuple[Item, float]] = field(default_factory=list, repr=False)
    """Neighbours and how strongly each pulls."""

    def __hash__(self) -> int:
        return id(self)


@dataclass
class Way:
    """An edge: its items from source to target, and the one that has its text."""

    items: list[Item]
    text: Item | None
    turned: bool


class Layout:
    """Fill ``nodes`` (in their order) and :meth:`edge`, then call :meth:`place`."""

    def __init__(self, *, begun: bool = False) -> None:
        self.begun = begun
        """Whether all ways begin at the first node."""
        self.nodes: dict[str, Item] = {}
        self.edges: list[tuple[str, str, Item | None]] = []
        self.unseen: list[tuple[str, str]] = []
        """Pairs of which the first comes before the second, without an edge."""
        self.ways: list[Way] = []
        self.ranks: list[list[Item]] = []
        self.depths: list[float] = []
        """Middle of each rank."""
        self.boxes: dict[str, tuple[float, float, float, float]] = {}
        """Of each group: from and to across, from and to along."""

    def place(self) -> None:
        turned = self._turned()
        pairs = [(b, a) if k in turned else (a, b) for k, (a, b, _) in enumerate(self.edges)]
        self._rank(pairs)
        self.ranks = [[] for _ in range(1 + max(item.rank for item in self.nodes.values()))]
        for item in self.nodes.values():
            self.ranks[item.rank].append(item)
        for k, (a, b) in enumerate(pairs):
            self.ways.append(self._way(a, b, self.edges[k][2], k in turned))
        self._borders()
        self._order()
        self._move()
        self._deepen()

    def _turned(self) -> set[int]:
        """Edges that lead back to where the way came from."""
        out = defaultdict[str, list[tuple[int, str]]](list)
        for k, (a, b, _) in enumerate(self.edges):
            out[a].append((k, b))
        found: set[int] = set()
        state: dict[str, int] = {}

        def visit(name: str) -> None:
            state[name] = 1
            for k, after in out[name]:
                if state.get(after) == 1:
                    found.add(k)
                elif after not in state:
                    visit(after)
            state[name] = 2

        for name in self.nodes:
            if name not in state:
                if state and self.begun:
                    found.update(k for k, _ in out[name])
                visit(name)
        return found

    def _rank(self, pairs: list[tuple[str, str]]) -> None:
        """Even ranks for nodes, so that an odd one is free for every text; sources as far down as they can be."""
        both = [*pairs, *self.unseen]
        for _ in self.nodes:
            for a, b in both:
                self.nodes[b].rank = max(self.nodes[b].rank, self.nodes[a].rank + 2)
        for _ in self.nodes:
            for name, item in self.nodes.items():
                after = [self.nodes[b].rank for a, b in both if a == name]
                before = [a for a, b in both if b == name]
                if after and len(after) > len(before):
                    item.rank = max(item.rank, min(after) - 2)

    def _way(self, a: str, b: str, text: Item | None, turned: bool) -> Way:
        first, last = self.nodes[a], self.nodes[b]
        group = first.group if first.group == last.group else ""
        chain = [first]
        middle = first.rank + 1 + 2 * ((last.rank - first.rank - 2) // 4)
        for rank in range(first.rank + 1, last.rank):
            point = text if text is not None and rank == middle else Item("", 6.0)
            point.rank, point.group = rank, group
            self.ranks[rank].append(point)
            chain.append(point)
        chain.append(last)
        for one, other in pairwise(chain):
            weight = 1.0 if one.name and other.name else 2.0 if one.name or other.name else 8.0
            one.links.append((other, weight))
            other.links.append((one, weight))
        return Way(chain[::-1] if turned else chain, text, turned)

    def _borders(self) -> None:
        groups = dict.fromkeys(item.group for item in self.nodes.values() if item.group)
        for group in groups:
            of = [item.rank for item in self.nodes.values() if item.group == group]
            for side in (-1, 1):
                before: Item | None = None
                for rank in range(min(of), max(of) + 1):
                    border = Item("", PAD, 0.0, rank, group, side)
                    self.ranks[rank].append(border)
                    if before is not None:
                        border.links.append((before, 40.0))
                        before.links.append((border, 40.0))
                    before = border

    def _order(self) -> None:
        best, fewest = [list(rank) for rank in self.ranks], None
        for sweep in range(SWEEPS):
            down = sweep % 2 == 0
            numbers = range(len(self.ranks)) if down else range(len(self.ranks) - 1, -1, -1)
            for number in numbers:
                self._sort(number, -1 if down else 1)
            crossings = sum(self._crossings(number) for number in range(len(self.ranks) - 1))
            if fewest is None or crossings < fewest:
                best, fewest = [list(rank) for rank in self.ranks], crossings
        self.ranks = best

    def _sort(self, number: int, towards: int) -> None:
        rank = self.ranks[number]
        places = (
            {item: place for place, item in enumerate(self.ranks[number + towards])}
            if (0 <= number + towards < len(self.ranks))
            else {}
        )
        wanted = {}
        for place, item in enumerate(rank):
            near = [places[other] for other, _ in item.links if other in places]
            wanted[item] = sum(near) / len(near) if near else float(place)
        groups = defaultdict[str, list[float]](list)
        for item in rank:
            if item.group and not item.side:
                groups[item.group].append(wanted[item])
        for item in rank:
            if item.group and item.side and not groups[item.group]:
                groups[item.group].append(wanted[item])
        mean = {group: sum(found) / len(found) for group, found in groups.items() if found}
        rank.sort(
            key=lambda item: (
                mean.get(item.group, 0.0) if item.group else wanted[item],
                item.group,
                item.side,
                wanted[item],
            )
        )

    def _crossings(self, number: int) -> int:
        places = {item: place for place, item in enumerate(self.ranks[number + 1])}
        ends = [
            (place, places[other])
            for place, item in enumerate(self.ranks[number])
            for other, _ in item.links
            if other in places and not item.side
        ]
        return sum((a - c) * (b - d) < 0 for k, (a, b) in enumerate(ends) for c, d in ends[:k])

    def _move(self) -> None:
        for rank in self.ranks:
            at = 0.0
            for item in rank:
                item.at = at + item.breadth / 2
                at += item.breadth + _gap(item)
        for sweep in range(60):
            for rank in self.ranks if sweep % 2 else self.ranks[::-1]:
                _settle(rank)
        self._part()
        least = min(item.at - item.breadth / 2 for rank in self.ranks for item in rank)
        for rank in self.ranks:
            for item in rank:
                item.at -= least

    def _part(self) -> None:
        """Borders of a group become straight, and what is beside it stays out of it."""
        for group in dict.fromkeys(item.group for item in self.nodes.values() if item.group):
            sides = [item for rank in self.ranks for item in rank if item.group == group and item.side]
            low, high = min(item.at for item in sides), max(item.at for item in sides)
            for rank in self.ranks:
                at = [place for place, item in enumerate(rank) if item.group == group and item.side]
                if not at:
                    continue
                rank[at[0]].at, rank[at[1]].at = low, high
                for way, edge in ((-1, at[0]), (1, at[1])):
                    before = rank[edge]
                    for item in rank[edge + way :: way] if 0 <= edge + way < len(rank) else ():
                        least = before.at + way * ((before.breadth + item.breadth) / 2 + GAP * 0.5)
                        item.at = max(item.at, least) if way > 0 else min(item.at, least)
                        before = item

    def _deepen(self) -> None:
        groups = {item.group for item in self.nodes.values() if item.group}
        spans = {
            group: (min(ranks), max(ranks))
            for group in groups
            if (ranks := [item.rank for item in self.nodes.values() if item.group == group])
        }
        step = TEXT_STEP if any(text for _, _, text in self.edges) else STEP
        at, thick = 0.0, [max((item.depth for item in rank), default=0.0) for rank in self.ranks]
        for number, depth in enumerate(thick):
            if number:
                at += step + (TITLE if any(first == number for first, _ in spans.values()) else 0.0)
                at += PAD if any(last == number - 1 for _, last in spans.values()) else 0.0
            elif any(first == 0 for first, _ in spans.values()):
                at += TITLE
            self.depths.append(at + depth / 2)
            at += depth
        for group, (first, last) in spans.items():
            sides = [item for rank in self.ranks for item in rank if item.group == group and item.side]
            self.boxes[group] = (
                min(item.at for item in sides),
                max(item.at for item in sides),
                self.depths[first] - thick[first] / 2 - TITLE,
                self.depths[last] + thick[last] / 2 + PAD,
            )


def _gap(item: Item) -> float:
    return GAP if item.name else GAP * 0.6


def _settle(rank: list[Item]) -> None:
    """Each item to the weighted mean of its neighbours, as near as its own rank lets it: pooled violators."""
    offset, blocks = 0.0, list[list[float]]()
    offsets = []
    for place, item in enumerate(rank):
        if place:
            before = rank[place - 1]
            offset += (before.breadth + item.breadth) / 2 + max(_gap(before), _gap(item)) * (0.5 if item.side else 1.0)
        offsets.append(offset)
        weight = sum(pull for _, pull in item.links) or 0.01
        wanted = sum(other.at * pull for other, pull in item.links) / weight if item.links else item.at
        blocks.append([wanted - offset, weight, 1])
        while len(blocks) > 1 and blocks[-2][0] > blocks[-1][0]:
            value, heavy, many = blocks.pop()
            last = blocks[-1]
            last[0] = (last[0] * last[1] + value * heavy) / (last[1] + heavy)
            last[1] += heavy
            last[2] += many
    values = _spread(blocks)
    for item, value, shift in zip(rank, values, offsets, strict=True):
        item.at = value + shift


def _spread(blocks: list[list[float]]) -> Iterator[float]:
    for value, _, many in blocks:
        for _ in range(int(many)):
            yield value
