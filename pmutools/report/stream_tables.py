"""The tables of one stream."""

from __future__ import annotations

from pmutools.measure.histogram import PERCENTILES
from pmutools.report.page import Cell, Column, Row, Table
from pmutools.report.run_tables import expected_cell
from pmutools.report.text import count, milliseconds, percent
from pmutools.report.view import Stream

MOST_LENGTHS = 12


def percentiles_table(stream: Stream) -> Table:
    """Percentiles twice: of what came, and of what was expected. Then the figures that need no common clock."""
    told = stream.told
    keys = [key for key in PERCENTILES if key not in ("p5", "p90")]
    columns = [
        Column("ms", words=True),
        Column("mean"),
        Column("sd"),
        Column("min"),
        *(Column(key.replace("_", "."), term="term-percentile" * (key == "p1")) for key in keys),
        Column("max"),
        Column("frames"),
    ]

    def row(name: str, part: str) -> Row:
        found = told[part]
        figures = [found[key] for key in ("mean", "sd", "min", *keys, "max")]
        return Row(
            [
                Cell(name),
                *(Cell(milliseconds(value), value) for value in figures),
                Cell(count(found["count"]), found["count"]),
            ]
        )

    delay, lost = told["delay_ms"], told["lost"]
    blank = Cell("")
    of_expected = Row(
        [
            Cell("delay, expected frames: lost = ∞"),
            *(blank,) * 3,
            *(expected_cell(delay, key, lost) for key in keys),
            Cell("∞", "Infinity") if lost else Cell(milliseconds(delay["max"]), delay["max"]),
            Cell(count(delay["count"] + lost), delay["count"] + lost),
        ]
    )
    rows = [
        row("delay, received frames", "delay_ms"),
        of_expected,
        row("delay, locked frames", "delay_locked_ms"),
        *([row("departure to arrival (ledger)", "one_way_ms")] if told.get("one_way_ms") else []),
        row("IPDV", "ipdv_ms"),
        row("PDV", "pdv_ms"),
        row("inter-arrival", "interarrival_ms"),
    ]
    return Table(f"{stream.anchor}-percentiles", "Percentiles, ms", columns, rows if delay["count"] else ())


def budget_table(stream: Stream) -> Table:
    """As the paper's Table I."""
    columns = [
        Column("Part", words=True),
        *(Column(name, "ms", "This stream", "term-budget" * (name == "mean")) for name in ("mean", "min", "max")),
        *(Column(name, "ms", "The paper's Table I") for name in ("mean", "min", "max")),
        Column("", words=True),
        Column("how", words=True),
    ]
    rows = [
        Row(
            [
                Cell(row["name"]),
                *(Cell(milliseconds(row[key]), row[key]) for key in ("mean_ms", "min_ms", "max_ms")),
                *(Cell(f"{row['paper_ms'][key]:g}", row["paper_ms"][key], "quiet") for key in ("mean", "min", "max")),
                Cell("measured" if row["measured"] else "assumed"),
                Cell(row["how"]),
            ]
        )
        for row in stream.told["budget"]
    ]
    return Table(f"{stream.anchor}-budget", "Delay budget", columns, rows)


def uncertainty_table(stream: Stream) -> Table:
    """What the uncertainty is made of."""
    told = stream.told["uncertainty"]
    columns = [Column("Part", words=True), Column("bound", "ms"), Column("why", words=True)]
    rows = [
        Row(
            [
                Cell(part["name"]),
                Cell("unknown" if part["bound_ms"] is None else f"{part['bound_ms']:.3g}", part["bound_ms"]),
                Cell(part["why"] + (" (assumed)" if part["assumed"] else "")),
            ]
        )
        for part in told["parts"]
    ]
    bound = told["bound_ms"]
    rows.append(Row([Cell("sum"), Cell("unknown" if bound is None else f"{bound:.3g}", bound), Cell("")]))
    shown = rows if stream.told["delay_ms"]["count"] else ()
    return Table(f"{stream.anchor}-uncertainty", "Uncertainty of a delay", columns, shown)


def fits_table(stream: Stream) -> Table:
    """Families of distributions, as impairments that a player takes."""
    columns = [
        Column("Distribution", words=True),
        Column("KS", term="term-ks"),
        Column("furthest off (ms)", words=True, term="term-furthest-off"),
        Column("", words=True),
    ]
    told = stream.told["fit"]
    chosen = told["text"] if told else ""
    rows = [
        Row(
            [
                Cell(fit.text),
                Cell(f"{fit.ks:.4f}", fit.ks),
                Cell(f"{fit.tail.at}: {fit.tail.error_ms:+.3g}{'' if fit.tail.holds else ', does not hold'}"),
                Cell("the fit" if fit.text == chosen else ""),
            ]
        )
        for fit in sorted(stream.fits, key=lambda fit: fit.ks)
    ]
    what = "the delays" if stream.typical[1] == "delay" else "PDV, since the delays are a clock's error"
    note = "The fit is the simplest that is about as near as the nearest of those whose quantiles hold."
    if told and told["name"] == "histogram":
        note = "None of them is like what was measured, tail included: the exported profile has the histogram itself."
    return Table(f"{stream.anchor}-fits", f"Distributions fitted to {what} (ms)", columns, rows, note)


def lengths_table(stream: Stream) -> Table:
    """How often how many frames in a row were lost, and how many windows in a row were empty."""
    columns = [Column("In a row"), Column("loss periods", term="term-loss-period"), Column("runs of empty windows")]
    lost = dict(map(tuple, stream.told["loss_runs"]["lengths"]))
    empty = dict(map(tuple, stream.told["windows"]["empty_runs"]["histogram"]))
    lengths = sorted({*lost, *empty})
    rows = [
        Row([Cell(count(at), at), *(Cell(count(found.get(at, 0)), found.get(at, 0)) for found in (lost, empty))])
        for at in lengths[:MOST_LENGTHS]
    ]
    if more := lengths[MOST_LENGTHS:]:
        sums = [sum(found.get(at, 0) for at in more) for found in (lost, empty)]
        rows.append(Row([Cell(f"{count(more[0])} to {count(more[-1])}", more[0]), *(Cell(count(n), n) for n in sums)]))
    return Table(f"{stream.anchor}-lengths", "Lengths of losses and of empty windows", columns, rows)


def flags_words(stream: Stream) -> str:
    """What STAT and time quality said, in one sentence."""
    quality = stream.told["quality"]
    parts = [f"MSG_TQ {code}: {percent(share)}" for code, share in quality["time_quality"].items()]
    flags = ("not_synchronised", "sorted_by_arrival", "trigger", "config_change", "data_modified")
    parts += [f"{name.replace('_', ' ')}: {percent(quality[name])}" for name in flags if quality[name]]
    parts += [
        f"data {name}: {percent(share)}" for name, share in quality["data_error"].items() if name != "good" and share
    ]
    return ", ".join(parts) or "nothing"
