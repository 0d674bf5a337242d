"""What a run comes to, in words: a verdict, the main findings, and diagnoses gathered by kind."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from pmutools.measure.diagnoses import ROWS
from pmutools.measure.histogram import NS_PER_MS
from pmutools.report.remedies import REMEDIES
from pmutools.report.text import count, lasting, listed, milliseconds, percent, plural, span
from pmutools.report.view import Stream, View
from pmutools.timebase import NS

_SILENT_S = 5.0
_APART_MS = 10_000
_SHARES = (0.9999, 0.999, 0.99, 0.9)


class Headline(NamedTuple):
    """``tone`` is good, bad, or empty."""

    tone: str
    title: str
    text: str


class Finding(NamedTuple):
    """A kind of diagnosis: its heading, its remedy, and what it says of which streams."""

    id: str
    title: str
    remedy: str
    told: list[tuple[str, list[Stream]]]


def headline(view: View) -> Headline:
    """Whether the limits hold; where there are none, that nothing is judged."""
    verdicts = view.run.verdicts
    failed = [verdict for verdict in verdicts if not verdict.holds]
    if not view.measured and not verdicts:
        return Headline("bad", "Nothing was measured", "No data frame came: there is nothing to judge.")
    if not verdicts:
        return Headline(
            "",
            "Not judged: no limits were given",
            "The main findings are below. Limits (--require, as in delay_p99<=90ms,loss<=0.1%) make this a verdict.",
        )
    meaning = f"Acceptable means: by the limits given. It is no statement that a control scheme is safe.{_unsure(view)}"
    if not failed:
        return Headline("good", f"Acceptable: {_all_limits(len(verdicts))}", meaning)
    unmeasured = sum(verdict.value is None for verdict in failed)
    text = f"What was not measured does not hold ({count(unmeasured)} of these). {meaning}" if unmeasured else meaning
    text = f"{_by_limit(view)} {text}"
    whole = f"{count(len(failed))} of {plural(len(verdicts), 'limit')} {'does' if len(failed) == 1 else 'do'} not hold"
    return Headline("bad", f"Not acceptable: {whole}", text)


def _unsure(view: View) -> str:
    """What the uncertainty of delays makes of limits that hold."""
    unknown, near = [], 0
    for stream in view.streams:
        for verdict in stream.verdicts:
            asked = verdict.requirement
            if not asked.name.startswith("delay_") or not verdict.holds or verdict.value is None:
                continue
            if stream.bound_ms is None:
                unknown.append(stream.label)
            elif abs(asked.limit - verdict.value) < stream.bound_ms:
                near += 1
    told = ""
    if unknown:
        names = listed(list(dict.fromkeys(unknown)))
        told += f" Nobody can say how wrong the delays of {names} are: their limits hold by the clocks as they were."
    if near:
        told += f" {plural(near, 'limit of a delay holds', 'limits of delays hold')} by less than the uncertainty."
    return told


def _by_limit(view: View) -> str:
    """Which limits fail, and how often."""
    told: dict[str, tuple[int, int]] = {}
    for verdict in view.run.verdicts:
        asked, failed = told.get(verdict.requirement.text, (0, 0))
        told[verdict.requirement.text] = asked + 1, failed + (not verdict.holds)
    parts = [
        f"{limit} fails" if asked == 1 else f"{limit} fails for {count(failed)} of {plural(asked, 'stream')}"
        for limit, (asked, failed) in told.items()
        if failed
    ]
    return f"{'; '.join(parts[:6])}{'; ...' if len(parts) > 6 else ''}."


def _all_limits(number: int) -> str:
    return "the limit holds" if number == 1 else f"all {count(number)} limits hold"


def main_findings(view: View) -> list[str]:
    """Sentences, the gravest first."""
    return [*_silent(view), *_loss(view), *_delay(view), *_together(view), *_windows(view), *_change(view)]


def _silent(view: View) -> Iterator[str]:
    if absent := [stream.label for stream in view.streams if not stream.measured]:
        yield f"No data frame came from {listed(absent)}."
    fallen = [stream for stream in view.measured if stream.told["silent_s"] > _SILENT_S]
    if fallen:
        longest = max(fallen, key=lambda stream: stream.told["silent_s"])
        names = listed([stream.label for stream in fallen])
        yield (
            f"{names} fell silent before the end; {longest.label} for {span(longest.told['silent_s'] * NS)}. "
            "This silence is not counted as loss."
        )


def _loss(view: View) -> Iterator[str]:
    told = view.all
    if not told["expected"]:
        return
    begin = f"{count(told['received'])} of {count(told['expected'])} expected frames came"
    if not told["lost"]:
        yield f"{begin}: none was lost."
        return
    worst = max(view.measured, key=lambda stream: _lost_share(stream.told))
    runs = worst.told["loss_runs"]
    longest = f"at most {count(runs['max'])} in a row ({lasting(runs['max_ms'])})"
    whose = f"{worst.label} lost" if len(view.measured) > 1 else "it lost"
    much = f"most: {percent(_lost_share(worst.told))}" if len(view.measured) > 1 else count(worst.told["lost"])
    yield f"{begin} ({percent(told['received'] / told['expected'])}); {whose} {much}, {longest}."
    if own := told["lost_own_at_most"]:
        yield f"Up to {count(own)} of these losses may be this host's own drops, not the network's."


def _lost_share(told: Mapping[str, Any]) -> float:
    return told["lost"] / told["expected"] if told["expected"] else 0.0


def _delay(view: View) -> Iterator[str]:
    timed = [stream for stream in view.measured if stream.told["delay_ms"]["count"]]
    if not timed:
        if view.measured:
            yield "Nobody saw the frames come (the source has no arrival times): there are no delays."
        return
    wrong = [stream for stream in timed if stream.clock_error]
    if wrong:
        middle = wrong[0].told["delay_ms"]["p50"]
        yield (
            f"The delays of {listed([stream.label for stream in wrong])} are a clock's error "
            f"(median of {wrong[0].label}: {lasting(middle)}): only their variation tells something."
        )
    sound = [stream for stream in timed if not stream.clock_error]
    if not sound:
        return
    slowest = max(sound, key=lambda stream: stream.told["delay_ms"]["p99"])
    told = slowest.told["delay_ms"]
    sure = "± unknown" if slowest.bound_ms is None else f"± {slowest.bound_ms:.2g} ms"
    middle, late, most = (milliseconds(told[key]) for key in ("p50", "p99", "max"))
    figures = f"median {middle} ms, p99 {late} ms, largest {most} ms"
    if len(sound) == 1:
        yield f"Delay from stamp to arrival: {figures} ({sure})."
        return
    fastest = min(sound, key=lambda stream: stream.told["delay_ms"]["p50"])
    least = f"; the least median has {fastest.label}: {milliseconds(fastest.told['delay_ms']['p50'])} ms"
    yield f"Slowest by its p99 is {slowest.label}: {figures} ({sure}){least if fastest is not slowest else ''}."


def _together(view: View) -> Iterator[str]:
    """How long a concentrator has to wait, and for whom."""
    for alignment in view.run.alignments:
        counts = alignment.counts
        if len(alignment.names) < 2 or not counts.stamps:
            continue
        which = f" of the {float(alignment.rate):g}/s streams" if len(view.run.alignments) > 1 else ""
        if not counts.complete:
            yield f"No stamp{which} was complete: never were the frames of all streams there."
            continue
        if (apart_ns := counts.relative.quantile_ns(0.5)) is not None and apart_ns > _APART_MS * NS_PER_MS:
            apart = lasting(apart_ns / NS_PER_MS)
            yield f"The frames of a stamp come {apart} apart{which}: the senders' clocks disagree."
            continue
        missing = counts.stamps - counts.complete
        share = next((each for each in _SHARES if each * counts.stamps <= counts.complete), None)
        wait_ns = None if share is None else counts.relative.quantile_ns(share, missing)
        if share is not None and wait_ns is not None:
            waits = f"waits {milliseconds(wait_ns / NS_PER_MS)} ms after the first frame of a stamp"
            never = "" if not missing else f"; {percent(missing / counts.stamps)} are never complete"
            yield f"A concentrator that {waits} has all frames of {100 * share:g} % of the stamps{which}{never}."
        else:
            yield f"{percent(missing / counts.stamps)} of the stamps{which} are never complete."
        last = alignment.table()[0]
        if last.last_share is not None and last.cost_ms is not None and last.last_share > 1.5 / len(alignment.names):
            yield (
                f"Most often last is {last.name}: {percent(last.last_share)} of the complete stamps waited for it, for "
                f"{milliseconds(last.cost_ms)} ms on average."
            )


def _windows(view: View) -> Iterator[str]:
    shares = {stream.label: _empty(stream) for stream in view.measured if sum(stream.told["per_window"].values())}
    if not shares:
        return
    worst = max(shares, key=lambda label: shares[label])
    if shares[worst] > 0:
        several = f"{worst} has most: " if len(shares) > 1 else ""
        yield f"Control windows of 1/Fs without a frame: {several}{percent(shares[worst])}."
    else:
        yield "Every control window of 1/Fs had a frame."


def _empty(stream: Stream) -> float:
    windows = stream.told["per_window"]
    return float(windows["0"] / sum(windows.values()))


def _change(view: View) -> Iterator[str]:
    if not view.run.differences:
        return
    counted = {word: sum(each.verdict == word for each in view.run.differences) for word in ("worse", "better")}
    against = view.run.compared_with or "the earlier run"
    yield f"Against {against}, {plural(counted['worse'], 'figure')} became worse, {count(counted['better'])} better."


def findings(view: View) -> list[Finding]:
    """Diagnoses by kind, in the order of their table; equal sentences once."""
    kinds: dict[str, dict[str, list[Stream]]] = {}
    for stream in view.streams:
        for told in stream.told["diagnoses"]:
            kinds.setdefault(told["id"], {}).setdefault(told["text"], []).append(stream)
    order = {row.id: number for number, row in enumerate(ROWS)}
    return [
        Finding(kind, _heading(kind), REMEDIES.get(kind, ""), list(kinds[kind].items()))
        for kind in sorted(kinds, key=lambda kind: order.get(kind, len(order)))
    ]


_NOTES = frozenset(row.id for row in ROWS if row.level == "note")
_ACRONYMS = {"tai": "TAI", "utc": "UTC", "tcp": "TCP"}


def _heading(kind: str) -> str:
    words = " ".join(_ACRONYMS.get(word, word) for word in kind.split("-"))
    return words[:1].upper() + words[1:] + (" (a note)" if kind in _NOTES else "")
