"""How the live displays look: styles, and lines that all of them have."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from rich.cells import cell_len
from rich.style import Style
from rich.text import Text

from pmutools.cli.columns import fit
from pmutools.cli.keys import help_words
from pmutools.cli.shell import visible

SMALLEST = (40, 10)
"""Columns and lines that a display needs."""
MORE_EVENTS = 8
PLAIN = Style()
BOLD = Style(bold=True)
DIM = Style(dim=True)
HEADER = Style(underline=True)
SELECTED = Style(reverse=True)
GOOD = Style(color="green", bold=True)
BAD = Style(color="red", bold=True)
MARK = Style(color="magenta", bold=True)
"""Colours that can be read on dark and on light; all is said in words or signs too, as there may be none."""


def room_between(height: int, around: int) -> int:
    """How many rows of a table fit between ``around`` lines, with a line for events, or three on a high screen."""
    return max(1, height - around - (1 if height < 30 else 3))


def event_lines(events: Sequence[str], space: int) -> Iterator[Text]:
    """``space`` lines, with the newest of ``events`` at their end."""
    shown = events[-min(space, MORE_EVENTS) :] if space else ()
    yield from (Text() for _ in range(space - len(shown)))
    yield from (Text(visible(event), DIM) for event in shown)


def help_line(labels: Sequence[str], width: int) -> Text:
    """The line of keys."""
    words = help_words(labels, width)
    gap = "  " if len("  ".join(words)) <= width else " "
    line = Text()
    for word in words:
        key, _, label = word.partition(" ")
        line.append(key, BOLD).append(f" {label}{gap}", DIM)
    line.rstrip()
    return line


def help_page(title: str, keys: Iterable[tuple[str, str]], width: int, height: int) -> Iterator[Text]:
    """All keys: what each is called, and what it means."""
    yield Text(fit(visible(title), width), BOLD)
    for shown, meaning in [*keys][: height - 2]:
        yield Text.assemble((f"{shown:>8}  ", BOLD), meaning.replace("`", ""))
    yield Text("any key goes back", DIM)


def prompt_line(asked: str | None, typed: str, said: str, width: int, *, error: bool = False) -> Text:
    """What is asked for and typed, or what was said last; both if what was typed was wrong."""
    told = Text(visible(said), BAD if error else PLAIN)
    if asked is None:
        return told
    text = visible(typed)
    room = max(8, (width if not error else width // 2) - cell_len(asked) - 2)
    tail = text if cell_len(text) <= room else f"…{text[1 - room :]}"
    return Text.assemble((asked, BOLD), tail, (" ", SELECTED), "   " if error else "", told)


def fitted(lines: Iterator[Text], width: int, height: int) -> Iterator[Text]:
    """Exactly ``height`` lines, none wider than ``width``, each made when it is asked for."""
    if width < SMALLEST[0] or height < SMALLEST[1]:
        lines = iter([Text("too small: {}x{} needed".format(*SMALLEST))])
    for _ in range(height):
        line = next(lines, None) or Text()
        if cell_len(line.plain) > width:
            line.truncate(width)
        yield line
