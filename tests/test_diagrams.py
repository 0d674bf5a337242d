"""Diagrams of the documentation: all that is written is drawn, nothing on top of another, nothing fetched."""

from __future__ import annotations

import re
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

DOCS = Path(__file__).parents[1] / "docs"
sys.path.insert(0, str(DOCS))
from generate import GENERATORS  # noqa: E402
from generate.diagram import Diagram, Edge, Node, parse  # noqa: E402
from generate.drawing import drawn, laid_out, svg  # noqa: E402
from generate.layout import Layout  # noqa: E402
from hooks import on_page_markdown  # noqa: E402

_FENCE = re.compile(r"^```mermaid\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def written() -> Iterator[tuple[str, str]]:
    for path in sorted(DOCS.glob("*.md")):
        for number, text in enumerate(_FENCE.findall(path.read_text(encoding="utf-8"))):
            yield f"{path.stem}-{number}", text
    for name, generate in GENERATORS.items():
        if name.endswith("diagram") or "-diagram-" in name:
            yield name, _FENCE.findall(generate())[0]


WRITTEN = dict(written())
Box = tuple[float, float, float, float]


def boxes(layout: Layout) -> list[Box]:
    """Of all nodes and texts of edges: from and to across, from and to along."""
    items = [*layout.nodes.values(), *(way.text for way in layout.ways if way.text is not None)]
    depth = layout.depths
    return [
        (
            *(item.at - item.breadth / 2, item.at + item.breadth / 2),
            *(depth[item.rank] - item.depth / 2, depth[item.rank] + item.depth / 2),
        )
        for item in items
        if item.breadth
    ]


def apart(a: Box, b: Box) -> bool:
    return a[1] <= b[0] + 0.01 or b[1] <= a[0] + 0.01 or a[3] <= b[2] + 0.01 or b[3] <= a[2] + 0.01


def hold(diagram: Diagram) -> None:
    """Whether a layout is sound."""
    layout = laid_out(diagram)
    for a, b in combinations(boxes(layout), 2):
        assert apart(a, b)
    for group, box in layout.boxes.items():
        for name, node in diagram.nodes.items():
            item = layout.nodes[name]
            inside = box[0] <= item.at <= box[1] and box[2] <= layout.depths[item.rank] <= box[3]
            assert inside == (node.group == group), name


def test_there_are_diagrams() -> None:
    assert len(WRITTEN) >= 10


@pytest.mark.parametrize("name", WRITTEN)
def test_all_that_is_written_is_drawn(name: str) -> None:
    diagram = parse(WRITTEN[name])
    root = ET.fromstring(svg(diagram))
    texts = [element.text for element in root.iter("{http://www.w3.org/2000/svg}text")]
    wanted = [line for node in diagram.nodes.values() for line in node.lines if line]
    wanted += [*diagram.groups.values(), *(line for edge in diagram.edges for line in edge.lines)]
    assert sorted(map(str, texts)) == sorted(wanted)
    ways = [element for element in root.iter("{http://www.w3.org/2000/svg}path") if "marker-end" in element.attrib]
    loops = {edge.source for edge in diagram.edges if edge.source == edge.target}
    assert len(ways) == sum(edge.source != edge.target for edge in diagram.edges) + len(loops)
    width, height = map(float, root.attrib["viewBox"].split()[2:])
    for element in root.iter("{http://www.w3.org/2000/svg}rect"):
        x, y, wide, high = (float(element.attrib[key]) for key in ("x", "y", "width", "height"))
        assert x >= 0 and y >= 0 and x + wide <= width and y + high <= height


@pytest.mark.parametrize("name", WRITTEN)
def test_nothing_lies_on_another(name: str) -> None:
    hold(parse(WRITTEN[name]))


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 9), st.data(), st.booleans())
def test_any_diagram_is_laid_out(count: int, data: st.DataObject, across: bool) -> None:
    names = [f"n{k}" for k in range(count)]
    ends = st.tuples(st.sampled_from(names), st.sampled_from(names)).filter(lambda pair: pair[0] != pair[1])
    pairs = data.draw(st.lists(ends, min_size=1, max_size=14))
    diagram = Diagram(across=across)
    diagram.nodes = {name: Node([name * 3]) for name in names}
    diagram.edges = [Edge(a, b, ("text",) if k % 2 else ()) for k, (a, b) in enumerate(pairs)]
    layout = laid_out(diagram)
    for a, b in combinations(boxes(layout), 2):
        assert apart(a, b)
    ET.fromstring(svg(diagram))


def test_pages_hold_drawings_and_fetch_nothing() -> None:
    for page in ("architecture", "dcon", "demo", "c37118"):
        text = on_page_markdown((DOCS / f"{page}.md").read_text(encoding="utf-8"))
        assert "<svg" in text and "```mermaid" not in text
    assert "mermaid" not in (DOCS.parent / "mkdocs.yml").read_text(encoding="utf-8")


@pytest.mark.parametrize("text", ["pie\n", "flowchart TB\n    a -?-> b\n", "stateDiagram-v2\n    A -> B\n"])
def test_what_is_not_known_is_said(text: str) -> None:
    with pytest.raises(ValueError, match=r"known|understood"):
        drawn(f"```mermaid\n{text}```\n")
