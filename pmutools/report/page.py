"""The shell of a report's page: one HTML file that loads nothing from anywhere, with plotly's JavaScript in it once.

Templates escape all that is put in; a content security policy names the page's own scripts by their hash, so that
nothing else runs even where an escape is missed, and nothing is fetched.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pmutools.errors import SettingsError, SourceError
from pmutools.formats.output import whole
from pmutools.report.figures import Figure
from pmutools.report.text import clean

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

FIGURES = "figures"
"""The folder of PNG and SVG files, beside the page."""
NEEDED = ("jinja2", "plotly", "matplotlib")
_PRINTED = str.maketrans({"<": "\\u003c", ">": "\\u003e", "&": "\\u0026", "\u2028": "\\u2028", "\u2029": "\\u2029"})


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table: its head, unit, the group that it stands under, and the term that explains it."""

    title: str
    unit: str = ""
    group: str = ""
    term: str = ""
    words: bool = False
    """Holds text, not numbers."""


@dataclass(frozen=True, slots=True)
class Cell:
    """What a cell shows, and what it is sorted by. ``tone`` is good, bad or quiet; ``href`` a place of this page."""

    text: str
    value: float | str | None = None
    tone: str = ""
    href: str = ""


@dataclass(frozen=True, slots=True)
class Row:
    """A line of a table, which links may point to."""

    cells: Sequence[Cell]
    anchor: str = ""


@dataclass(frozen=True, slots=True)
class Table:
    """``note`` stands below it. With ``tools`` a reader may sort and filter it."""

    name: str
    caption: str
    columns: Sequence[Column]
    rows: Sequence[Row] = field(default=())
    note: str = ""
    tools: bool = False

    @property
    def groups(self) -> list[tuple[str, int]]:
        """(name, number of columns) of the groups, from left to right; none where no column is in one."""
        found: list[tuple[str, int]] = []
        for column in self.columns:
            if found and found[-1][0] == column.group:
                found[-1] = column.group, found[-1][1] + 1
            else:
                found.append((column.group, 1))
        return found if any(name for name, _ in found) else []


def require_extra() -> None:
    """Raise SettingsError that says what to install, where a report cannot be made."""
    for name in NEEDED:
        try:
            import_module(name)
        except ImportError:
            raise SettingsError(
                f"a report needs {name}, which is not installed: pip install '.[analysis]' in a checkout brings it"
            ) from None


def render(template: str, figures: Sequence[Figure], told: Mapping[str, Any], package: str = "pmutools.report") -> str:
    """The page: ``template`` of ``package``, which extends ``page.html`` of this one, with ``told`` for its names."""
    environment = _environment(package)
    scripts = [_asset("page.js"), _plotly()]
    hashes = [f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" for text in scripts]
    policy = (
        f"default-src 'none'; script-src {' '.join(hashes)}; style-src 'unsafe-inline'; img-src data: blob:; "
        "base-uri 'none'; form-action 'none'"
    )
    by_name = {figure.name: figure for figure in figures}
    markup = _markup()
    return environment.get_template(template).render(
        told,
        figures=by_name,
        policy=policy,
        css=markup(_asset("page.css")),
        page_js=markup(scripts[0]),
        plotly_js=markup(scripts[1]),
    )


def write(path: Path, text: str) -> Path:
    """Write a page, whole or not at all. Raises SourceError."""
    try:
        with whole(path) as part:
            part.write_text(text, encoding="utf-8")
    except OSError as error:
        raise SourceError(f"{path}: cannot write: {error.strerror or error}") from None
    return path


def embedded(told: Any) -> Markup:
    """JSON for a script element: no text in it can end the element."""
    return _markup()(json.dumps(told, allow_nan=False, separators=(",", ":")).translate(_PRINTED))


def _embedded_figure(figure: Figure) -> Markup:
    from pmutools.report.plotly_figures import spec

    return embedded(spec(figure))


@cache
def _environment(package: str) -> Environment:
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=ChoiceLoader([PackageLoader(name) for name in dict.fromkeys((package, "pmutools.report"))]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: clean(value) if type(value) is str else value,
    )
    environment.filters["embedded"] = _embedded_figure
    environment.filters["sentence"] = lambda text: text[:1].upper() + text[1:]
    environment.globals["folder"] = FIGURES
    return environment


def _markup() -> type[Markup]:
    from markupsafe import Markup

    return Markup


def _asset(name: str) -> str:
    return files("pmutools.report").joinpath("templates", name).read_text(encoding="utf-8")


def _plotly() -> str:
    from plotly.offline import get_plotlyjs

    text: str = get_plotlyjs()
    if "</script" in text.lower():
        raise SettingsError("this plotly's JavaScript cannot be put into a page: install another version of plotly")
    return text.replace("\r\n", "\n")
