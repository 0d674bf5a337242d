"""A diagram, laid out, as SVG that stands in the page itself and takes the page's colours and letters."""

from __future__ import annotations

import re
import zlib
from collections import defaultdict
from html import escape

from generate.diagram import Diagram, Edge, parse
from generate.layout import LINE, Item, Layout, Way, width

_FENCE = re.compile(r"^```mermaid\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_EDGE = 10.0
"""Around all."""
_SMALL = 0.86
"""Size of texts of edges, against those of nodes."""
_LOOP = 32.0
"""Width of the loop of a state that leads to itself."""
Point = tuple[float, float]


def drawn(markdown: str) -> str:
    """``markdown`` with every diagram as SVG."""
    return _FENCE.sub(lambda found: f'<div class="diagram">{svg(parse(found[1]))}</div>', markdown)


def laid_out(diagram: Diagram) -> Layout:
    """The layout of a diagram; a group that edges lead to has an item ``<NAME`` before it, ``>NAME`` behind it."""
    layout = Layout(begun=diagram.begun)

    def item(name: str, lines: list[str] | tuple[str, ...], across: float, along: float, scale: float = 1.0) -> Item:
        wide = max(map(width, lines)) * scale + across
        high = len(lines) * LINE * scale + along
        return Item(name, high, wide) if diagram.across else Item(name, wide, high)

    ends = {edge.target for edge in diagram.edges} & set(diagram.groups)
    begins = {edge.source for edge in diagram.edges} & set(diagram.groups)
    for name, node in diagram.nodes.items():
        made = Item(name, 14, 14) if node.kind == "start" else item(name, node.lines, 26, 16)
        if loops := [edge for edge in diagram.edges if edge.source == edge.target == name]:
            if diagram.across:
                raise ValueError(f"{name} leads to itself: that is drawn from top to bottom only")
            made.breadth += 2 * (_LOOP + max(width(line) for edge in loops for line in edge.lines) * _SMALL)
        made.group = node.group
        layout.nodes[name] = made
    for group in diagram.groups:
        members = [name for name, node in diagram.nodes.items() if node.group == group]
        if group in ends:
            layout.nodes["<" + group] = Item("<" + group, group=group)
            layout.unseen += [("<" + group, name) for name in members]
        if group in begins:
            layout.nodes[">" + group] = Item(">" + group, group=group)
            layout.unseen += [(name, ">" + group) for name in members]
    for edge in _between(diagram):
        source = ">" + edge.source if edge.source in diagram.groups else edge.source
        target = "<" + edge.target if edge.target in diagram.groups else edge.target
        layout.edges.append((source, target, item("", edge.lines, 10, 4, _SMALL) if edge.lines else None))
    layout.place()
    return layout


def _between(diagram: Diagram) -> list[Edge]:
    return [edge for edge in diagram.edges if edge.source != edge.target]


def svg(diagram: Diagram) -> str:
    """One line of SVG."""
    layout = laid_out(diagram)

    def point(at: float, depth: float) -> Point:
        x, y = (depth, at) if diagram.across else (at, depth)
        return x + _EDGE, y + _EDGE

    parts: list[str] = []
    texts: list[str] = []
    corners: list[Point] = []
    for group, (low, high, near, far) in layout.boxes.items():
        a, b = point(low, near), point(high, far)
        b = (max(b[0], a[0] + width(diagram.groups[group]) + 20), b[1])
        corners += [a, b]
        parts.append(_rect(a, b, 6, "group"))
        texts.append(_text((a[0] + 10, a[1] + 15), [diagram.groups[group]], "title"))
    ports = _ports(layout)
    for way, edge in zip(layout.ways, _between(diagram), strict=True):
        points = [point(*place) for place in _course(layout, way, ports)]
        parts.append(_path(points, edge, diagram.across))
        corners += points
        if way.text is not None:
            middle = point(way.text.at, layout.depths[way.text.rank])
            wide, high = _size(way.text, diagram.across)
            a, b = (middle[0] - wide / 2, middle[1] - high / 2), (middle[0] + wide / 2, middle[1] + high / 2)
            corners += [a, b]
            texts += [_rect(a, b, 3, "behind"), _text(middle, edge.lines, "edge")]
    parts += texts
    for name, node in diagram.nodes.items():
        item = layout.nodes[name]
        middle = point(item.at, layout.depths[item.rank])
        wide, high = _size(item, diagram.across)
        a, b = (middle[0] - wide / 2, middle[1] - high / 2), (middle[0] + wide / 2, middle[1] + high / 2)
        corners += [a, b]
        if loops := [edge for edge in diagram.edges if edge.source == edge.target == name]:
            half = (max(map(width, node.lines)) + 26) / 2
            a, b = (middle[0] - half, a[1]), (middle[0] + half, b[1])
            parts.append(_loop(b[0], middle[1], loops))
        if node.kind == "start":
            parts.append(f'<circle class="start" cx="{middle[0]:.1f}" cy="{middle[1]:.1f}" r="7"/>')
            continue
        radius = {"state": 9.0, "outside": high / 2, "store": 3.0}.get(node.kind, 3.0)
        parts.append(_rect(a, b, radius, node.kind))
        if node.kind == "store":
            parts += [_line((x, a[1]), (x, b[1])) for x in (a[0] + 5, b[0] - 5)]
        parts.append(_text(middle, node.lines, "node"))
    wide, high = (max(corner[axis] for corner in corners) + _EDGE for axis in (0, 1))
    words = escape(", ".join(" ".join(node.lines) for node in diagram.nodes.values() if node.lines[0]), quote=True)
    made = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide:.0f} {high:.0f}" width="{wide:.0f}" '
        f'role="img" aria-label="Diagram of {words}">{_ARROW}{"".join(parts)}</svg>'
    )
    return made.replace("ARROW", f"arrow-{zlib.crc32(made.encode()):08x}")  # one page has several


_ARROW = (
    '<defs><marker id="ARROW" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="9" markerHeight="9" '
    'markerUnits="userSpaceOnUse" orient="auto-start-reverse"><path class="head" d="M0,1 L10,5 L0,9 z"/>'
    "</marker></defs>"
)


def _size(item: Item, across: bool) -> Point:
    return (item.depth, item.breadth) if across else (item.breadth, item.depth)


def _ports(layout: Layout) -> dict[tuple[int, int], float]:
    """Where each way leaves (``0``) and reaches (``-1``) its node: side by side, in the order of where they go."""
    meeting = defaultdict[tuple[Item, bool], list[tuple[float, int, int]]](list)
    for number, way in enumerate(layout.ways):
        for end, near in ((0, 1), (-1, -2)):
            node, after = way.items[end], way.items[near]
            meeting[node, after.rank > node.rank].append((after.at, number, end))
    found = {}
    for (node, _), ways in meeting.items():
        step = min(16.0, 0.7 * node.breadth / len(ways))
        for place, (_, number, end) in enumerate(sorted(ways)):
            found[number, end] = node.at + (place - (len(ways) - 1) / 2) * step
    return found


def _course(layout: Layout, way: Way, ports: dict[tuple[int, int], float]) -> list[Point]:
    """(across, along) of each point of a way, from border to border."""
    number = next(place for place, other in enumerate(layout.ways) if other is way)
    points = [(item.at, layout.depths[item.rank]) for item in way.items]
    for end, near in ((0, 1), (-1, -2)):
        node, down = way.items[end], way.items[near].rank > way.items[end].rank
        depth = layout.depths[node.rank]
        if node.name.startswith(("<", ">")):
            _, _, first, last = layout.boxes[node.group]
            points[end] = (ports[number, end], first if node.name[0] == "<" else last)
        else:
            points[end] = (ports[number, end], depth + (1 if down else -1) * node.depth / 2)
    return points


def _path(points: list[Point], edge: Edge, across: bool) -> str:
    """A smooth line through ``points`` (Catmull and Rom, 1974) that leaves and arrives at right angles."""
    slopes = [(c[0] - a[0], c[1] - a[1]) for a, c in zip(points, points[2:], strict=False)]
    first, last = (
        (1.6 * (b[0] - a[0]), 0.0) if across else (0.0, 1.6 * (b[1] - a[1]))
        for a, b in ((points[0], points[1]), (points[-2], points[-1]))
    )
    slopes = [first, *((x / 2, y / 2) for x, y in slopes), last]
    d = "M{:.1f},{:.1f}".format(*points[0])
    for (x, y), (nx, ny), (dx, dy), (ex, ey) in zip(points, points[1:], slopes, slopes[1:], strict=False):
        d += f" C{x + dx / 3:.1f},{y + dy / 3:.1f} {nx - ex / 3:.1f},{ny - ey / 3:.1f} {nx:.1f},{ny:.1f}"
    look = {"=": " thick", ".": " dotted"}.get(edge.look, "")
    return f'<path class="way{look}" d="{d}" marker-end="url(#ARROW)"/>'


def _loop(x: float, y: float, edges: list[Edge]) -> str:
    """Back into the right side of a node; all that lead there have one loop."""
    far = x + _LOOP - 6
    way = '<path class="way" d="'
    way += f'M{x:.1f},{y - 8:.1f} C{far:.1f},{y - 16:.1f} {far:.1f},{y + 16:.1f} {x:.1f},{y + 8:.1f}"'
    lines = [line for edge in edges for line in edge.lines]
    return f'{way} marker-end="url(#ARROW)"/>' + _text((x + _LOOP - 8, y), lines, "loop")


def _rect(a: Point, b: Point, radius: float, kind: str) -> str:
    return (
        f'<rect class="{kind}" x="{a[0]:.1f}" y="{a[1]:.1f}" width="{b[0] - a[0]:.1f}" height="{b[1] - a[1]:.1f}" '
        f'rx="{radius:g}"/>'
    )


def _line(a: Point, b: Point) -> str:
    return f'<path class="bar" d="M{a[0]:.1f},{a[1]:.1f} L{b[0]:.1f},{b[1]:.1f}"/>'


def _text(middle: Point, lines: list[str] | tuple[str, ...], kind: str) -> str:
    step = LINE * (_SMALL if kind in ("edge", "loop") else 1.0)
    first = middle[1] - (len(lines) - 1) / 2 * step + 4.5
    return "".join(
        f'<text class="{kind}" x="{middle[0]:.1f}" y="{first + k * step:.1f}">{escape(line)}</text>'
        for k, line in enumerate(lines)
    )
