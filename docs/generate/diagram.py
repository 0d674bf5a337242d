"""Diagrams written in a small part of mermaid's language, as SVG: nothing is fetched, nothing runs in the browser.

Known are ``flowchart TB|LR`` with nodes ``a["text"]``, ``a[("store")]``, ``a(["outside"])``, links ``-->``, ``==>``,
``-- "text" -->``, ``== "text" ==>``, ``-. "text" .->`` in chains, one level of ``subgraph``; and ``stateDiagram-v2``
with ``A --> B: text`` and ``[*]``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Final

_NODE: Final = re.compile(r'\s*(\[\*\]|\w+)(\["(?P<box>.*?)"\]|\[\("(?P<store>.*?)"\)\]|\(\["(?P<outside>.*?)"\]\))?')
_LINK: Final = re.compile(r'\s*(?:(-->|==>)|(--|==|-\.)\s*"(.*?)"\s*(?:-->|==>|\.->))')
_STATE: Final = re.compile(r"\s*(\[\*\]|\w+) --> (\[\*\]|\w+)(?:: (.*))?$")
_GROUP: Final = re.compile(r'\s*subgraph (\w+)\["(.*)"\]$')
_WRAP: Final = 26
"""Letters of a line of a transition's text."""


@dataclass
class Node:
    lines: list[str]
    kind: str = "box"
    """box, store, outside, state or start."""
    group: str = ""


@dataclass(frozen=True)
class Edge:
    source: str
    target: str
    lines: tuple[str, ...] = ()
    look: str = "-"
    """``-``, ``=`` thick, ``.`` dotted."""


@dataclass
class Diagram:
    across: bool = False
    """From left to right instead of downwards."""
    begun: bool = False
    """Begins at the first node: what cannot be reached from there is led back from."""
    nodes: dict[str, Node] = field(default_factory=dict)
    edges: list[Edge] = field(default_factory=list)
    groups: dict[str, str] = field(default_factory=dict)
    """Titles by name; an edge may begin or end at a group."""


def parse(text: str) -> Diagram:
    """Raises ValueError for a line that is not of the known part."""
    head, *lines = (line for line in text.splitlines() if line.strip())
    if head.strip() == "stateDiagram-v2":
        return _states(lines)
    if not re.fullmatch(r"flowchart (TB|LR)", head.strip()):
        raise ValueError(f"no diagram that is known: {head}")
    made, group = Diagram(across=head.endswith("LR")), ""
    for line in lines:
        if opened := _GROUP.match(line):
            group = opened[1]
            made.groups[group] = opened[2]
            made.nodes.pop(group, None)  # it has been linked to before it was opened
        elif line.strip() == "end":
            group = ""
        else:
            _chain(made, line, group)
    return made


def _chain(made: Diagram, line: str, group: str) -> None:
    at, before, link = 0, "", None
    while at < len(line):
        if (found := _NODE.match(line, at)) is None:
            raise ValueError(f"not understood: {line.strip()}")
        name, kind = found[1], next((kind for kind in ("box", "store", "outside") if found[kind] is not None), None)
        if kind is not None:
            made.nodes[name] = Node(found[kind].split("<br>"), kind, group)
        elif name not in made.nodes and name not in made.groups:
            made.nodes[name] = Node([name], "box", group)
        if link is not None:
            look = (link[1] or link[2])[1]
            made.edges.append(Edge(before, name, tuple((link[3] or "").split("<br>")) if link[3] else (), look))
        before, at = name, found.end()
        if not line[at:].strip():
            return
        if (link := _LINK.match(line, at)) is None:
            raise ValueError(f"not understood: {line.strip()}")
        at = link.end()


def _states(lines: list[str]) -> Diagram:
    made = Diagram(begun=True)
    for line in lines:
        if line.strip().startswith("direction "):
            made.across = line.strip().endswith("LR")
            continue
        if (found := _STATE.match(line)) is None:
            raise ValueError(f"not understood: {line.strip()}")
        for name in found.group(1, 2):
            made.nodes.setdefault(name, Node([""], "start") if name == "[*]" else Node([name], "state"))
        words = [part for text in (found[3] or "").split("<br>") for part in _wrapped(text)]
        if found[1] == found[2]:
            words = [part for line in words for part in re.split(r"(?<=/) ", line)]
        made.edges.append(Edge(found[1], found[2], tuple(words)))
    return made


def _wrapped(text: str) -> list[str]:
    lines = [""]
    for part in re.split(r"(?<=,) ", text):
        if lines[-1] and len(lines[-1]) + len(part) > _WRAP:
            lines.append("")
        lines[-1] += (" " if lines[-1] else "") + part
    return [line for line in lines if line]
