"""The live displays' screen, as text: what is told, at every size."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from rich.cells import cell_len
from rich.text import Text
from support.watched import ROUND_NS, block, watched

from pmutools.c37118.constants import Stat
from pmutools.cli.quality_text import stat_text, time_quality_text
from pmutools.cli.terminal import _PLAIN_TEXT
from pmutools.cli.watch_columns import (
    BARS,
    MEANINGS,
    SIGNS,
    VIEWS,
    hertz,
    mark,
    milliseconds,
    percent,
    seconds,
    sparkline,
)
from pmutools.cli.watch_keys import WORST, Command, Ui
from pmutools.cli.watch_screen import lines, listed, page_rows, status_line
from pmutools.flow import Flow
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.tools.watch import Snapshot, StreamState, Watch

TITLE = "pmu read live.csv ← udp://0.0.0.0:4713"
FACTS = ("clock within 0.08 ms, by chrony", "live.csv 12.3 MB")
TRIGGER = Command("t", "t trigger", "Write out what the ring buffer holds.", lambda: "written")


@cache
def snapshot(streams: int = 8) -> Snapshot:
    rounds = 60 if streams <= 8 else 3
    return watched(streams, rounds).look(rounds * ROUND_NS) if streams else Watch().look(ROUND_NS)


def picture(of: Snapshot, ui: Ui, size: tuple[int, int]) -> list[Text]:
    return list(lines(of, ui, TITLE, FACTS, *size, [TRIGGER]))


def drawn(streams: int = 8, ui: Ui | None = None, size: tuple[int, int] = (80, 24)) -> list[str]:
    return [line.plain.rstrip() for line in picture(snapshot(streams), ui or Ui(), size)]


FREQUENCY = """\
pmu read live.csv ← udp://0.0.0.0:4713
LIVE 00:00:14  7 of 8 streaming  418.0 frames/s  lost 41  dup 0  own drops 0
clock within 0.08 ms, by chrony   live.csv 12.3 MB
  stream          id  frm/s  lost good%  p99ms       Hz last 15 s
● N1             101   60.0     0   100   30.7  59.9882 ▂▁▁▂▅▇██▇▅▂▁▁▂▅▇██▇▅▂▁▁▂
▲ N2             102   57.8    41   100   30.9  60.0073 ▁▁▃▆███▆▃▁▁▁▃▆███▆▃▁▁▁▃▆
● N3             103   60.0     0   100   28.5  60.0196 ▂▅▇██▇▄▂▁▁▂▅▇██▇▄▂▁▁▂▅▇█
▲ N4             104   60.0     0     0   28.4  60.0139 ▆██▇▅▃▁▁▂▄▆██▇▅▃▁▁▂▄▆██▇
▲ S1             105   60.0     0   100  271.5  59.9954 ██▆▄▁▁▁▃▅███▆▄▁▁▁▃▅███▆▄
● S2             106   60.0     0   100   29.9  59.9811 ▇▅▂▁▁▂▄▇██▇▅▂▁▁▂▄▇██▇▅▂▁
■ S3             107   31.5     0   100   27.5  59.9944 silent 5 s
● S4             108   60.0     0   100   29.7  60.0018 ▁▁▂▅▇██▇▄▂▁▁▂▅▇██▇▄▂▁▁▂▅
1-8 of 8   ▸ N2  udp 10.0.0.1  streaming
STAT ok  time locked  859 frames, 0 late, 0 stale  in all p99 30.2 max 39.9 ms"""


def test_frequency_at_80_by_24() -> None:
    screen = drawn(ui=Ui(selected=1, events=("udp://0.0.0.0:4713 bound",)))
    for line, expected in zip(screen, FREQUENCY.splitlines(), strict=False):
        assert shape(line) == shape(expected)
    assert screen[-3] == "udp://0.0.0.0:4713 bound"
    assert screen[-1] == "t trigger ↑↓ select v view s sort w worst / filter SPACE freeze ? help q quit"


def shape(line: str) -> str:
    """Names, signs and places, but not every digit: those are the watch's, tested there."""
    return "".join("0" if c.isdigit() else "▁" if c in BARS else c for c in line)


def test_delay_at_80_by_24() -> None:
    screen = drawn(ui=Ui(view="delay", selected=4))
    assert screen[3] == "  stream        id  p50ms  p99ms  maxms   jit loss%  dup  late cmpl% last 15 s"
    s1 = screen[8].split()
    assert s1[:3] == ["▲", "S1", "105"]
    assert float(s1[3]) < 25 < 250 < float(s1[4]) <= float(s1[5])
    assert s1[7:11] == ["0", "0", "15", "97.5"]
    assert s1[11][-3] == "█"
    n2 = screen[5].split()
    assert 3 < float(n2[7]) < 8
    assert float(n2[7]) + float(n2[10]) == pytest.approx(100)
    assert screen[12].startswith("1-8 of 8   ▸ S1  udp 10.0.0.4  streaming")


def test_wide_screens_tell_more() -> None:
    for view in VIEWS:
        narrow, wide = (drawn(ui=Ui(view=view), size=(width, 24))[3].split() for width in (80, 150))
        assert set(narrow) < set(wide)
    row = drawn(ui=Ui(selected=3), size=(150, 24))[7]
    assert "not synchronised" in row
    assert " udp " in row


@pytest.mark.parametrize("size", [(40, 10), (60, 12), (80, 24), (120, 30), (200, 50), (300, 100), (39, 5), (1, 1)])
@pytest.mark.parametrize("streams", [0, 1, 8, 2000])
@pytest.mark.parametrize(
    "ui", [Ui(), Ui(view="delay", help=True), Ui(view="delay", typing=True, filter="x" * 500, selected=1999)]
)
def test_it_fits(size: tuple[int, int], streams: int, ui: Ui) -> None:
    screen = [line.plain for line in picture(snapshot(streams), ui, size)]
    assert len(screen) == size[1]
    assert all(cell_len(line) <= size[0] for line in screen)


def test_one_stream_and_none() -> None:
    assert "1 streaming" in drawn(1)[1]
    nothing = drawn(0)
    assert nothing[1] == "LIVE 00:00:00  0 streaming  0.0 frames/s  lost 0  dup 0  own drops 0"
    assert nothing[4] == "nothing has come yet"


def test_pages_of_thousands() -> None:
    rows = page_rows(24)
    screen = drawn(2000, Ui(selected=rows + 2))
    assert screen[4].split()[1] == f"PMU-{rows:04d}"
    assert screen[4 + rows].startswith(f"{rows + 1}-{2 * rows} of 2000   ▸ PMU-{rows + 2:04d}")
    assert drawn(2000, Ui(selected=5000))[4 + 1999 % rows].split()[1] == "PMU-1999"
    assert "2000 streaming" in screen[1]


def names(ui: Ui, streams: int = 8) -> list[str]:
    of = snapshot(streams)
    return [of.row(row).name for row in listed(of, ui).tolist()]


def test_sorting() -> None:
    assert names(Ui()) == ["N1", "N2", "N3", "N4", "S1", "S2", "S3", "S4"]
    assert names(Ui(sort="lost"))[0] == "N2"
    assert names(Ui(sort="p99ms"))[0] == "S1"
    assert names(Ui(sort="p99ms", backwards=True))[-1] == "S1"
    assert names(Ui(sort="good%"))[0] == "N4"
    assert names(Ui(sort="frm/s"))[:2] == ["S3", "N2"]
    assert names(Ui(sort="stream"), 2000)[:2] == ["N1", "N2"]
    assert names(Ui(sort=WORST))[:4] == ["S3", "N2", "N4", "S1"]
    assert names(Ui(view="delay", sort="late"))[0] == "S1"
    assert names(Ui(sort="no such column")) == names(Ui())


def test_filters() -> None:
    assert names(Ui(filter="N")) == names(Ui()), "streaming and silent have one too"
    assert names(Ui(filter="silent")) == ["S3"]
    assert names(Ui(filter="10.0.0.2 udp")) == ["N3"]
    assert names(Ui(filter="104")) == ["N4"]
    assert names(Ui(filter="PMU-19"), 2000) == [f"PMU-{number}" for number in range(1900, 2000)]
    assert drawn(ui=Ui(filter="nobody"))[4] == "no stream with 'nobody'; ESC shows all"
    assert drawn(ui=Ui(filter="sil", typing=True))[-2].rstrip() == "filter: sil"


def test_the_header_shows_what_is_sorted_by() -> None:
    header = picture(snapshot(), Ui(sort="p99ms"), (80, 24))[3]
    (span,) = (span for span in header.spans if "magenta" in str(span.style))
    assert header.plain[span.start : span.end].strip() == "p99ms"
    assert "by p99ms backwards" in drawn(ui=Ui(sort="p99ms", backwards=True))[12]


def test_trouble_is_a_sign_and_a_colour() -> None:
    for line in picture(snapshot(), Ui(selected=7), (80, 24))[4:11]:
        colours = {str(span.style) for span in line.spans}
        sign = line.plain[0]
        wanted = {"●": "green", "▲": "magenta", "■": "red"}[sign]
        assert any(wanted in colour for colour in colours), line.plain


def test_every_state_has_a_sign_with_a_meaning_and_a_stand_in() -> None:
    row = snapshot().row(0)
    for state in StreamState:
        sign = mark(row._replace(state=state))
        assert sign in SIGNS
        assert sign.translate(_PLAIN_TEXT).isascii() or sign == "…"
    assert BARS.translate(_PLAIN_TEXT).isascii()
    assert len(set(BARS.translate(_PLAIN_TEXT))) == len(BARS)


def test_every_column_is_explained() -> None:
    titles = {shown.column.title for view in VIEWS.values() for shown in view}
    assert titles == set(MEANINGS)


def test_what_there_is_no_stream_for() -> None:
    watch = Watch()
    flow = Flow("udp", "10.0.0.9:4000", "x")
    watch.hear(LinkEvent(LinkKind.FAILED, "tcp://10.9.9.9:4712", (0,), "connection refused"), 0)
    watch.hear(LinkEvent(LinkKind.NO_CONFIG, "udp://10.1.0.1:4713", (1,), "held", 9, flow), 0)
    screen = [line.plain.rstrip() for line in lines(watch.look(ROUND_NS), Ui(), TITLE, (), 80, 24)]
    assert "0 of 2 streaming" in screen[1]
    assert screen[4].startswith("✕ tcp://10.9")
    assert screen[4].endswith("no connection")
    assert screen[5].startswith("? IDCODE 9 ")
    assert screen[5].endswith("no configuration")
    assert screen[7].endswith("failed: connection refused (0 s ago)")


def test_what_devices_call_themselves_does_no_harm() -> None:
    watch = Watch(name=lambda flow, config: "\x1b[2J\n[red]x")
    watch.add([block(0, range(15))], ROUND_NS)
    screen = [line.plain for line in lines(watch.look(ROUND_NS), Ui(), "t\x1b]0;x\x07", ("\x1b[2J",), 80, 24)]
    assert all(line.isprintable() for line in screen)


def test_own_drops_and_skipped_bytes_are_red() -> None:
    bad = replace(snapshot(), own_drops=1234, skipped={"bad-chk": 99}, untold=7)
    line = picture(bad, Ui(), (120, 24))[1]
    assert "own drops 1234  skipped 99 B  7 frames of more streams" in line.plain
    assert sum("red" in str(span.style) for span in line.spans) >= 3
    assert status_line(bad).startswith("7 of 8 streaming  ")


def test_frozen_help_and_events() -> None:
    assert drawn(ui=Ui(frozen=True))[1].startswith("FROZEN ")
    page = drawn(ui=Ui(help=True))
    assert any(line == "       t  Write out what the ring buffer holds." for line in page)
    assert "any key goes back" in page
    many = Ui(events=tuple(f"event {number}" for number in range(30)), message="said")
    assert drawn(ui=many)[-3:-1] == ["event 29", "said"]


@pytest.mark.parametrize(
    ("values", "width", "span", "bars"),
    [
        ([1, 2, 3, 4, 5, 6, 7, 8], 8, 1, BARS),
        ([1, 2, 3, 4, 5, 6, 7, 8], 3, 1, "▁▅█"),
        ([5, 5, 5], 3, 1, "▅▅▅"),
        ([0, np.nan, 1], 3, 1, "▁ █"),
        ([np.nan, np.nan], 3, 1, ""),
        ([], 3, 1, ""),
        ([0.4, 0.6], 2, 1, "▄▅"),
        ([1, np.inf, 2], 3, 1, "▁ █"),
    ],
)
def test_sparklines(values: list[float], width: int, span: float, bars: str) -> None:
    assert sparkline(np.array(values, np.float32), width, span) == bars


def test_numbers() -> None:
    assert [milliseconds(value) for value in (float("nan"), 0.004, 9.994, 10.06, 999.4, 12345.6, 5.4e9, -3.2)] == [
        "-", "0.00", "9.99", "10.1", "999.4", "12346", "5400M", "-3.20",
    ]  # fmt: skip
    assert [percent(share) for share in (float("nan"), 0, 1, 0.0001, 0.99999, 0.052, 0.9994)] == [
        "-", "0", "100", "<0.1", ">99.9", "5.2", ">99.9",
    ]  # fmt: skip
    assert [hertz(value) for value in (59.99876, float("nan"), 1e9)] == ["59.9988", "-", "1000000k"]
    assert [seconds(value) for value in (float("nan"), 5.4, 500, 1e5)] == ["", "5 s", "8 min", "28 h"]


@pytest.mark.parametrize(
    ("stat", "text"),
    [
        (0, "ok"),
        (0x8000, "test mode or absent"),
        (0x4000, "PMU error"),
        (0xC000, "do not use"),
        (0x2030, "not synchronised, unlocked 1000 s"),
        (0x0804, "trigger: frequency"),
        (0x080A, "trigger: user-defined 10"),
        (0x1000 | Stat.CONFIG_CHANGE, "sorted by arrival, configuration will change"),
        (0x0200 | 5 << 6, "data modified, time <1 ms"),
        (7 << 6, "time >10 ms or unknown"),
    ],
)
def test_stat_in_words(stat: int, text: str) -> None:
    assert stat_text(stat) == text


@pytest.mark.parametrize(
    ("octet", "text"),
    [
        (0, "locked"),
        (1, "<1 ns"),
        (4, "<1 us"),
        (6, "<100 us"),
        (9, "<100 ms"),
        (0xB, "<10 s"),
        (0xF, "clock failed"),
        (0xC, "undefined C"),
        (0x10, "locked, leap second insertion pending"),
        (0x50, "locked, leap second deletion pending"),
        (0x24, "<1 us, leap second occurred"),
    ],
)
def test_time_quality_in_words(octet: int, text: str) -> None:
    assert time_quality_text(octet) == text
