"""The tables of a run: a row a stream, and what concerns all of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from pmutools.measure.budget import TABLE_I
from pmutools.report.page import Cell, Column, Row, Table
from pmutools.report.text import INFINITE, NONE, clean, count, milliseconds, percent, plural, shortened
from pmutools.report.view import Stream, View

MOST_ROWS = 500
"""Of tables that may grow with more than the number of streams."""

_SUMMARY = (
    Column("Stream", words=True),
    Column("ID"),
    Column("rate /s"),
    Column("expected", group="Frames", term="term-expected"),
    Column("received", group="Frames"),
    Column("lost", group="Frames"),
    Column("dupl.", group="Frames", term="term-duplicated"),
    Column("reord.", group="Frames", term="term-reordered"),
    Column("late", group="Frames", term="term-late"),
    Column("p50", group="Delay, stamp to arrival (ms)", term="term-delay"),
    Column("p95", group="Delay, stamp to arrival (ms)"),
    Column("p99", group="Delay, stamp to arrival (ms)", term="term-percentile"),
    Column("p99 of expected", group="Delay, stamp to arrival (ms)", term="term-expected-percentile"),
    Column("max", group="Delay, stamp to arrival (ms)"),
    Column("±", group="Delay, stamp to arrival (ms)", term="term-uncertainty"),
    Column("IPDV p99", group="Variation (ms)", term="term-ipdv"),
    Column("jitter", group="Variation (ms)", term="term-jitter"),
    Column("available", group="Quality", term="term-availability"),
    Column("locked", group="Quality", term="term-locked"),
    Column("empty windows", group="Quality", term="term-window"),
    Column("diag.", group="Quality"),
)


def summary_table(view: View) -> Table:
    """A row a stream."""
    rows = [Row(_summary_cells(stream, stream in view.detailed), f"row-{stream.anchor}") for stream in view.streams]
    wait = {stream.told["wait_ms"] for stream in view.streams}
    tmax = {stream.told["tmax_s"] for stream in view.streams}
    note = (
        f"Late: after {', '.join(milliseconds(each) for each in sorted(wait))} ms. "
        f"Lost: not within Tmax = {', '.join(f'{each:.3g}' for each in sorted(tmax))} s. "
        "Every figure, unrounded, is in summary.json."
    )
    return Table("streams-table", plural(len(rows), "stream"), _SUMMARY, rows, note, tools=True)


def _summary_cells(stream: Stream, linked: bool) -> list[Cell]:
    told, quality = stream.told, stream.told["quality"]
    delay, windows = told["delay_ms"], told["per_window"]
    lost_share = told["lost"] / told["expected"] if told["expected"] else None
    return [
        Cell(shortened(told["name"], 64), told["name"], href=f"#{stream.anchor}" if linked else ""),
        Cell(str(told["idcode"]), told["idcode"]),
        Cell(f"{told['rate_hz']:.4g}", told["rate_hz"]),
        count_cell(told["expected"]),
        count_cell(told["received"], "" if stream.measured else "bad"),
        Cell(_with_share(told["lost"], lost_share), told["lost"], "bad" if told["lost"] else ""),
        count_cell(told["duplicated"]),
        count_cell(told["reordered"]),
        count_cell(told["late"]),
        *(ms_cell(delay[key]) for key in ("p50", "p95", "p99")),
        expected_cell(delay, "p99", told["lost"]),
        ms_cell(delay["max"]),
        _bound(stream),
        ms_cell(told["ipdv_ms"]["p99"]),
        ms_cell(told["jitter_rfc3550_ms"]),
        _share(quality["availability"]),
        _share(quality["time_quality"].get("0", 0.0) if quality["time_quality"] else None),
        _share(windows["0"] / sum(windows.values()) if sum(windows.values()) else None),
        count_cell(len(told["diagnoses"])),
    ]


def expected_cell(delay: dict[str, Any], key: str, lost: int) -> Cell:
    """A percentile among all expected frames: infinite where that is the answer."""
    value = delay[f"{key}_expected"]
    return Cell(INFINITE, "Infinity") if value is None and delay["count"] and lost else ms_cell(value)


def _with_share(number: int, share: float | None) -> str:
    return f"{count(number)} ({percent(share)})" if number else "0"


def count_cell(value: int, tone: str = "") -> Cell:
    """A whole number."""
    return Cell(count(value), value, tone)


def ms_cell(value: float | None) -> Cell:
    """A figure in ms."""
    return Cell(milliseconds(value), value)


def _share(value: float | None) -> Cell:
    return Cell(percent(value), value)


def _bound(stream: Stream) -> Cell:
    if not stream.told["delay_ms"]["count"]:
        return Cell(NONE)
    return Cell("unknown", None, "bad") if stream.bound_ms is None else Cell(f"{stream.bound_ms:.2g}", stream.bound_ms)


def cut(
    name: str, caption: str, columns: Sequence[Column], rows: Sequence[Row], note: str = "", *, tools: bool = False
) -> Table:
    """A table of :data:`MOST_ROWS` at most; what is left out is said."""
    left = len(rows) - MOST_ROWS
    if left > 0:
        note = f"{note} {count(left)} more rows are left out; summary.json has all.".strip()
    return Table(name, caption, columns, rows[:MOST_ROWS], note, tools)


def budgets_table(view: View) -> Table:
    """The parts of the delay, a row a stream, the paper's below."""
    streams = [stream for stream in view.detailed if stream.told["budget"]]
    columns = [
        Column("Stream", words=True),
        *(Column(name, "ms", term="term-budget" * (name == "PMU")) for name in TABLE_I),
    ]
    rows = [
        Row([Cell(stream.label, href=f"#{stream.anchor}"), *(_part(row) for row in stream.told["budget"])])
        for stream in streams
    ]
    paper = [Cell(f"{mean:g} ({least:g} to {most:g})", mean, "quiet") for mean, least, most in TABLE_I.values()]
    if rows:
        rows.append(Row([Cell("the paper's Table I"), *paper]))
    note = "Mean (least to largest). A star marks what is assumed, not measured, or a sum that holds it."
    return Table("budgets-table", "Delay budget, stream by stream", columns, rows, note)


def _part(row: dict[str, Any]) -> Cell:
    mean, least, most = (milliseconds(row[key]) for key in ("mean_ms", "min_ms", "max_ms"))
    return Cell(f"{mean} ({least} to {most}){'' if row['measured'] else ' *'}", row["mean_ms"])


def loss_table(view: View) -> Table:
    """How the losses lie, of streams that have any, most first."""
    columns = [
        Column("Stream", words=True),
        Column("lost"),
        Column("number", "", "Loss periods", "term-loss-period"),
        Column("mean length", "frames", "Loss periods"),
        Column("longest", "frames", "Loss periods"),
        Column("longest", "ms", "Loss periods"),
        Column("between them", "s", "Loss periods"),
        Column("median", "slots", "Loss distance", "term-loss-distance"),
        Column("noticeable", "", "Loss distance"),
        Column("number", "", "Bursts", "term-burst"),
        Column("density", "", "Bursts"),
        Column("mean", "ms", "Bursts"),
    ]
    streams = sorted((each for each in view.measured if each.told["lost"]), key=lambda each: -each.told["lost"])
    return cut(
        "loss-table", "How the losses lie", columns, [Row(_loss_cells(stream)) for stream in streams], tools=True
    )


def _loss_cells(stream: Stream) -> list[Cell]:
    runs, bursts = stream.told["loss_runs"], stream.told["loss_runs"]["bursts"]
    between = runs["mean_between_ms"]
    return [
        Cell(stream.label, href=f"#row-{stream.anchor}"),
        count_cell(stream.told["lost"]),
        count_cell(runs["count"]),
        Cell(NONE if runs["mean"] is None else f"{runs['mean']:.2f}", runs["mean"]),
        count_cell(runs["max"]),
        ms_cell(runs["max_ms"]),
        Cell(NONE if between is None else f"{between / 1000:.3g}", between),
        Cell(count(runs["distance"]["p50"]), runs["distance"]["p50"]),
        _share(runs["noticeable"]),
        count_cell(bursts["count"]),
        _share(bursts["density"] if bursts["count"] else None),
        ms_cell(bursts["mean_ms"]),
    ]


def straggler_tables(view: View) -> Iterator[Table]:
    """Of each rate with several streams: who was last."""
    columns = [
        Column("Stream", words=True),
        Column("was last", "of complete stamps", "", "term-straggler"),
        Column("all waited for it", "ms on average"),
        Column("missing", "frames"),
        Column("p50", "ms", "After the first of the stamp"),
        Column("p99", "ms", "After the first of the stamp"),
    ]
    for number, told in enumerate(view.all["alignment"]):
        if len(told["stragglers"]) < 2:
            continue
        rows = [
            Row(
                [
                    Cell(clean(row["name"])),
                    _share(row["last_share"]),
                    ms_cell(row["cost_ms"]),
                    count_cell(row["missing"]),
                    ms_cell(row["lag_p50_ms"]),
                    ms_cell(row["lag_p99_ms"]),
                ]
            )
            for row in told["stragglers"]
        ]
        whole = percent(told["complete"] / told["stamps"]) if told["stamps"] else NONE
        caption = f"Who was last, of {plural(len(rows), 'stream')} at {told['rate_hz']:g}/s"
        note = f"{count(told['complete'])} of {count(told['stamps'])} stamps were complete ({whole})."
        yield cut(f"stragglers-table-{number + 1}", caption, columns, rows, note, tools=True)
