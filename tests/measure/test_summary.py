"""``summary.json``, limits on it, and two of them compared."""

from __future__ import annotations

import json
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from support.measured import arranged, batch, config, measured, rows, stamps

from pmutools.errors import SettingsError
from pmutools.measure.clockquality import ClockLog, ClockQuality, KernelClock
from pmutools.measure.compare import compare
from pmutools.measure.completeness import Alignment
from pmutools.measure.profile import profile_text
from pmutools.measure.require import METRICS, parse_requirements, verdicts
from pmutools.measure.stream import Identity, StreamMeter
from pmutools.measure.summary import interval_summary, summary

STREAM_KEYS = [
    "name",
    "idcode",
    "transport",
    "rate_hz",
    "expected",
    "received",
    "lost",
    "duplicated",
    "reordered",
    "corrupt",
    "late",
    "off_grid",
    "silent_s",
    "own_drops",
    "delay_ms",
    "delay_locked_ms",
    "uncertainty_ms",
    "interarrival_ms",
    "ipdv_ms",
    "pdv_ms",
    "jitter_rfc3550_ms",
    "loss_runs",
    "reordering",
    "per_window",
    "completeness_vs_wait",
    "quality",
    "fit",
    "diagnoses",
]
DELAY_KEYS = ["mean", "sd", "min", "p1", "p5", "p25", "p50", "p75", "p90", "p95", "p99", "p99_9", "max"]


def clock() -> ClockLog:
    log = ClockLog()
    log.add(ClockQuality(KernelClock(0, 0.0, 200, 100, 0x2001)))
    return log


def told(lost: int = 0, delay_ms: float = 44.0, names: tuple[str, ...] = ("N1", "S1")) -> dict[str, Any]:
    alignment = Alignment(names, Fraction(60))
    results = []
    for number, name in enumerate(names):
        noise = np.random.default_rng(number).exponential(1.0, 6000)
        frames = batch(stamps(range(6000)), delay_ms + noise, of=config(idcode=101 + number))
        kept = np.arange(6000) % 1000 >= lost
        kept[[0, -1]] = True
        meter = StreamMeter(Identity(name, 101 + number, "udp"), frames.config)
        for seen in (*meter.add(arranged(rows(frames, kept))), *meter.drain()):
            alignment.add(number, *seen.unique())
        results.append(meter.result())
    alignment.close(200_000_000)
    return summary(results, clock(), [alignment])


def test_the_keys_that_scripts_hold_on_to() -> None:
    found = told(lost=3)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert list(found) == ["clock", "streams", "all"]
    for stream in found["streams"]:
        assert list(stream)[: len(STREAM_KEYS)] == STREAM_KEYS
        assert list(stream["delay_ms"])[: len(DELAY_KEYS)] == DELAY_KEYS
        assert list(stream["per_window"]) == ["0", "1", "2+"]
        assert list(stream["fit"])[:3] == ["name", "params", "ks"]
        assert stream["expected"] == stream["received"] + stream["lost"] == 6000
        assert stream["completeness_vs_wait"][-1][1] == pytest.approx(stream["received"] / 6000)
        assert stream["uncertainty_ms"] == pytest.approx(0.301)
        assert stream["fit"]["name"] == "exponential"
    assert found["all"]["expected"] == 12_000
    assert found["all"]["alignment"][0]["stamps"] == 6000
    assert found["all"]["completeness_vs_wait"][-1][1] == pytest.approx(1 - 17 / 6000)


def test_of_nothing_and_of_little() -> None:
    nothing = StreamMeter(Identity("N1", 101), config()).result()
    one = measured(batch(stamps([0]), 20.0))
    none = measured(batch(stamps(range(10)), None))
    odd = measured(batch([-(2**62), 2**62], 0.0))
    found = summary([nothing, one, none, odd], ClockLog())
    json.dumps(found, allow_nan=False)
    assert [stream["received"] for stream in found["streams"]] == [0, 1, 10, 1]
    assert found["streams"][0]["delay_ms"]["p99"] is None
    assert found["streams"][1]["delay_ms"]["p99"] == 20.0
    assert summary([], ClockLog())["all"]["streams"] == 0


def test_intervals_add_up_to_the_run() -> None:
    frames = arranged(batch(stamps(range(6000)), 44 + np.random.default_rng(1).exponential(1.0, 6000)))
    meter = StreamMeter(Identity("N1", 101), frames.config)
    parts = []
    for at in range(0, 6000, 600):
        meter.add(frames[at : at + 600])
        meter.drain()
        parts.append(interval_summary(meter.take_interval()))
    assert sum(part["received"] for part in parts) + 3 >= 6000
    assert all(part["delay_ms"]["p50"] == pytest.approx(44.7, abs=0.2) for part in parts)
    whole = meter.result()
    assert whole.counts.slots.received == 6000
    assert whole.counts.delays.delay == measured(frames).counts.delays.delay


def test_limits_become_verdicts() -> None:
    found = told(lost=3)
    limits = parse_requirements(
        "delay_p99<=60ms, loss<=0.1%, availability>=99%, corrupt<=0, N1.delay_max<1s, all.loss<1%"
    )
    judged = verdicts(limits, found)
    assert [(verdict.stream, verdict.requirement.name, verdict.holds) for verdict in judged] == [
        ("N1", "delay_p99", True),
        ("S1", "delay_p99", True),
        ("N1", "loss", False),
        ("S1", "loss", False),
        ("N1", "availability", True),
        ("S1", "availability", True),
        ("N1", "corrupt", True),
        ("S1", "corrupt", True),
        ("N1", "delay_max", True),
        ("all", "loss", True),
    ]
    assert str(judged[2]) == "FAIL N1: loss<=0.1% (0.2833%)"
    assert str(judged[0]).startswith("ok   N1: delay_p99<=60ms (48.")


def test_what_was_not_measured_does_not_hold() -> None:
    found = summary([measured(batch(stamps(range(100)), None))], ClockLog())
    for text in ("delay_p99<=60ms", "delay_p99>=0ms", "uncertainty<=1s"):
        (verdict,) = verdicts(parse_requirements(text), found)
        assert not verdict.holds
        assert "not measured" in str(verdict)
    lossy = told(lost=30)
    assert not verdicts(parse_requirements("delay_p99_expected<=1s"), lossy)[0].holds, "a lost frame never came"


def test_every_metric_can_be_limited() -> None:
    found = told()
    for name, metric in METRICS.items():
        unit = {"ms": "ms", "s": "s", "share": "%", "count": ""}[metric.unit]
        (requirement,) = parse_requirements(f"{name}>=0{unit}")
        assert all(verdict.value is not None for verdict in verdicts([requirement], found)), name


@pytest.mark.parametrize(
    ("text", "remedy"),
    [
        ("", "empty limit"),
        ("loss<=1%,", "empty limit"),
        ("loss", "write METRIC"),
        ("loss=1%", "write METRIC"),
        ("delay_p98<=1ms", "did you mean"),
        ("nonsense<=1", "known: delay_p99"),
        ("delay_p99<=90", "told in ms or us"),
        ("delay_p99<=90%", "told in ms"),
        ("loss<=5", "did you mean 5%?"),
        ("loss<=1-2%", "is not a number"),
        ("loss<=200%", "is no share"),
        ("corrupt<=1ms", "told in no unit"),
    ],
)
def test_mistakes_are_explained(text: str, remedy: str) -> None:
    with pytest.raises(SettingsError, match=remedy.replace("?", r"\?")) as caught:
        parse_requirements(text)
    assert str(caught.value).startswith("--require: ")
    assert "\n" not in str(caught.value)


def test_a_limit_that_concerns_no_stream_does_not_hold() -> None:
    (verdict,) = verdicts(parse_requirements("N11.loss<=1%"), told())
    assert not verdict.holds
    assert str(verdict) == "FAIL N11: N11.loss<=1% (no such stream; did you mean 'N1'?)"
    assert not verdicts(parse_requirements("loss<=1%"), summary([], ClockLog()))[0].holds


def dropped(lost: int, own: int) -> Any:
    """A stream that lost so many frames in a row, while its socket dropped so many datagrams."""
    result = measured(batch(stamps([*range(1000), *range(1000 + lost, 3000)])))
    result.counts.events.own_drops = own
    return result


def test_own_drops_are_no_loss_of_the_network() -> None:
    told = summary([dropped(200, 150)], ClockLog(), may_fit=lambda: False)
    (stream,) = told["streams"]
    assert (stream["lost"], stream["lost_own_at_most"], told["all"]["lost_own_at_most"]) == (200, 150, 150)
    asked = parse_requirements("loss<=1%,all.loss<=1%,loss<=10%,availability>=99%,delay_p99<=10ms")
    loss, whole, kept, available, delay = verdicts(asked, told)
    assert not loss.holds and loss.value is None and "own drops: cannot be judged" in str(loss)
    assert not whole.holds and "own drops" in str(whole)
    assert kept.holds and kept.value == pytest.approx(200 / 3000)  # even with them
    assert not available.holds and "own drops" in str(available)
    assert not delay.holds and delay.value is not None and "own drops" not in str(delay)


@pytest.mark.parametrize(("own", "loss"), [(0, "gemodel(0.0357%, 0.5000%)"), (150, None), (900, "")])
def test_a_profile_leaves_own_drops_out(own: int, loss: str | None) -> None:
    text = profile_text([dropped(200, own)])
    assert ("own drops" in text) == bool(own)
    assert ("\nloss = " in text) == (own < 200)
    if loss:
        assert f"loss = {loss}" in text


def test_two_runs_compared() -> None:
    before, after = told(names=("N1", "S1")), told(lost=10, delay_ms=60.0, names=("N1", "S2"))
    found = {(row.stream, row.metric): row for row in compare(before, after)}
    assert found["N1", "loss"].verdict == "worse"
    assert found["N1", "availability"].verdict == "worse" or found["N1", "availability"].verdict == "same"
    assert found["N1", "delay_p50"].verdict == "worse"
    assert found["N1", "delay_p50"].change == pytest.approx(16.0, abs=0.1)
    assert found["N1", "pdv_p99"].verdict == "same"
    assert found["S1", "received"].verdict == "gone"
    assert found["S2", "received"].verdict == "new"
    assert found["all", "loss"].verdict == "worse"
    assert all(row.verdict == "same" for row in compare(before, before))
    back = {(row.stream, row.metric): row.verdict for row in compare(after, before)}
    assert back["N1", "delay_p50"] == "better"


def test_every_key_is_defined_in_the_documentation() -> None:
    from pathlib import Path

    page = (Path(__file__).parents[2] / "docs" / "metrics.md").read_text(encoding="utf-8")
    named = {"name", "idcode", "transport", "where", "other_names", "streams"}  # no metrics
    events = {"events", "own_drops", "corrupt", "diagnoses", "fit", "budget"}  # tables of their own
    told_keys = {*told()["streams"][0], *told()["all"]} - named - events
    assert not {key for key in told_keys if f"`{key}`" not in page}
