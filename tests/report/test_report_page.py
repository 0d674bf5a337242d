"""The page of a measured run: what is on it, that it is sound, and that it loads nothing."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from support.measured import START_NS
from support.reported import Made, clock, eight, run_of
from support.webpage import Element, everything, parsed, references

import pmutools
from pmutools.errors import SettingsError, SourceError
from pmutools.measure.compare import compare
from pmutools.measure.run import Run
from pmutools.measure.summary import summary
from pmutools.report.characterizer import compose, write_report
from pmutools.report.definitions import TERMS
from pmutools.report.findings import headline
from pmutools.report.page import require_extra
from pmutools.report.view import DETAILED, View
from pmutools.timebase import NS

LIMITS = "delay_p99<=90ms,loss<=0.1%"


@cache
def judged() -> tuple[Run, str, Element]:
    """Eight streams, one of which breaks limits, compared with an earlier run; the page, and as parsed."""
    before = json.loads(json.dumps(eight(fits=False).summary))
    before["streams"].pop()
    run = eight(
        require=LIMITS, command="pmu characterize --ini pmus.ini --out report", news=[(START_NS, "N4: connection lost")]
    )
    run = replace(run, differences=compare(before, run.summary), compared_with="monday")
    text, _ = compose(run)
    return run, text, parsed(text)


def rows(table: Element) -> list[list[Element]]:
    (body,) = table.find("tbody")
    return [row.inside for row in body.find("tr")]


def by_id(page: Element, name: str) -> Element:
    (found,) = (each for each in everything(page) if each.attributes.get("id") == name)
    return found


def exact(cell: Element) -> float | None:
    return float(cell.attributes["data-v"]) if "data-v" in cell.attributes else None


def test_it_says_first_whether_the_limits_hold() -> None:
    run, _, page = judged()
    (header,) = page.find("header")
    failed = [verdict for verdict in run.verdicts if not verdict.holds]
    assert f"Not acceptable: {len(failed)} of {len(run.verdicts)} limits do not hold" in header.words()
    assert "loss<=0.1% fails for 1 of 8 streams" in header.words()
    shown = [[cell.words() for cell in row] for row in rows(by_id(page, "limits-failed"))]
    assert [row[:2] for row in shown] == [[each.requirement.text, each.stream] for each in failed]
    held = replace(run, verdicts=[verdict for verdict in run.verdicts if verdict.holds])
    assert f"Acceptable: all {len(held.verdicts)} limits hold" in parsed(compose(held)[0]).find("header")[0].words()


def test_limits_that_hold_by_a_clock_that_nobody_knows_are_not_plainly_acceptable() -> None:
    sure = run_of([Made("N1", 20)], require="delay_p99<=90ms")
    assert "Nobody" not in headline(View(sure)).text and headline(View(sure)).tone == "good"
    unsure = run_of([Made("N1", 20)], require="delay_p99<=90ms", clock_log=clock(None))
    assert "how wrong the delays of N1 are: their limits hold by the clocks as they were" in headline(View(unsure)).text
    p99 = sure.summary["streams"][0]["delay_ms"]["p99"]
    near = run_of([Made("N1", 20)], require=f"delay_p99<={p99 + 0.1:.6f}ms,pdv_p99<=90ms")
    assert "1 limit of a delay holds by less than the uncertainty" in headline(View(near)).text


def test_the_ledger_beside_what_was_measured() -> None:
    run = run_of([Made("N1", 20)])
    told = run.summary["streams"][0]["delay_ms"]
    row = {
        "name": "N1",
        "received": {"sent": 90, "lost": 2},
        "missing": {"sent": 5, "lost": 7},
        "lost_on_the_way": 5,
        "contradictions": 2,
        "unknown": 1,
        "one_way_ms": told,
        "at_sender_ms": told,
    }
    page = parsed(compose(replace(run, summary={**run.summary, "ledger": {"file": "x", "streams": [row]}}))[0])
    (cells,) = rows(by_id(page, "ledger-table"))
    assert [exact(cell) for cell in cells[1:6]] == [90, 5, 7, 2, 1]
    assert [exact(cell) for cell in cells[6:10]] == [told[key] for key in ("p50", "p95", "p99", "max")]


def test_all_that_was_measured_is_told() -> None:
    run, _, page = judged()
    text = page.words()
    for stream in run.summary["streams"]:
        assert by_id(page, f"stream-{stream['idcode'] - 100}").find("h3")[0].words().startswith(stream["name"])
    for told in ("Main findings", "Diagnoses", "Stragglers", "Losses", "Delay budget", "Compared with monday", "Log"):
        assert told in [head.words() for head in page.find("h2")]
    assert "N4: connection lost" in text and run.source in text
    assert f"pmutools {pmutools.__version__}" in text and run.command in text and "kernel stamps" in text
    assert {"RFC 3393", "RFC 4737", "RFC 7679"} <= {small.text for small in page.find("small")} | {
        part for small in page.find("small") for part in small.text.split(", ")
    }
    (uneven,) = [each for each in page.find("div") if each.attributes.get("class") == "finding"]
    assert (
        "Uneven arrival" in uneven.words() and "N4" in uneven.words() and uneven.find("p")[-1].text.startswith("hold")
    )


def test_numbers_are_those_of_the_summary() -> None:
    run, _, page = judged()
    table = by_id(page, "streams-table")
    names = [head.words().removesuffix(" ?") for head in table.find("thead")[0].inside[-1].inside]
    assert len(rows(table)) == len(run.summary["streams"])
    for row, stream in zip(rows(table), run.summary["streams"], strict=True):
        found = {name: exact(cell) for name, cell in zip(names[1:], row[1:], strict=True)}
        delay = stream["delay_ms"]
        assert found == {
            "ID": stream["idcode"],
            "rate /s": stream["rate_hz"],
            **{key: stream[key] for key in ("expected", "received", "lost", "late")},
            "dupl.": stream["duplicated"],
            "reord.": stream["reordered"],
            **{key: delay[key] for key in ("p50", "p95", "p99", "max")},
            "p99 of expected": float("inf") if delay["p99_expected"] is None else delay["p99_expected"],
            "±": stream["uncertainty_ms"],
            "IPDV p99": stream["ipdv_ms"]["p99"],
            "jitter": stream["jitter_rfc3550_ms"],
            "available": stream["quality"]["availability"],
            "locked": stream["quality"]["time_quality"].get("0", 0.0),
            "empty windows": stream["per_window"]["0"] / sum(stream["per_window"].values()),
            "diag.": len(stream["diagnoses"]),
        }


def test_percentiles_twice_and_the_budget_beside_the_papers() -> None:
    run, _, page = judged()
    lossy = run.summary["streams"][3]
    received, expected, *_ = rows(by_id(page, "stream-4-percentiles"))
    keys = ("p1", "p25", "p50", "p75", "p95", "p99", "p99_9")
    assert [exact(cell) for cell in received[4:11]] == [lossy["delay_ms"][key] for key in keys]
    assert [exact(cell) for cell in expected[4:9]] == [lossy["delay_ms"][f"{key}_expected"] for key in keys[:5]]
    assert [cell.words() for cell in expected[9:12]] == ["∞", "∞", "∞"]
    parts = rows(by_id(page, "stream-4-budget"))
    assert [row[0].words() for row in parts] == [
        "PMU",
        "Communication",
        "Control processing",
        "Command",
        "Effective",
    ]
    assert [cell.words() for cell in parts[-1][4:7]] == ["82", "69", "113"]
    assert [row[7].words() for row in parts] == ["measured", "measured", "measured", "assumed", "assumed"]
    for row, told in zip(parts, lossy["budget"], strict=True):
        assert [exact(cell) for cell in row[1:4]] == [told["mean_ms"], told["min_ms"], told["max_ms"]]


def test_every_link_leads_somewhere() -> None:
    _, _, page = judged()
    ids = [each.attributes["id"] for each in everything(page) if "id" in each.attributes]
    assert len(ids) == len(set(ids))
    targets = [each.removeprefix("#") for each in references(page) if each.startswith("#")]
    assert set(targets) <= set(ids) and {term.anchor for term in TERMS} <= set(ids)
    assert {f"row-stream-{number}" for number in range(1, 9)} <= set(targets)


def test_nothing_is_loaded_from_anywhere() -> None:
    _, text, page = judged()
    for target in references(page):
        assert target.startswith("#") or re.fullmatch(r"figures/[a-z0-9-]+\.(png|svg)", target), target
    assert not {each.tag for each in everything(page)} & {"link", "iframe", "img", "object", "embed", "base", "form"}
    plotly, own = (script.text for script in page.find("script")[-2:])
    assert "plotly.js v" in plotly[:200] and text.count("plotly.js v") == plotly.count("plotly.js v")
    rest = text.replace(plotly, "")
    assert len(rest) < len(text) - 1_000_000
    assert not re.search(r"https?:|//www|@import|url\s*\(", rest)
    assert "modeBarButtons:" in own, "plotly's own choice of buttons can send data to a server"
    (policy,) = [each.attributes["content"] for each in page.find("meta") if "http-equiv" in each.attributes]
    assert policy.startswith("default-src 'none'; ")
    for script in (plotly, own):
        assert base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() in policy
    assert not [name for each in everything(page) for name in each.attributes if name.startswith("on")]


@pytest.mark.parametrize(
    "name", ["<script>alert(1)</script>", "</script><b>", '"><img src=x onerror=alert(1)>', "a&lt;b"]
)
def test_names_cannot_become_markup(name: str) -> None:
    harmless, hostile = (
        compose(run_of([Made(each, 5), Made("N2", 5)], source=each, news=[(START_NS, each)])) for each in ("N1", name)
    )
    page, page_of_harmless = parsed(hostile[0]), parsed(harmless[0])
    assert [each.tag for each in everything(page)] == [each.tag for each in everything(page_of_harmless)]
    assert name in page.words() and name in by_id(page, "stream-1").find("h3")[0].words()
    for script in page.find("script", type="application/json"):
        figure = json.dumps(json.loads(script.text))
        assert "<" not in re.sub("<br>|<extra></extra>", "", figure), "plotly would read markup in it"


def test_what_does_not_print_is_marked() -> None:
    text, figures = compose(run_of([Made("N\x00\u202e1"), Made("N1" * 99), Made("N1"), Made("N1"), Made("")]))
    assert "\x00" not in text and "\u202e" not in text and "N\ufffd\ufffd1" in text
    labels = next(figure for figure in figures if figure.name == "delays").panels[0].y.names
    assert labels == ["N\ufffd\ufffd1", "N1" * 11 + "N…", "N1", "N1#2", "unnamed"]
    stems = {figure.name for figure in figures}
    assert len(stems) == len(figures) and all(re.fullmatch(r"[a-z0-9-]+", stem) for stem in stems)


def test_eight_streams_are_a_few_megabytes() -> None:
    _, text, _ = judged()
    assert 1_000_000 < len(text.encode()) < 8_000_000


def many(number: int) -> Run:
    """A run of many streams: a few, over and over, by other names; each tenth of them is worse."""
    few = run_of([Made(f"P{seed}", 8, 50, loss=0.2 * (seed == 3), seed=seed) for seed in range(10)], fits=False)
    streams = [few.summary["streams"][at % 10] | {"name": f"P{at}"} for at in range(number)]
    return replace(
        few,
        summary=few.summary | {"streams": streams},
        results=[few.results[at % 10] for at in range(number)],
        courses=[few.courses[at % 10] for at in range(number)],
    )


def test_a_thousand_streams_are_bounded() -> None:
    text, figures = compose(many(1000))
    page = parsed(text)
    assert len(text.encode()) < 16_000_000
    assert len(figures) <= 4 * DETAILED + 6
    assert len(rows(by_id(page, "streams-table"))) == 1000
    drawn = {each.attributes["id"] for each in page.find("section")}
    assert len(drawn) == DETAILED and drawn <= {f"stream-{at + 1}" for at in range(3, 1000, 10)}, (
        "the worst by the rule"
    )
    assert "the largest share of expected frames that cannot be used" in page.words()


SCENES: dict[str, Any] = {
    "no frame came": lambda: run_of([Made("N1", 0), Made("N2", 0)], align=False),
    "no stream": lambda: Run(summary([], clock()), [], []),
    "nobody saw them come": lambda: run_of([Made("N1", unseen=True, loss=0.05)]),
    "one frame": lambda: run_of([Made("N1", 1 / 60)]),
    "no clock": lambda: run_of([Made("N1", behind_s=-4), Made("N2")], clock_log=clock(None)),
    "days behind": lambda: run_of([Made("N1", behind_s=413_856), Made("N2", loss=0.1)]),
    "always the same": lambda: run_of([Made("N1", spread_ms=0.0), Made("N2", 300, rate=1)], align=False),
    "no courses": lambda: replace(run_of([Made("N1")]), courses=[None]),
}


@pytest.mark.parametrize("scene", SCENES)
def test_any_run_has_a_sound_page(scene: str) -> None:
    text, _ = compose(SCENES[scene]())
    words = parsed(text).words()
    assert not re.search(r"\b(nan|None|inf)\b", words)
    expected = {
        "no frame came": "Nothing was measured",
        "no stream": "Nothing was measured",
        "nobody saw them come": "Nobody saw the frames come",
        "no clock": "below zero",
        "days behind": "are a clock's error (median of N1: 4 d 18 h)",
    }
    assert expected.get(scene, "Not judged") in words


def test_intervals_are_drawn() -> None:
    told = eight(fits=False).summary["all"]
    run = replace(run_of([Made("N1")]), intervals=[(START_NS + at * NS, told) for at in range(3000)])
    _, figures = compose(run)
    figure = next(figure for figure in figures if figure.name == "intervals")
    assert all(len(mark.x) <= 1024 for panel in figure.panels for mark in panel.marks)  # type: ignore[union-attr]


def test_what_is_missing_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    require_extra()
    for name in ("jinja2", "plotly", "matplotlib"):
        with monkeypatch.context() as patched:
            patched.setitem(sys.modules, name, None)
            with pytest.raises(SettingsError, match=rf"needs {name}.*pip install '\.\[analysis\]'"):
                write_report(run_of([Made("N1", 1)]), Path("nowhere"))
    assert not Path("nowhere").exists()


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SourceError, match=r"file.figures: cannot make"):
        write_report(run_of([Made("N1", 1)]), tmp_path / "file")


def shown(path: Path, *options: str) -> str:
    """The page as a browser has drawn it, with all names of the network unknown."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        pytest.skip("no Chromium is installed")
    done = subprocess.run(
        [
            browser,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            f"--user-data-dir={path.parent / 'profile'}",
            "--host-resolver-rules=MAP * ~NOTFOUND",
            "--virtual-time-budget=20000",
            *options,
            "--dump-dom",
            path.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.stdout, done.stderr[-2000:]
    return done.stdout


@pytest.mark.peer
@pytest.mark.slow
def test_a_browser_draws_all_of_it_offline(tmp_path: Path) -> None:
    """Where a browser is: every figure is drawn, with the page's own policy on."""
    text, figures = compose(run_of([Made("<b>N1", 10), Made("N2", 10, loss=0.1)], require=LIMITS))
    path = tmp_path / "report.html"
    path.write_text(text, encoding="utf-8")
    drawn = shown(path)
    plots = [each for each in drawn.split('class="')[1:] if each.startswith("plot js-plotly-plot")]
    assert len(plots) == len(figures)
    assert drawn.count('class="main-svg"') >= len(figures)
    assert "modebar-btn" in drawn and "sendDataToCloud" not in drawn.partition("<script>")[0]


@pytest.mark.peer
@pytest.mark.slow
@pytest.mark.parametrize(("width_px", "higher_px"), [(500, 40), (1300, 0)])
def test_words_beside_bars_stand_below_them_where_it_is_narrow(width_px: int, higher_px: int, tmp_path: Path) -> None:
    text, figures = compose(run_of([Made("N1", 4), Made("N2", 4)], fits=False))
    (windows,) = (figure for figure in figures if figure.name == "windows")
    path = tmp_path / "report.html"
    path.write_text(text, encoding="utf-8")
    (plot,) = re.findall(
        r'<div class="plot[^>]*aria-label="Share of control windows[^>]*>', shown(path, f"--window-size={width_px},900")
    )
    assert f"height: {windows.height_px + higher_px}px" in plot.replace("height:", "height: ").replace("  ", " ")
