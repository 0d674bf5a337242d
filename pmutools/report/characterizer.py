"""The report of a measured run: ``report.html``, which works offline, and its figures as PNG and SVG."""

from __future__ import annotations

import platform
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pmutools
from pmutools.errors import SourceError
from pmutools.measure.run import Run
from pmutools.report import account_tables, page, run_tables, stream_tables
from pmutools.report.course_figures import course_figure
from pmutools.report.definitions import TERMS
from pmutools.report.distribution_figures import distribution_figure, interarrival_figure, tail_figure
from pmutools.report.figures import Figure
from pmutools.report.findings import findings, headline, main_findings
from pmutools.report.remedies import REMEDIES
from pmutools.report.run_figures import run_figures
from pmutools.report.text import NONE, count, lasting, listed, milliseconds, percent, plural, span, utc
from pmutools.report.view import RULE, Stream, View

PAGE = "report.html"


@dataclass(frozen=True)
class Section:
    """What a stream's own part of the page is made from."""

    stream: Stream
    facts: list[tuple[str, str]]
    figures: list[Figure]
    small: list[page.Table]
    """Beside the last figure."""
    wide: list[page.Table]


def write_report(run: Run, out: Path) -> list[Path]:
    """Write ``report.html`` and ``figures/`` to the folder ``out``; the paths of what was written.

    Takes some seconds: the number of figures is bounded, however many streams there are. Raises SettingsError where the
    extra ``analysis`` is not installed, SourceError where nothing can be written.
    """
    page.require_extra()
    from pmutools.report.matplotlib_figures import save

    folder = out / page.FIGURES
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SourceError(f"{folder}: cannot make this folder: {error.strerror or error}") from None
    text, figures = compose(run)
    written = [page.write(out / PAGE, text)]
    try:
        return written + [path for figure in figures for path in save(figure, folder)]
    except OSError as error:
        raise SourceError(f"{folder}: cannot write figures: {error.strerror or error}") from None


def compose(run: Run) -> tuple[str, list[Figure]]:
    """The page, and all figures on it."""
    view = View(run)
    sections = [section(view, stream) for stream in view.detailed]
    figures = [*run_figures(view), *(figure for part in sections for figure in part.figures)]
    return page.render("characterizer.html", figures, told(view, sections)), figures


def section(view: View, stream: Stream) -> Section:
    """One stream's part."""
    figures = []
    if stream.course is not None and stream.course.delayed.any():
        figures.append(course_figure(stream, stream.course, view.shown_ms))
    if stream.typical[0].count:
        figures += [distribution_figure(stream), tail_figure(stream)]
    if stream.result.counts.delays.interarrival.count:
        figures.append(interarrival_figure(stream))
    small = [stream_tables.uncertainty_table(stream), stream_tables.lengths_table(stream)]
    wide = [
        stream_tables.percentiles_table(stream),
        stream_tables.budget_table(stream),
        stream_tables.fits_table(stream),
    ]
    return Section(stream, _stream_facts(stream), figures, small, wide)


def told(view: View, sections: list[Section]) -> dict[str, Any]:
    """All names that the template knows."""
    return {
        "view": view,
        "headline": headline(view),
        "main": main_findings(view),
        "facts": _facts(view),
        "clock": _clock_facts(view),
        "uncertainty": _uncertainty(view),
        "failed": account_tables.verdict_table(view, holds=False),
        "held": account_tables.verdict_table(view, holds=True),
        "findings": findings(view),
        "summary": run_tables.summary_table(view),
        "stragglers": list(run_tables.straggler_tables(view)),
        "losses": run_tables.loss_table(view),
        "budgets": run_tables.budgets_table(view),
        "ledger": account_tables.ledger_table(view),
        "comparison": account_tables.comparison_table(view),
        "news": account_tables.news_table(view),
        "sections": sections,
        "rule": RULE if len(view.detailed) < len(view.measured) else "",
        "terms": TERMS,
        "provenance": _provenance(view),
        "remedies": defaultdict(str, REMEDIES),
    }


def _facts(view: View) -> list[tuple[str, str]]:
    begin, end = view.begin_ns, view.end_ns
    rates = sorted({stream.told["rate_hz"] for stream in view.streams})
    transports = sorted({stream.told["transport"] or "not known" for stream in view.streams})
    when = NONE if begin is None or end is None else f"{utc(begin)} to {utc(end)} ({span(end - begin)})"
    return [
        ("Source", view.run.source or "not named"),
        ("When", when),
        ("Streams", f"{count(len(view.streams))}, at {listed([f'{rate:g}' for rate in rates]) or NONE} frames/s"),
        ("Transport", listed(transports) or NONE),
        ("Arrivals by", _stamp_sources(view)),
        ("Frames", f"{count(view.all['received'])} of {count(view.all['expected'])} expected"),
        *_input_facts(view.run.summary.get("run") or {}),
    ]


def _input_facts(told: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What came that was no frame, or was not measured."""
    found = told.get("input") or {}
    skipped = [f"{reason} {count(size)} bytes" for reason, size in (found.get("skipped") or {}).items()]
    others = {"own_drops": "datagrams dropped by this host", "unmeasured_frames": "frames of too many streams"}
    skipped += [f"{count(found[key])} {words}" for key, words in others.items() if found.get(key)]
    return [("Left out", ", ".join(skipped))] if skipped else []


def _stamp_sources(view: View) -> str:
    shares = view.all["quality"]["stamp_source"]
    words = [f"{name} ({percent(share)})" if len(shares) > 1 else name for name, share in shares.items()]
    return f"{listed(words)} stamps" if words else NONE


def _clock_facts(view: View) -> list[tuple[str, str]]:
    clock = view.run.summary["clock"]
    worst = clock["worst_bound_ms"]
    facts = [
        ("Receiver", clock["text"]),
        ("Worst bound of the run", "unknown" if worst is None else f"± {worst:.3g} ms"),
    ]
    if clock["samples"] and clock["source"] != "user":
        asked = f"{plural(clock['samples'], 'time')}, {count(clock['undisciplined_samples'])} without a bound"
        facts.append(("Asked", asked))
    facts += [("Note", note) for note in clock.get("notes", ())]
    if clock["steps"]:
        facts.append(
            ("Was set", f"{plural(clock['steps'], 'time')}, by up to {milliseconds(clock['largest_step_ms'])} ms")
        )
    return facts


def _uncertainty(view: View) -> list[str]:
    """How sure delays are, in sentences."""
    timed = [stream for stream in view.measured if stream.told["delay_ms"]["count"]]
    bounds = [stream.bound_ms for stream in timed if stream.bound_ms is not None]
    unknown = [stream for stream in timed if stream.bound_ms is None]
    sentences = []
    if bounds:
        low, high = f"{min(bounds):.2g}", f"{max(bounds):.2g}"
        whose = "" if not unknown else f" of {plural(len(bounds), 'stream')}"
        sentences.append(
            f"Every delay{whose} is told to ± {low if low == high else f'{low} to {high}'} ms, worst case."
        )
    if unknown:
        names = listed([stream.label for stream in unknown])
        why = unknown[0].told["uncertainty_reason"]
        sentences.append(f"Nobody can say how wrong the delays of {names} are ({why}): they have no ±.")
    if timed:
        sentences.append("Offsets of clocks cancel in IPDV, PDV, inter-arrival times and jitter.")
    return sentences


def _stream_facts(stream: Stream) -> list[tuple[str, str]]:
    told = stream.told
    delay, sure = told["delay_ms"], stream.bound_ms
    quality, events = told["quality"], told["events"]
    facts = [
        *([("From", told["where"])] if told["where"] else []),
        *([("Also named", listed(told["other_names"]))] if told["other_names"] else []),
        ("IDCODE", f"{told['idcode']}, {told['rate_hz']:g} frames/s, {told['transport'] or 'transport not known'}"),
        ("Stamps", f"{utc(stream.result.first_ns, 3)} to {utc(stream.result.last_ns, 3)}"),
        ("Frames", f"{count(told['received'])} of {count(told['expected'])} expected, {count(told['lost'])} lost"),
    ]
    if delay["count"]:
        exact = "± unknown" if sure is None else f"± {sure:.2g} ms"
        facts.append(("Delay", f"median {lasting(delay['p50'])}, p99 {lasting(delay['p99'])} ({exact})"))
    if rates := told["rates_per_s"]:
        spans = {"1": "second", "10": "10 s", "60": "minute"}
        told_rates = [f"in any {spans[key]} {_span_words(rates[key])}" for key in spans if key in rates]
        facts.append(("Frames a second", ", ".join(told_rates)))
    facts.append(("STAT, time quality", stream_tables.flags_words(stream)))
    facts.append(
        ("Availability, completeness", f"{percent(quality['availability'])}, {percent(quality['completeness'])}")
    )
    odd = {
        name.replace("_", " "): told[name]
        for name in ("stale", "conflicting", "off_grid", "outages", "negative", "corrupt")
    }
    odd |= {name.replace("_", " "): events[name] for name in ("disconnects", "retransmits", "own_drops", "stalls")}
    if some := [f"{name} {count(number)}" for name, number in odd.items() if number]:
        facts.append(("Also counted", ", ".join(some)))
    if silences := told["silences"]:
        longest = max(silences, key=lambda each: each["length_s"])
        words = f"{plural(len(silences), 'silence')} of 10 s or more, the longest {span(longest['length_s'] * 1e9)}"
        facts.append(("Silences", words))
    return facts


def _span_words(ends: dict[str, float]) -> str:
    low, high = f"{ends['min']:.4g}", f"{ends['max']:.4g}"
    return low if low == high else f"{low} to {high}"


def _provenance(view: View) -> list[tuple[str, str]]:
    import matplotlib
    import numpy

    command = view.run.command
    return [
        ("Made by", f"pmutools {pmutools.__version__}"),
        *([("Command", command)] if command else []),
        ("Source", view.run.source or "not named"),
        ("Arrivals by", _stamp_sources(view)),
        ("With", f"Python {platform.python_version()}, numpy {numpy.__version__}, matplotlib {matplotlib.__version__}"),
    ]
