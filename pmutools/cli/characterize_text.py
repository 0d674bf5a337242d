"""What was measured, for a person in front of a terminal: a line a stream, then what is wrong, in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pmutools.measure.compare import Difference
from pmutools.measure.require import Verdict

TOLD_STREAMS = 20
"""Of more streams the worst are told."""
TOLD_MUTE = 3
"""Of these, streams without data."""
TOLD_DIFFERENCES = 40
_NAMES = 4
_HEAD = (
    *("stream", "rate", "received", "expected", "loss", "delay p50", "p99", "± (ms)", "PDV p99"),
    *("jitter", "late", "dup", "reord"),
)
_CORRUPT = "bad CHK"
Stream = Mapping[str, Any]


def told(
    summary: Mapping[str, Any], verdicts: Sequence[Verdict], differences: Sequence[Difference], *, all_of_them: bool
) -> Iterator[str]:
    """The lines."""
    run, streams = summary["run"], summary["streams"]
    yield f"{run['source']}: {len(streams)} streams, {run['duration_s']:.1f} s from {run['begin'][:19]}Z"
    if summary["clock"]["disciplined"] or not summary["clock"]["samples"]:  # else it is among the diagnoses
        yield summary["clock"]["text"]
    yield ""
    shown = streams if all_of_them else worst(streams)
    every = [*shown]
    if len(streams) > 1:
        every.append(summary["all"] | {"name": f"all {len(streams)}", "rate_hz": None, "uncertainty_ms": None})
    rows = [_HEAD, *map(_row, every)]
    if summary["all"]["corrupt"]:  # seldom, and never to be overlooked
        rows = [(*rows[0], _CORRUPT), *((*row, str(of["corrupt"])) for row, of in zip(rows[1:], every, strict=True))]
    yield from _table(rows)
    if len(shown) < len(streams):
        mute = sum(not stream["received"] for stream in streams) - sum(not stream["received"] for stream in shown)
        better = f"{len(streams) - len(shown) - mute} more streams that fare better"
        yield f"({better}{f', {mute} that sent no data' if mute else ''}; -v shows all, summary.json holds all)"
    if summary["all"]["received"] and not summary["all"]["delay_ms"]["count"]:
        yield "no arrival times: of delays, windows and jitter nothing can be told"
    yield from _section("", _diagnoses(streams))
    yield from _section("", _budget(summary))
    yield from _section("", _ledger(summary))
    if differences:
        yield from _section("Against the run before:", _differences(differences))
    yield from _section("", _verdicts(verdicts))


def worst(streams: Sequence[Stream]) -> list[Stream]:
    """Those that fare worst, by loss, then by what is said of them, then by delay; in their own order if few.

    A few at most that sent no data: somebody who announces thousands of streams must not hide those that there are.
    """
    if len(streams) <= TOLD_STREAMS:
        return list(streams)
    mute = [stream for stream in streams if not stream["received"]]

    def badness(stream: Stream) -> tuple[float, int, float]:
        lost = _share(stream, "lost", "expected") or 0.0
        return lost, sum(not _is_note(each) for each in stream["diagnoses"]), stream["delay_ms"]["p99"] or 0.0

    heard = sorted((stream for stream in streams if stream["received"]), key=badness, reverse=True)
    return [*mute[: max(TOLD_MUTE, TOLD_STREAMS - len(heard))], *heard][:TOLD_STREAMS]


def _row(stream: Stream) -> tuple[str, ...]:
    delay, unsure = stream["delay_ms"], stream["uncertainty_ms"]
    return (
        stream["name"][:28],
        "" if not stream["rate_hz"] else f"{stream['rate_hz']:g}",
        str(stream["received"]),
        str(stream["expected"]),
        _percent(_share(stream, "lost", "expected")),
        _ms(delay["p50"]),
        _ms(delay["p99"]),
        "unknown" if unsure is None and delay["count"] else "" if unsure is None else f"{unsure:.2g}",
        _ms(stream["pdv_ms"]["p99"]),
        _ms(stream["jitter_rfc3550_ms"]),
        _percent(_share(stream, "late", "received")),
        str(stream["duplicated"]),
        str(stream["reordered"]),
    )


def _share(stream: Stream, part: str, of: str) -> float | None:
    return stream[part] / stream[of] if stream[of] else None


def _percent(share: float | None) -> str:
    return "-" if share is None else "0" if not share else f"{share:.3%}"


def _ms(value: float | None) -> str:
    """Four digits; a clock's days are told as such."""
    if value is None:
        return "-"
    if abs(value) >= 1e7:
        return f"{value / 86_400_000:.3g} days"
    return f"{value:.4g}"


def _table(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows:
        first, *others = (
            cell.ljust(width) if not column else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        yield "  ".join((first, *others)).rstrip()


def _section(head: str, lines: Iterator[str]) -> Iterator[str]:
    found = list(lines)
    if found:
        yield ""
        yield from (head,) if head else ()
        yield from found


def _diagnoses(streams: Sequence[Stream]) -> Iterator[str]:
    """Each kind once, with the streams that it is said of; its numbers are those of the first."""
    found: dict[str, list[tuple[str, str]]] = {}
    for stream in streams:
        for diagnosis in stream["diagnoses"]:
            text = f"note: {diagnosis['text']}" if _is_note(diagnosis) else diagnosis["text"]
            found.setdefault(diagnosis["id"], []).append((stream["name"], text))
    for said in found.values():
        (name, text), names = said[0], [other for other, _ in said]
        if len(said) > 1 and len({text for _, text in said}) == 1:
            yield f"{'all streams' if len(said) == len(streams) else _named(names)}: {text}"
            continue
        yield f"{name}: {text}"
        if others := names[1:]:
            yield f"  so, with numbers of their own: {_named(others)}"


def _is_note(diagnosis: Mapping[str, Any]) -> bool:
    return diagnosis.get("level") == "note"


def _named(names: Sequence[str]) -> str:
    """Some of many."""
    more = f" and {len(names) - _NAMES} more" if len(names) > _NAMES else ""
    return ", ".join(names[:_NAMES]) + more


def _budget(summary: Mapping[str, Any]) -> Iterator[str]:
    """The paper's Table I of the stream with the largest median delay."""
    streams = [stream for stream in summary["streams"] if stream["budget"] and stream["delay_ms"]["p50"] is not None]
    usual = [stream for stream in streams if 0 <= stream["delay_ms"]["p50"] < 10_000]
    if not usual:
        return
    slowest = max(usual, key=lambda stream: stream["delay_ms"]["mean"])
    yield f"Delay budget of {slowest['name']}, the slowest (ms; the paper's Table I beside it):"
    rows = [("", "mean", "min", "max", "paper", "how")]
    for row in slowest["budget"]:
        paper = row["paper_ms"]
        told = f"{paper['mean']:g} ({paper['min']:g} to {paper['max']:g})"
        figures = (f"{row[key]:.1f}" for key in ("mean_ms", "min_ms", "max_ms"))
        rows.append((f"  {row['name']}", *figures, told, row["how"]))
    widths = [max(len(row[column]) for row in rows) for column in range(5)]
    for row in rows:
        cells = [cell.rjust(width) if at else cell.ljust(width) for at, (cell, width) in enumerate(zip(row, widths))]  # noqa: B905
        yield "  ".join((*cells, row[5])).rstrip()


def _ledger(summary: Mapping[str, Any]) -> Iterator[str]:
    if (ledger := summary.get("ledger")) is None:
        return
    whole = ledger["all"]
    yield f"Against the ledger {ledger['file']}:"
    for table, what in (("received", "and received"), ("missing", "and not received")):
        for fate, count in whole[table].items():
            verdict = ": lost on the way" if (table, fate) == ("missing", "sent") else ""
            if table == "received" and not fate.startswith("sent"):
                verdict = ": a contradiction"
            yield f"  {count:>9} {fate} {what}{verdict}"
    for key, what in (("unknown", "received and in no row"), ("outside", "left while nobody measured")):
        if whole[key]:
            yield f"  {whole[key]:>9} {what}"
    one_way = whole["one_way_ms"]
    if one_way["count"]:
        yield (
            f"  one-way delay: p50 {one_way['p50']:.4g}, p99 {one_way['p99']:.4g}, min {one_way['min']:.4g}, "
            f"max {one_way['max']:.4g} ms; at the sender: p50 {whole['at_sender_ms']['p50']:.4g} ms"
        )
    if ledger["not_measured"]:
        yield f"  not measured: {', '.join(ledger['not_measured'][:_NAMES])}"


def _verdicts(verdicts: Sequence[Verdict]) -> Iterator[str]:
    """Each limit once, with the streams that break it."""
    for text in dict.fromkeys(verdict.requirement.text for verdict in verdicts):
        judged = [verdict for verdict in verdicts if verdict.requirement.text == text]
        broken = [verdict for verdict in judged if not verdict.holds]
        if not broken and len(judged) > _NAMES:
            yield f"ok   {text}: all {len(judged)} streams"
            continue
        yield from map(str, (broken or judged)[:_NAMES])
        if len(broken) > _NAMES:
            yield f"FAIL {text}: {len(broken) - _NAMES} more of {len(judged)} streams"


def _differences(differences: Sequence[Difference]) -> Iterator[str]:
    changed = [row for row in differences if row.verdict != "same"]
    if not changed:
        yield "  nothing changed beyond 5 %"
        return
    for row in changed[:TOLD_DIFFERENCES]:
        before, after = (_figure(value, row.unit) for value in (row.before, row.after))
        yield f"  {row.verdict:<8}{row.stream}: {row.metric} {before} -> {after}"
    if len(changed) > TOLD_DIFFERENCES:
        yield f"  ({len(changed) - TOLD_DIFFERENCES} more in summary.json)"


def _figure(value: float | None, unit: str) -> str:
    if value is None:
        return "none"
    return f"{value:.4%}" if unit == "share" else f"{value:.6g}{'' if unit in ('count', '') else f' {unit}'}"
