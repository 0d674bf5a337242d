"""The tables of an analysed session."""

from __future__ import annotations

from collections.abc import Sequence

from dcon.analysis.analysis import Analysis
from dcon.analysis.course import Gap
from dcon.analysis.numbers import Spread
from dcon.analysis.ringdowns import Comparison, Value
from pmutools.measure.budget import TABLE_I
from pmutools.report.page import Cell, Column, Row, Table
from pmutools.report.text import NONE, count, milliseconds, percent, span, utc

MOST_ROWS = 500
"""Of a table; the JSON has more."""
_W = True


def comparison_table(rows: Sequence[Comparison], name: str) -> Table:
    columns = (
        Column("loop", words=_W),
        Column("gain", "MW/mHz"),
        Column("ringdowns"),
        Column("frequency", "Hz"),
        Column("damping", "%"),
        Column("middle 80 % of the fits", "%"),
        Column("gained", "points"),
    )
    return Table(
        name,
        "Open loop against closed",
        columns,
        [
            _row(
                "closed" if row.closed else "open",
                (f"{row.gain_mw_per_mhz:g}" if row.closed else NONE, row.gain_mw_per_mhz),
                str(row.ringdowns),
                f"{row.frequency_hz:.4f}",
                f"{row.damping_percent:z.2f}",
                f"{row.damping_low_percent:z.2f} to {row.damping_high_percent:z.2f}",
                NONE if row.gained_percent is None else f"{row.gained_percent:+.2f}",
            )
            for row in rows
        ],
        "Medians. Swings of different disturbances and hours are compared as if the grid had been the same.",
    )


def ringdown_table(session: Analysis, stem: str) -> Table:
    columns = (
        *(Column("ringdown"), Column("disturbed", "UTC", words=_W), Column("loop", words=_W), Column("gain", "MW/mHz")),
        *(Column("largest |Δf|", "mHz"), Column("saturated", "s"), Column("free", "s")),
        *(Column("frequency", "Hz"), Column("its spread", "Hz"), Column("damping", "%"), Column("its spread", "%")),
        *(Column("R²"), Column("fits"), Column("", words=_W)),
    )
    rows = []
    for number, found in enumerate(session.ringdowns, 1):
        mode = found.mode
        rows.append(
            _row(
                str(number),
                (utc(found.disturbed_ns, 2), found.disturbed_ns),
                "closed" if found.closed else "open",
                f"{found.gain_mw_per_mhz:g}" if found.closed else NONE,
                f"{found.peak_mhz:.2f}",
                f"{found.saturated_s:.2f}",
                f"{found.length_s:.1f}",
                *(
                    (NONE,) * 6
                    if mode is None
                    else (
                        f"{mode.frequency_hz.median:.4f}",
                        _range(mode.frequency_hz, 4),
                        f"{mode.damping_percent.median:z.2f}",
                        _range(mode.damping_percent, 2),
                        f"{mode.r2:.4f}",
                        f"{mode.fits} of {mode.tried}",
                    )
                ),
                found.why,
            )
        )
    return Table(
        f"{stem}-ringdowns",
        "Ringdowns",
        columns,
        rows,
        f"Δf at rest changes by {session.noise_mhz:.3g} mHz within 0.5 s (robust standard deviation).",
        tools=True,
    )


def _range(value: Value, digits: int) -> str:
    return f"{value.low:.{digits}f} to {value.high:.{digits}f}"


def gap_table(gaps: Sequence[Gap], name: str, caption: str) -> Table:
    columns = (Column("from", "UTC", words=_W), Column("to", "UTC", words=_W), Column("length"), Column("ticks"))
    rows = [
        _row(utc(gap.begin_ns, 3), utc(gap.end_ns, 3), span(gap.end_ns - gap.begin_ns), count(gap.ticks), gap.why)
        for gap in gaps[:MOST_ROWS]
    ]
    return Table(name, caption, (*columns, Column("why", words=_W)), rows)


def register_table(session: Analysis, stem: str) -> Table:
    columns = (
        *(Column("check", words=_W), Column("of", words=_W), Column("times"), Column("first", "UTC", words=_W)),
        *(Column("last change", "UTC", words=_W), Column("value"), Column("limit"), Column("at the end", words=_W)),
    )
    rows = []
    for entry in session.register[:MOST_ROWS]:
        state = ["up" if entry.up else "down"]
        state += ["latched"] if entry.latched else []
        state += [f"acknowledged by {entry.acknowledged}"] if entry.acknowledged else []
        rows.append(
            _row(
                entry.name,
                entry.subject,
                str(entry.times),
                (utc(entry.first_ns, 2), entry.first_ns),
                (utc(entry.last_ns, 2), entry.last_ns),
                NONE if entry.value is None else f"{entry.value:.4g}",
                NONE if entry.limit is None else f"{entry.limit:.4g}",
                ", ".join(state),
            )
        )
    return Table(f"{stem}-register", "Flag register at the end of the session", columns, rows, tools=True)


def order_table(session: Analysis, stem: str) -> Table:
    columns = (Column("when", "UTC", words=_W), Column("order", words=_W), Column("value"), Column("what", words=_W))
    rows = [
        _row((utc(o.tick_ns, 3), o.tick_ns), o.name, NONE if o.given is None else f"{o.given:g}", o.text, o.who, o.why)
        for o in session.columns.orders[:MOST_ROWS]
    ]
    return Table(
        f"{stem}-orders", "The operator's orders", (*columns, Column("who", words=_W), Column("why", words=_W)), rows
    )


def event_table(session: Analysis, stem: str) -> Table:
    columns = (Column("when", "UTC", words=_W), *(Column(name, words=_W) for name in ("event", "of", "detail")))
    events = session.columns.events
    rows = [
        _row((utc(event.tick_ns, 3), event.tick_ns), event.name, event.subject, event.detail)
        for event in events[:MOST_ROWS]
    ]
    note = f"The first {MOST_ROWS} of {count(len(events))}." if len(events) > MOST_ROWS else ""
    return Table(f"{stem}-events", "Events", columns, rows, note, tools=True)


def switch_table(session: Analysis, stem: str) -> Table:
    columns = (
        *(Column("when", "UTC", words=_W), Column("from", words=_W), Column("to", words=_W)),
        *(Column("step of the command", "MW"), Column("in that tick", words=_W)),
    )
    rows = [
        _row(
            (utc(switch.tick_ns, 3), switch.tick_ns),
            switch.from_instance or NONE,
            switch.to_instance or NONE,
            f"{switch.step_mw:.3f}",
            switch.why,
        )
        for switch in session.switches[:MOST_ROWS]
    ]
    total = len(session.switches)
    note = f"The first {MOST_ROWS} of {count(total)}." if total > MOST_ROWS else ""
    return Table(f"{stem}-switches", "Changes of the active instance", columns, rows, note, tools=True)


def instance_table(session: Analysis, stem: str) -> Table:
    columns = (
        *(Column("instance", words=_W), Column("active"), Column("READY"), Column("HELD"), Column("DISABLED")),
        *(Column("disabled", "times"), Column("by", words=_W)),
    )
    rows = [
        _row(
            use.name,
            *((percent(share), share) for share in (use.active, use.ready, use.held, use.disabled)),
            str(use.disabled_times),
            ", ".join(f"{name} {times}" for name, times in sorted(use.reasons.items(), key=lambda item: -item[1])),
        )
        for use in session.instances
    ]
    return Table(f"{stem}-uses", "Instances, shares of the session", columns, rows)


def pmu_table(session: Analysis, stem: str) -> Table:
    columns = (
        *(Column("PMU", words=_W), Column("expected"), Column("received"), Column("lost"), Column("twice")),
        *(Column("out of order"), Column("longest gap", "s")),
        *(Column(name, "ms", "stamp to arrival") for name in ("p50", "p99", "max")),
        *(Column(name, "ms", "age at a tick") for name in ("p50", "max")),
        *(Column("error", "", "STAT"), Column("not synchronised", "", "STAT")),
        *(Column("triggered", "", "STAT"), Column("modified", "", "STAT"), Column("stamps by", words=_W)),
    )
    rows = []
    for pmu in session.pmus:
        share = pmu.lost / pmu.expected if pmu.expected else 0.0
        lost = Cell(f"{count(pmu.lost)} ({percent(share)})" if pmu.lost else "0", pmu.lost, "bad" if pmu.lost else "")
        shares = (pmu.data_error, pmu.unsynchronised, pmu.triggered, pmu.modified)
        rows.append(
            _row(
                pmu.name,
                *(count(pmu.expected), count(pmu.received), lost, count(pmu.duplicated), count(pmu.reordered)),
                f"{pmu.longest_gap_s:.3f}",
                *map(milliseconds, (pmu.delay_ms.p50, pmu.delay_ms.p99, pmu.delay_ms.max)),
                *map(milliseconds, (pmu.age_ms.p50, pmu.age_ms.max)),
                *((percent(value), value) for value in shares),
                ", ".join(pmu.stamp_sources),
            )
        )
    note = "Lost: reporting instants between its first and last frame that no tick got."
    return Table(f"{stem}-pmus", "Data of each PMU, as ticks took it", columns, rows, note, tools=True)


def budget_table(session: Analysis, stem: str) -> Table:
    columns = (
        *(Column("part", words=_W), Column("mean", "ms"), Column("least", "ms"), Column("largest", "ms")),
        *(Column("Table I, mean", "ms"), Column("how", words=_W)),
    )
    rows = [
        _row(row.name, *map(milliseconds, (row.mean_ms, row.min_ms, row.max_ms, TABLE_I[row.name][0])), row.how)
        for row in session.budget
    ]
    return Table(f"{stem}-budget", "Delay budget", columns, rows)


def timing_facts(session: Analysis) -> list[tuple[str, str]]:
    timing = session.timing
    return [
        ("Ticks", f"{count(timing.ticks)} logged, {count(timing.missing_ticks)} missing between them"),
        ("Computing", _spread(timing.compute_us, "µs")),
        ("Late", f"{_spread(timing.late_us, 'µs')}; {count(timing.late_over_1ms)} by more than 1 ms"),
    ]


def command_facts(session: Analysis) -> list[tuple[str, str]]:
    found = session.commands
    return [
        ("ACTIVE", f"{found.active_s:,.1f} s; output driven {found.driven_s:,.1f} s"),
        ("Command", f"rms {found.rms_mw:.2f} MW, mean {found.mean_mw:+.2f} MW, peak {found.peak_mw:.2f} MW"),
        ("At the limit", f"{found.saturated_s:.2f} s (±{session.limit_mw:g} MW)"),
        ("Steepest", f"{found.largest_slew_mw_per_s:.0f} MW/s"),
        ("Changes of sign", f"{found.zero_crossings_per_s:.2f} a second"),
        *([("Probing signal", f"peak {found.peak_probe_mw:.2f} MW")] if found.peak_probe_mw else []),
    ]


def _spread(spread: Spread, unit: str) -> str:
    if spread.p50 is None or spread.p99 is None or spread.max is None:
        return "not in the log (virtual time, or lost)"
    return f"median {spread.p50:.0f} {unit}, p99 {spread.p99:.0f} {unit}, largest {spread.max:.0f} {unit}"


def _row(*cells: str | Cell | tuple[str, float]) -> Row:
    return Row([_cell(cell) for cell in cells])


def _cell(cell: str | Cell | tuple[str, float]) -> Cell:
    if isinstance(cell, Cell):
        return cell
    if isinstance(cell, tuple):
        return Cell(*cell)
    try:
        return Cell(cell, float(cell.replace(",", "")))
    except ValueError:
        return Cell(cell, None if cell == NONE else cell)
