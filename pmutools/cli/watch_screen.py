"""The live displays' screen: a snapshot of all streams and the person's choices, drawn for a size; pure.

Every line is a rich Text of its own, so that only lines that have changed need to be drawn again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt
from rich.style import Style
from rich.text import Text

from pmutools.cli.columns import Layout, fit, layout, number
from pmutools.cli.look import (
    BAD,
    BOLD,
    DIM,
    GOOD,
    HEADER,
    MARK,
    PLAIN,
    SELECTED,
    event_lines,
    fitted,
    help_line,
    help_page,
    prompt_line,
    room_between,
)
from pmutools.cli.quality_text import stat_text, time_quality_text
from pmutools.cli.shell import visible
from pmutools.cli.watch_columns import VIEWS, mark, milliseconds, rate, seconds, state_text, troubled
from pmutools.cli.watch_keys import WORST, Around, Command, Ui, with_commands
from pmutools.tools.watch import Row, Snapshot, StreamState
from pmutools.tools.watch.snapshot import STATES

HEAD = 4
"""Lines above the streams: title, totals, facts, header."""
FOOT = 4
"""Lines below them and the events: two of the selected stream, message, help."""
MARK_WIDTH = 2


def page_rows(height: int) -> int:
    """How many streams fit."""
    return room_between(height, HEAD + FOOT)


def listed(snapshot: Snapshot, ui: Ui) -> npt.NDArray[np.intp]:
    """Rows of the snapshot as they are filtered and sorted."""
    rows = _sorted(snapshot, ui)
    if words := ui.filter.lower().split():
        kept = {row for row in range(len(snapshot)) if all(word in _said(snapshot, row) for word in words)}
        rows = np.array([row for row in rows.tolist() if row in kept], np.intp)
    return rows


def around(snapshot: Snapshot, ui: Ui) -> Around:
    """What keys depend on."""
    sortable = [shown.column.title for shown in VIEWS[ui.view] if shown.by]
    return Around(len(listed(snapshot, ui)), sortable, tuple(VIEWS))


def lines(
    snapshot: Snapshot,
    ui: Ui,
    title: str,
    facts: Sequence[str],
    width: int,
    height: int,
    commands: Sequence[Command] = (),
) -> Iterator[Text]:
    """The screen: exactly ``height`` lines, none wider than ``width``, each made when it is asked for."""
    if ui.help:
        keys = ((shown, meaning) for _, shown, meaning in with_commands(commands))
        return fitted(help_page(title, keys, width, height), width, height)
    return fitted(_lines(snapshot, ui, title, facts, width, height, commands), width, height)


def status_line(snapshot: Snapshot) -> str:
    """All of it in one line, for where there is no display."""
    return "  ".join(text for text, _ in _totals(snapshot))


def _lines(
    snapshot: Snapshot,
    ui: Ui,
    title: str,
    facts: Sequence[str],
    width: int,
    height: int,
    commands: Sequence[Command],
) -> Iterator[Text]:
    page_length = page_rows(height)
    yield Text(fit(visible(title), width), BOLD)
    yield _state(snapshot, ui)
    yield Text(visible("   ".join(facts)), DIM)
    rows = listed(snapshot, ui)
    selected = max(0, min(ui.selected, len(rows) - 1))
    top = selected // page_length * page_length
    page = rows[top : top + page_length]
    table = layout([shown.column for shown in VIEWS[ui.view]], width - MARK_WIDTH)
    yield _header(table, ui)
    for place, number_of_row in enumerate(page.tolist(), top):
        yield _row(snapshot.row(number_of_row), table, chosen=place == selected)
    yield from _chosen(snapshot, rows, selected, ui, f"{top + 1}-{top + len(page)} of {len(rows)}")
    yield from event_lines(ui.events, height - HEAD - len(page) - FOOT)
    yield prompt_line("filter: " if ui.typing else None, ui.filter, ui.message, width, error=ui.error)
    yield help_line([label for label, _, _ in with_commands(commands)], width)


def _state(snapshot: Snapshot, ui: Ui) -> Text:
    minutes, second = divmod(int(snapshot.running_s), 60)
    begin = ("FROZEN", MARK) if ui.frozen else ("LIVE", GOOD)
    line = Text.assemble(begin, f" {minutes // 60:02d}:{minutes % 60:02d}:{second:02d}")
    for text, style in _totals(snapshot):
        line.append(f"  {text}", style)
    return line


def _totals(snapshot: Snapshot) -> Iterator[tuple[str, Style]]:
    """Words and their styles."""
    streaming = snapshot.count(StreamState.STREAMING)
    fewer = streaming < len(snapshot)
    yield f"{streaming} of {len(snapshot)} streaming" if fewer else f"{streaming} streaming", BAD if fewer else PLAIN
    yield f"{rate(snapshot.rate_hz)} frames/s", PLAIN
    for what, count in (("lost", snapshot.lost), ("dup", snapshot.duplicated)):
        yield f"{what} {number(count, 7)}", MARK if count else PLAIN
    yield f"own drops {number(snapshot.own_drops, 7)}", BAD if snapshot.own_drops else PLAIN
    if skipped := sum(snapshot.skipped.values()):
        yield f"skipped {number(skipped, 7)} B", BAD
    if snapshot.untold:
        yield f"{number(snapshot.untold, 7)} frames of more streams", BAD


def _header(table: Layout, ui: Ui) -> Text:
    header = Text(" " * MARK_WIDTH + table.header(), HEADER)
    at = MARK_WIDTH
    for column, width in zip(table.columns, table.widths, strict=True):
        if column.title == ui.sort:
            header.stylize(BOLD + MARK, at, at + width)
        at += width + 1
    if ui.sort == WORST:
        header.stylize(BOLD + MARK, 0, MARK_WIDTH + 6)
    return header


def _row(row: Row, table: Layout, *, chosen: bool) -> Text:
    text = table.row(row)
    if row.state is not StreamState.STREAMING:
        text = text[: -table.widths[-1]] + fit(state_text(row), table.widths[-1])
    style = _style(row)
    return Text.assemble((mark(row), GOOD if style is PLAIN else style), " ", (text, SELECTED if chosen else style))


def _style(row: Row) -> Style:
    if row.state is StreamState.STREAMING:
        return MARK if troubled(row) else PLAIN
    return DIM if row.state is StreamState.WAITING else BAD


def _chosen(snapshot: Snapshot, rows: npt.NDArray[np.intp], selected: int, ui: Ui, page: str) -> Iterator[Text]:
    """The selected stream in words, on two lines."""
    if not len(rows):
        yield Text(
            f"no stream with {visible(ui.filter)!r}; ESC shows all" if ui.filter else "nothing has come yet", DIM
        )
        yield Text()
        return
    row = snapshot.row(int(rows[selected]))
    sort = f", by {ui.sort}" if ui.sort else ""
    where = " ".join(filter(None, (row.transport, row.where)))
    yield Text.assemble(
        (f"{page}{sort}{' backwards' if ui.backwards else ''}   ", DIM),
        (f"▸ {visible(row.name)}", BOLD),
        f"  {where}  {row.state if row.state is StreamState.STREAMING else state_text(row)}"
        + (f"  {row.stations} stations" if row.stations > 1 else ""),
    )
    yield Text(visible("  ".join(_details(row))))


def _details(row: Row) -> Iterator[str]:
    if row.frames:
        yield f"STAT {stat_text(row.stat)}"
        yield f"time {time_quality_text(row.time_quality)}"
        yield f"{number(row.frames, 9)} frames, {row.late} late, {row.stale} stale"
        yield f"in all p99 {milliseconds(row.all_p99_ms)} max {milliseconds(row.all_max_ms)} ms"
    if row.news:
        yield f"{row.news} ({seconds(row.news_s)} ago)"


def _sorted(snapshot: Snapshot, ui: Ui) -> npt.NDArray[np.intp]:
    by = next((shown for shown in VIEWS[ui.view] if shown.column.title == ui.sort and shown.by), None)
    if ui.sort == WORST:
        rows = snapshot.worst_first()
    elif by is None:
        rows = np.arange(len(snapshot))
    else:
        values = snapshot.column(by.by)
        if values.dtype.kind in "US":
            names = [str(value).lower() for value in values]
            rows = np.array(sorted(range(len(names)), key=names.__getitem__), np.intp)
        else:
            keys = values.astype(np.float64) * (-1 if by.falling else 1)
            rows = np.argsort(keys, kind="stable")  # NaN last
    return rows[::-1] if ui.backwards else rows


def _said(snapshot: Snapshot, row: int) -> str:
    """What a filter looks at."""
    columns = snapshot.columns
    words = (str(columns[name][row]) for name in ("name", "idcode", "transport", "where"))
    return " ".join((*words, STATES[columns["state"][row]])).lower()
