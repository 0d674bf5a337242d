"""The interactive player's screen, as text: what is told, at every size."""

from __future__ import annotations

from dataclasses import replace

import pytest
from rich.cells import cell_len
from rich.text import Text
from support.controlled import player_status, stream_status

from pmutools.cli.play_keys import KEYS, Prompt, Ui
from pmutools.cli.play_screen import Title, lines, page_rows
from pmutools.tools.player.status import PacingStatus, PlayerStatus, PlayState

TITLE = Title("cjb-8pmu.pcap", ("udp://127.0.0.1:4713", "tcp://0.0.0.0:4712"))


def picture(status: PlayerStatus, ui: Ui, size: tuple[int, int], reached: float | None = None) -> list[Text]:
    return list(lines(status, ui, TITLE, *size, reached))


def drawn(
    status: PlayerStatus | None = None,
    ui: Ui | None = None,
    size: tuple[int, int] = (80, 24),
    reached: float | None = None,
) -> list[str]:
    lines = picture(status or player_status(), ui or Ui(), size, reached)
    return [line.plain for line in lines]


def test_what_is_told() -> None:
    lines = drawn(reached=0.9987)
    assert lines[0].rstrip() == "pmu play cjb-8pmu.pcap → udp://127.0.0.1:4713, tcp://0.0.0.0:4712"
    assert lines[1] == "PLAYING 12.500 / 30.000 s  loop 2  speed ×1.0 reached 0.999  480 frames/s"
    assert lines[3] == "14400 sent   late p50 21  p99 180  max 904 us   2 misses   A-B 5 .. 20 s"
    assert lines[4].split() == [
        "stream",
        "id",
        "on",
        "to",
        "sent",
        "lost",
        "drop",
        "disab",
        "p50us",
        "p99us",
        "maxus",
        "faults",
    ]
    assert lines[7].split() == ["S1", "103", "OFF", "1", "1802", "34", "0", "60", "23", "180", "904"]
    assert lines[13] == "8 streams   ▸ N1  no faults"
    assert drawn(ui=Ui(selected=1))[13] == "8 streams   ▸ N2  loss=gemodel(1%,20%)  delay=normal(16,2) corr=30%"


def test_the_bar() -> None:
    bar = drawn()[2]
    assert len(bar) == 80
    assert bar.index("A") == 1 + int(5 / 30 * 78)
    assert bar.index("●") == 1 + int(12.5 / 30 * 78)
    assert bar.index("B") == 1 + int(20 / 30 * 78)
    no_loop = replace(player_status(), between=None)
    assert "a" in drawn(no_loop, Ui(mark_a=3.0))[2]
    assert "A marked at 3 s" in drawn(no_loop, Ui(mark_a=3.0))[3]
    for position_s, length_s in ((0.0, 0.0), (99.0, 30.0), (-1.0, 30.0), (30.0, 30.0)):
        assert "●" in drawn(replace(no_loop, position_s=position_s, length_s=length_s))[2]


@pytest.mark.parametrize("size", [(40, 10), (60, 12), (80, 24), (120, 30), (200, 50), (300, 100), (39, 5), (1, 1)])
@pytest.mark.parametrize("streams", [0, 1, 8, 2000])
@pytest.mark.parametrize("ui", [Ui(), Ui(help=True), Ui(prompt=Prompt("fault", "x" * 500), selected=1999)])
def test_it_fits(size: tuple[int, int], streams: int, ui: Ui) -> None:
    lines = drawn(player_status(streams), ui, size)
    assert len(lines) == size[1]
    assert all(cell_len(line) <= size[0] for line in lines)


def test_pages_of_streams() -> None:
    status = player_status(2000)
    rows = page_rows(24)
    lines = drawn(status, Ui(selected=rows + 2, rows=rows))
    assert lines[5].split()[0] == f"PMU-{rows:04d}"
    assert lines[5 + rows].startswith(f"{rows + 1}-{2 * rows} of 2000   ▸ PMU-{rows + 2:04d}")
    assert drawn(status, Ui(selected=5000))[5 + 1999 % rows].startswith("PMU-1999")


def test_events_messages_and_prompts() -> None:
    ui = Ui(events=("10.0.0.1:5000 started 101", "control: seek 5"), message="speed 2")
    lines = drawn(ui=ui)
    assert lines[-4:-1] == ["10.0.0.1:5000 started 101", "control: seek 5", "speed 2"]
    assert drawn(player_status(2000), ui)[-3] == "control: seek 5"
    ui = Ui(prompt=Prompt("fault", "loss=5"), selected=1)
    assert drawn(ui=ui)[-2].rstrip() == "fault of N2: loss=5"
    ui = replace(ui, message="5 is not a probability", error=True)
    assert " ".join(drawn(ui=ui)[-2].split()) == "fault of N2: loss=5 5 is not a probability"
    error = picture(player_status(), ui, (80, 24))[-2]
    assert any("red" in str(span.style) for span in error.spans)


def test_the_help_line_is_made_of_the_keys() -> None:
    assert drawn(size=(200, 24))[-1] == "  ".join(key.label for key in KEYS if key.label)
    for width in range(40, 200):
        line = drawn(size=(width, 24))[-1]
        assert len(line) <= width
        assert line.startswith("SPACE pause")
        assert line.split()[-4:] == ["?", "help", "q", "quit"]
    assert "e off f fault" in drawn()[-1]


def test_the_help_page_has_all_keys_at_80_by_24() -> None:
    lines = drawn(ui=Ui(help=True))
    for key in KEYS:
        assert any(line.startswith(f"{key.shown:>8}  {key.meaning.replace('`', '')}") for line in lines), key.shown
    assert lines[-1] == "any key goes back"


def test_what_devices_call_themselves_does_no_harm() -> None:
    hostile = replace(stream_status(0), name="\x1b[2J\n[red]x", faults={"loss": "\x1b]0;x\x07"})
    lines = drawn(replace(player_status(), streams=(hostile,)))
    assert all(line.isprintable() for line in lines)
    assert any("[red]x" in line for line in lines)


def test_a_player_that_has_sent_nothing() -> None:
    nan = float("nan")
    waiting = replace(
        player_status(1), state=PlayState.WAITING, pacing=PacingStatus(nan, nan, nan, 0), frames_per_s=nan, between=None
    )
    lines = drawn(waiting)
    assert lines[1].startswith("WAITING ")
    assert lines[3] == "1800 sent   late p50 -  p99 -  max - us   0 misses"
