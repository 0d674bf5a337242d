"""Tables of the network characterizer's pure core: diagnoses, limits, states, families of fits."""

from __future__ import annotations

from collections.abc import Callable

from generate.markdown import attribute_docs, code, prose, table
from pmutools.cli.clock_text import ADVICE
from pmutools.measure.clocks import BOUNDS
from pmutools.measure.diagnoses import ROWS
from pmutools.measure.fits import FAMILIES
from pmutools.measure.quality import Events
from pmutools.measure.require import METRICS
from pmutools.measure.uncertainty import STAMP_NS

UNITS = {"ms": "ms, us, s", "s": "s, ms, min, h", "share": "%, ppm, none", "count": "none"}


def diagnoses() -> str:
    """Symptoms by id."""
    return table(("id", "made when there are"), ((code(row.id), row.sign) for row in ROWS))


def limits() -> str:
    """What ``--require`` can limit; distributions once, with all their figures."""
    rows, figures = [], {}
    for name, metric in METRICS.items():
        what, colon, figure = metric.what.partition(": ")
        if colon and "lost frames" not in figure:
            stem = name.removesuffix(f"_{figure}")
            figures.setdefault((stem, what, metric.unit), []).append(figure)
        elif not colon:
            rows.append((code(name), metric.what, UNITS[metric.unit]))
    known = ", ".join(code(figure) for figure in next(iter(figures.values())))
    told = [(code(f"{stem}_FIGURE"), what, UNITS[unit]) for stem, what, unit in figures]
    told.append(
        (code("delay_FIGURE_expected"), "the same of all expected frames, lost ones infinitely late", UNITS["ms"])
    )
    return f"{table(('metric', 'what it is', 'units'), [*told, *rows])}\n\nFIGURE is one of {known}."


def stamps() -> str:
    """What an arrival stamp may be late by."""
    return table(("stamp", "bound"), ((code(source), f"{bound / 1000:g} µs") for source, bound in STAMP_NS.items()))


def events() -> str:
    """Counters that the receiver keeps."""
    told = attribute_docs(Events)
    return table(("counter", "what it counts"), ((code(name), told.get(name, "")) for name in vars(Events())))


def families() -> str:
    """Distributions that are fitted, simplest first."""
    return ", ".join(code(name) for name in FAMILIES)


def clocks() -> str:
    """Who is asked, and what bound follows."""
    return table(("asked in this order", "bound"), ((code(name), prose(bound)) for name, bound in BOUNDS.items()))


def advice() -> str:
    """What to do about a clock."""
    return table(("it is said that", "to do"), ((row.sign, row.text or "nothing") for row in ADVICE))


GENERATORS: dict[str, Callable[[], str]] = {
    "diagnoses": diagnoses,
    "limits": limits,
    "arrival-stamps": stamps,
    "measure-events": events,
    "fit-families": families,
    "clock-bounds": clocks,
    "clock-advice": advice,
}
