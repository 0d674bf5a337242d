"""The picture of the interactive player, ``docs/img/player.svg``; to make it anew::

    PYTHONPATH=. python docs/generate/display.py

It is drawn by the code that draws on the terminal, of a state that is written here.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable
from pathlib import Path

from rich._export_format import CONSOLE_SVG_FORMAT
from rich.console import Console, Group
from rich.terminal_theme import MONOKAI
from rich.text import Text

from pmutools.cli.play_keys import Ui
from pmutools.cli.play_screen import Title, lines
from pmutools.tools.player.status import PacingStatus, PlayerStatus, PlayState, StreamStatus

PICTURE = Path(__file__).parents[1] / "img" / "player.svg"
SIZE = (112, 22)
TITLE = Title("captures/cjb-8pmu.pcap", ("udp://127.0.0.1:4713", "tcp://0.0.0.0:4712"))
NAMES = ("N1", "N2", "N3", "N4", "S1", "S2", "S3", "S4")
FAULTS = {"N2": {"loss": "gemodel(1%,20%)"}, "S1": {"delay": "normal(16,2) corr=30%"}}
LOST = {"N2": 47}


def state() -> PlayerStatus:
    """Eight PMUs, amid an A-B loop; one with losses, one with a delay, one switched off."""
    streams = tuple(
        StreamStatus(
            name,
            101 + number,
            name != "S3",
            2 if number < 2 else 1,
            {
                "sent": 4350 - LOST.get(name, 0) - 600 * (name == "S3"),
                "lost": LOST.get(name, 0),
                "disabled": 600 * (name == "S3"),
            },
            PacingStatus(19.0 + number, 171.0 + 5 * number, 640.0 + 31 * number, number // 7),
            FAULTS.get(name, {}),
        )
        for number, name in enumerate(NAMES)
    )
    sent = sum(stream.fates["sent"] for stream in streams)
    pacing = PacingStatus(22.0, 186.0, 857.0, 1)
    return PlayerStatus(PlayState.PLAYING, 12.533, 30.0, 2, 1.0, (5.0, 20.0), 72.5, 420.0, sent, pacing, streams)


def ui() -> Ui:
    """The second stream selected, some things done."""
    events = ("127.0.0.1:50412 connected", "127.0.0.1:50412 started 101", "control client: disable S3")
    return Ui(selected=1, message='fault "N2" loss=gemodel(1%,20%)', events=events)


def exported(drawn: Iterable[Text], size: tuple[int, int], title: str, unique_id: str) -> str:
    """A screen as SVG, with the reader's own fonts: a page that is read offline can fetch none."""
    console = Console(file=io.StringIO(), record=True, width=size[0], height=size[1], force_terminal=True)
    console.print(Group(*drawn), end="")
    own = re.sub(r"@font-face \{\{.*?\}\}\n", "", CONSOLE_SVG_FORMAT, flags=re.DOTALL)
    own = own.replace("font-family: Fira Code, monospace", "font-family: monospace")
    return console.export_svg(title=title, theme=MONOKAI, code_format=own, unique_id=unique_id)


def svg() -> str:
    """The picture."""
    return exported(lines(state(), ui(), TITLE, *SIZE, 1.0), SIZE, "pmu play --interactive", "player")


if __name__ == "__main__":
    PICTURE.write_text(svg(), encoding="utf-8")
