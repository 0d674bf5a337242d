"""Small pieces of Markdown, and docstrings turned into it."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterable, Sequence

_ROLE = re.compile(r":\w+:`~?(?:[\w.]*\.)?(\w+)`")
_LITERAL = re.compile(r"``([^`]+)``")


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A pipe table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(_cell(value) for value in line) + " |" for line in lines)


def _cell(value: object) -> str:
    """One line; a bar within inline code parts no cells."""
    parts = " ".join(str(value).split()).split("`")
    parts[::2] = [part.replace("|", "\\|") for part in parts[::2]]
    return "`".join(parts)


def code(text: object) -> str:
    """``text`` as inline code; nothing for nothing."""
    return f"`{text}`" if str(text) else ""


def prose(docstring: str | None) -> str:
    """A docstring as one line of Markdown; asterisks and angle brackets of formulas stay what they are."""
    text = _LITERAL.sub(r"`\1`", _ROLE.sub(r"`\1`", " ".join((docstring or "").split())))
    parts = text.split("`")
    parts[::2] = [part.replace("*", "\\*").replace("<", "&lt;") for part in parts[::2]]
    return "`".join(parts)


def first_sentence(docstring: str | None) -> str:
    """The docstring's first paragraph, without the full stop."""
    return prose((docstring or "").strip().split("\n\n")[0]).rstrip(".:")


def attribute_docs(cls: type) -> dict[str, str]:
    """The string below each attribute of a class, by attribute: Python itself does not keep them."""
    body = ast.parse(inspect.getsource(cls)).body[0]
    assert isinstance(body, ast.ClassDef)
    found: dict[str, str] = {}
    for statement, follower in zip(body.body, body.body[1:], strict=False):
        if isinstance(follower, ast.Expr) and isinstance(follower.value, ast.Constant):
            names = [statement.target] if isinstance(statement, ast.AnnAssign) else getattr(statement, "targets", [])
            found |= {name.id: prose(str(follower.value.value)) for name in names if isinstance(name, ast.Name)}
    return found


def mermaid(lines: Iterable[str]) -> str:
    """A mermaid diagram."""
    return "\n".join(("```mermaid", *lines, "```"))


def fenced(text: str, language: str = "text") -> str:
    """A code block."""
    return f"```{language}\n{text.strip()}\n```"
