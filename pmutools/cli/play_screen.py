"""The interactive player's screen: a player's state and the person's, drawn for a size; pure.

Every line is a rich Text of its own, so that only lines that have changed need to be drawn again.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from rich.text import Text

from pmutools.cli.columns import fit, layout, number
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
from pmutools.cli.play_keys import KEYS, PROMPTS, Ui, chosen, seconds
from pmutools.cli.shell import visible
from pmutools.cli.status_text import COLUMNS, faults_text, misses_text, speed_text
from pmutools.tools.player.status import PlayerStatus, PlayState

HEAD = 5
"""Lines above the streams, with the header of their table."""
FOOT = 3
"""Lines below them and the events: selected stream, message, help."""

STATES = {PlayState.PLAYING: GOOD, PlayState.PAUSED: MARK, PlayState.WAITING: BOLD, PlayState.ENDED: BAD}


class Title(NamedTuple):
    """What is played, and to whom."""

    source: str
    targets: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.source} → {', '.join(self.targets)}" if self.targets else self.source


def page_rows(height: int) -> int:
    """How many streams fit."""
    return room_between(height, HEAD + FOOT)


def lines(
    status: PlayerStatus, ui: Ui, title: Title, width: int, height: int, reached: float | None = None
) -> Iterator[Text]:
    """The screen: exactly ``height`` lines, none wider than ``width``, each made when it is asked for.

    ``reached`` is the speed that was measured.
    """
    if ui.help:
        drawn = help_page(f"pmu play {title}", ((key.shown, key.meaning) for key in KEYS), width, height)
    else:
        drawn = _lines(status, ui, title, width, height, reached)
    return fitted(drawn, width, height)


def _lines(
    status: PlayerStatus, ui: Ui, title: Title, width: int, height: int, reached: float | None
) -> Iterator[Text]:
    rows = page_rows(height)
    yield Text(fit(visible(f"pmu play {title}"), width), BOLD)
    yield _state(status, reached)
    yield _bar(status, ui, width)
    yield _late(status, ui)
    count = len(status.streams)
    selected = min(ui.selected, count - 1)
    top = max(selected, 0) // rows * rows
    page = status.streams[top : top + rows]
    table = layout(COLUMNS, width)
    yield Text(table.header(), HEADER)
    for index, stream in enumerate(page, top):
        style = SELECTED if index == selected else DIM if not stream.enabled else PLAIN
        yield Text(table.row(stream), style)
    yield _chosen(status, ui, f"{top + 1}-{top + len(page)} of {count}" if count > rows else f"{count} streams")
    yield from event_lines(ui.events, height - HEAD - len(page) - FOOT)
    yield _message(ui, status, width)
    yield help_line([key.label for key in KEYS], width)


def _state(status: PlayerStatus, reached: float | None) -> Text:
    speed = f"speed ×{speed_text(status.speed)}" + (f" reached {reached:.3f}" if reached is not None else "")
    return Text.assemble(
        (f"{status.state.upper():<8}", STATES[status.state]),
        f"{status.position_s:.3f} / {status.length_s:.3f} s  loop {status.loop}  {speed}  "
        f"{number(status.frames_per_s)} frames/s",
    )


def _bar(status: PlayerStatus, ui: Ui, width: int) -> Text:
    """Where in the source; A and B over it."""
    cells = width - 2

    def cell(position_s: float) -> int:
        return max(0, min(int(position_s / status.length_s * cells), cells - 1)) if status.length_s > 0 else 0

    here = cell(status.position_s)
    bar = Text.assemble(("[", DIM), ("━" * here, GOOD), ("●", BOLD), ("─" * (cells - here - 1), DIM), ("]", DIM))
    marks = [*zip("AB", status.between, strict=True)] if status.between else []
    if ui.mark_a is not None and (status.between is None or ui.mark_a != status.between[0]):
        marks.append(("a", ui.mark_a))
    for letter, position_s in marks:
        at = 1 + cell(position_s)
        bar = Text.assemble(bar[:at], (letter, MARK), bar[at + 1 :])
    return bar


def _late(status: PlayerStatus, ui: Ui) -> Text:
    pacing = status.pacing
    text = (
        f"{number(status.sent)} sent   late p50 {number(pacing.p50_us)}  p99 {number(pacing.p99_us)}  "
        f"max {number(pacing.max_us)} us   "
        f"{misses_text(pacing.misses)}"
    )
    between = f"   A-B {seconds(status.between[0])} .. {seconds(status.between[1])} s" if status.between else ""
    marked = f"   A marked at {seconds(ui.mark_a)} s" if ui.mark_a is not None and not between else ""
    return Text.assemble(text, (between + marked, MARK))


def _chosen(status: PlayerStatus, ui: Ui, page: str) -> Text:
    """Which streams the page shows, and the selected one's faults, whole."""
    if (stream := chosen(ui, status)) is None:
        return Text("no streams", DIM)
    faults = visible(faults_text(stream.faults)) or "no faults"
    return Text.assemble((f"{page}   ", DIM), (f"▸ {visible(stream.name)}", BOLD), f"  {faults}")


def _message(ui: Ui, status: PlayerStatus, width: int) -> Text:
    """The prompt, or what was said last; both if what was typed was wrong."""
    asked = None
    if ui.prompt is not None:
        stream = chosen(ui, status)
        asked = PROMPTS[ui.prompt.kind].format(visible(stream.name) if stream else "")
    return prompt_line(asked, ui.prompt.text if ui.prompt else "", ui.message, width, error=ui.error)
