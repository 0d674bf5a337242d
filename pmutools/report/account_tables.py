"""Tables of what a run is held to: limits, a sender's ledger, an earlier run; and the log of what happened."""

from __future__ import annotations

from pmutools.measure.require import METRICS
from pmutools.report.page import Cell, Column, Row, Table
from pmutools.report.run_tables import MOST_ROWS, count_cell, cut, ms_cell
from pmutools.report.text import NONE, clean, count, milliseconds, percent, plural, shortened, utc
from pmutools.report.view import View

_TONES = {"worse": "bad", "better": "good", "gone": "bad"}


def verdict_table(view: View, *, holds: bool) -> Table:
    """Limits that hold, or that do not."""
    columns = [Column("Limit", words=True), Column("stream", words=True), Column("measured"), Column("", words=True)]
    word, tone = ("✓ holds", "good") if holds else ("✗ does not hold", "bad")
    rows = [
        Row(
            [
                Cell(each.requirement.text),
                Cell(clean(each.stream)),
                Cell(_measured(each.value, METRICS[each.requirement.name].unit), each.value),
                Cell(f"{word}: {each.note}" if each.note else word, tone=tone),
            ]
        )
        for each in view.run.verdicts
        if each.holds is holds
    ]
    caption = f"{plural(len(rows), 'limit')} that {'hold' if holds else 'do not hold'}"
    return cut(f"limits-{'held' if holds else 'failed'}", caption, columns, rows, tools=True)


def _measured(value: float | None, unit: str) -> str:
    if value is None:
        return "not measured"
    if unit == "share":
        return percent(value)
    return count(value) if unit == "count" else f"{milliseconds(value)} {unit}".strip()


def ledger_table(view: View) -> Table:
    """What was measured beside what the sender's ledger says."""
    columns = [
        Column("Stream", words=True),
        Column("arrived", "", "Copies that were sent"),
        Column("lost on the way", "", "Copies that were sent"),
        Column("withheld", "on purpose", "Others"),
        Column("contradictions", "", "Others"),
        Column("unknown", "", "Others"),
        *(Column(key, "ms", "Departure to arrival") for key in ("p50", "p95", "p99", "max")),
        Column("p50", "ms", "Stamp to departure"),
    ]
    told = view.run.summary.get("ledger") or {"streams": [], "file": ""}
    rows = [
        Row(
            [
                Cell(shortened(each["name"], 64)),
                count_cell(sum(each["received"].values()) - each["contradictions"]),
                count_cell(each["lost_on_the_way"]),
                count_cell(sum(each["missing"].values()) - each["lost_on_the_way"]),
                count_cell(each["contradictions"], "bad" if each["contradictions"] else ""),
                count_cell(each["unknown"]),
                *(ms_cell(each["one_way_ms"][key]) for key in ("p50", "p95", "p99", "max")),
                ms_cell(each["at_sender_ms"]["p50"]),
            ]
        )
        for each in told["streams"]
    ]
    note = "A contradiction arrived, though the ledger says that it was not sent; unknown frames are not in it."
    return cut("ledger-table", f"Against the ledger {told['file']}", columns, rows, note, tools=True)


def comparison_table(view: View) -> Table:
    """What is not the same as in the earlier run."""
    differences = view.run.differences
    columns = [
        Column("Stream", words=True),
        Column("figure", words=True),
        Column("before"),
        Column("now"),
        Column("change"),
        Column("", words=True),
    ]
    rows = [
        Row(
            [
                Cell(clean(each.stream)),
                Cell(each.metric.replace("_", " ")),
                Cell(_compared(each.before, each.unit), each.before),
                Cell(_compared(each.after, each.unit), each.after),
                Cell(_compared(each.change, each.unit), each.change),
                Cell(each.verdict, tone=_TONES.get(each.verdict, "")),
            ]
        )
        for each in differences
        if each.verdict != "same"
    ]
    same = sum(each.verdict == "same" for each in differences)
    return cut(
        "comparison-table",
        "What changed",
        columns,
        rows,
        f"{plural(same, 'other figure')} stayed the same.",
        tools=True,
    )


def _compared(value: float | None, unit: str) -> str:
    if value is None:
        return NONE
    if unit == "share":
        return f"{100 * value:.3g} %".replace("-", "−")
    return count(value) if unit in ("count", "") else f"{milliseconds(value)} {unit}"


def news_table(view: View) -> Table:
    """What happened to connections, clock and host."""
    columns = [Column("When (UTC)", words=True), Column("What", words=True)]
    news = view.run.news
    kept = [*news[: MOST_ROWS // 2], *news[-(MOST_ROWS // 2) :]] if len(news) > MOST_ROWS else news
    rows = [Row([Cell(utc(at, 3).removesuffix(" UTC"), at), Cell(clean(line))]) for at, line in kept]
    note = f"{count(len(news) - len(kept))} lines in the middle are left out." if len(kept) < len(news) else ""
    return Table("news-table", "Connections, clock and host", columns, rows, note)
