"""A page as a browser's parser sees it: elements, what they point to, and whether all that was opened is closed."""

from __future__ import annotations

from dataclasses import dataclass, field
from html.parser import HTMLParser

VOID = frozenset(("area", "base", "br", "col", "embed", "hr", "img", "input", "link", "meta", "source", "track", "wbr"))
LOADS = {"src", "srcset", "action", "formaction", "poster", "data", "background", "cite", "manifest", "ping"}
"""Attributes that make a browser fetch something, besides ``href``."""


@dataclass
class Element:
    """An element with its attributes and the text right inside it."""

    tag: str
    attributes: dict[str, str]
    text: str = ""
    inside: list[Element] = field(default_factory=list)

    def find(self, tag: str, **attributes: str) -> list[Element]:
        """All within, in order."""
        found = []
        for each in self.inside:
            if each.tag == tag and all(each.attributes.get(key) == value for key, value in attributes.items()):
                found.append(each)
            found += each.find(tag, **attributes)
        return found

    def words(self) -> str:
        """All text within, scripts and styles apart."""
        parts = [self.text, *(each.words() for each in self.inside if each.tag not in ("script", "style"))]
        return " ".join(" ".join(parts).split())


class _Parser(HTMLParser):
    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.open = [Element("", {})]
        self.wrong: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        names = [name for name, _ in attrs]
        if len(set(names)) != len(names):
            self.wrong.append(f"<{tag}> has an attribute twice: {names}")
        element = Element(tag, {name: value or "" for name, value in attrs})
        self.open[-1].inside.append(element)
        if tag not in VOID:
            self.open.append(element)

    def handle_endtag(self, tag: str) -> None:
        if self.open[-1].tag == tag and tag:
            self.open.pop()
        else:
            self.wrong.append(f"</{tag}> closes <{self.open[-1].tag}> at {self.getpos()}")

    def handle_data(self, data: str) -> None:
        self.open[-1].text += data


def parsed(text: str) -> Element:
    """The page; fails where it is not balanced."""
    parser = _Parser()
    parser.feed(text)
    parser.close()
    assert not parser.wrong, parser.wrong[:5]
    assert len(parser.open) == 1, [element.tag for element in parser.open]
    return parser.open[0]


def references(page: Element) -> list[str]:
    """All that the page points to or would fetch."""
    found = []
    for element in everything(page):
        found += [value for name, value in element.attributes.items() if name == "href" or name in LOADS]
    return found


def everything(page: Element) -> list[Element]:
    """All elements."""
    return [page, *(each for inner in page.inside for each in everything(inner))]
