"""What an engine has measured, as ``summary.json``: stream by stream, so that a checkpoint holds nobody up."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from pmutools import __version__, timebase
from pmutools.measure.budget import Departures
from pmutools.measure.stream import StreamResult
from pmutools.measure.summary import Whole, safe, stream_summary, summary
from pmutools.tools.characterizer.engine import Engine

Extra = Callable[[], Mapping[str, Any]]
"""What is known of the input beside the streams: bytes by what became of them, defects."""


def run_part(
    engine: Engine, source: str, begin_ns: int | None, end_ns: int, extra: Extra, *, complete: bool
) -> dict[str, Any]:
    """``run`` of the summary: what was measured, from when to when, and what happened meanwhile."""
    begin_ns = end_ns if begin_ns is None else begin_ns
    return safe(
        {
            "source": source,
            "version": __version__,
            "begin": timebase.format_utc(begin_ns),
            "end": timebase.format_utc(end_ns),
            "duration_s": (end_ns - begin_ns) / timebase.NS,
            "complete": complete,
            "input": {
                "skipped": dict(engine.skipped),
                "own_drops": engine.host.own_drops,
                "unmeasured_frames": engine.unmeasured,
                "unattributed": engine.host.to_json(),
                **extra(),
            },
            "news": [[timebase.format_utc(at_ns), line] for at_ns, line in engine.chronicle.lines()],
        }
    )


def results_of(engine: Engine, end_ns: int | None) -> Iterator[StreamResult]:
    """Of each stream, in order, and then of what has not come; one at a time."""
    for gauge in list(engine.gauges):
        yield gauge.meter.result(end_ns)
    yield from engine.silences(end_ns)


def checkpoint(
    engine: Engine, run: Callable[[], Mapping[str, Any]], end_ns: int, put: Callable[[str], None]
) -> Iterator[None]:
    """The summary so far, as text to ``put``; without fits, and without what compares streams. A step a stream."""
    streams, whole = [], Whole()
    for result in results_of(engine, end_ns):
        streams.append(json.dumps(stream_summary(result, engine.clock, fit=False)))
        whole.add(result)
        yield
    told = whole.to_json(list(engine.alignments.values()), engine.host)
    parts = {
        "clock": json.dumps(safe(engine.clock.to_json())),
        "streams": "[" + ",\n".join(streams) + "]",
        "all": json.dumps(told),
        "run": json.dumps(run()),
    }
    put("{" + ",\n".join(f'"{key}": {text}' for key, text in parts.items()) + "}\n")
    yield


def final_summary(
    engine: Engine,
    results: Sequence[StreamResult],
    run: Mapping[str, Any],
    may_fit: Callable[[], bool],
    departures: Sequence[Departures] | None = None,
) -> dict[str, Any]:
    """The summary of a run that is over, as it will be written."""
    alignments = list(engine.alignments.values())
    told = summary(results, engine.clock, alignments, host=engine.host, may_fit=may_fit, departures=departures)
    return told | {"run": dict(run)}
