"""What ``pmu read`` prints: the columns that there are, and what was read."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from pmutools.cli.shell import Exit, Talk
from pmutools.errors import SourceError

if TYPE_CHECKING:
    from pmutools.cli.stage import Stage
    from pmutools.tools.live import LiveSource
    from pmutools.tools.news import Reasons
    from pmutools.tools.reader import Reading
    from pmutools.tools.reader.log import Recorder
    from pmutools.tools.reader.recorder import Recording

SHOWN_PATHS = 4
SHOWN_SILENT = 20


def list_fields(source: LiveSource, phasors: Literal["polar", "rect"], stage: Stage, talk: Talk, as_json: bool) -> int:
    """Print the columns of all streams once they are known, or at the end."""
    from pmutools.formats.columns import FRAME_COLUMNS
    from pmutools.tools.live import ROUND_NS
    from pmutools.tools.reader.known import Known

    known = Known(source)
    for found in source.rounds(ROUND_NS):
        known.see(found)
        if known.settled:
            break
    if not known.configs:
        raise nothing_came(source, stage.reasons)
    units = dict.fromkeys(FRAME_COLUMNS, "") | {"time_ns": "ns", "arrival_ns": "ns"}
    units |= {name: column.unit for name, column in known.columns(phasors).items()}
    if as_json:
        click.echo(json.dumps([{"name": name, "unit": unit or None} for name, unit in units.items()]))
    else:
        for name, unit in units.items():
            click.echo(f"{name}\t{unit}" if unit else name)
    talk.say(f"{len(units)} columns of {len(known.configs)} streams")
    return Exit.DONE


def report(
    source: LiveSource,
    recording: Recording,
    reading: Reading,
    recorder: Recorder,
    stage: Stage,
    talk: Talk,
    *,
    as_json: bool,
    stopped: bool,
) -> int:
    paths = [str(path) for path in recorder.paths]
    silent = [{"name": name, "why": stage.reasons.why(place)} for place, name in source.silent]
    told = reading.to_json() | {"kept_undecoded": recorder.undecoded, "silent": silent, "paths": paths}
    if as_json and not recording.to_stdout:
        click.echo(json.dumps(told))
    talk.say(f"{reading.frames} frames of {len(reading.streams)} streams -> {_paths_text(paths)}")
    for reason, nbytes in reading.skipped.items():
        talk.say(f"  {_skipped(reason, nbytes, reading, recording, recorder.undecoded)}")
    if count := reading.tally.ignored_flows:
        senders = f"{count} sender{'s' * (count > 1)}"
        talk.say(f"  {reading.tally.ignored} bytes of {senders} without a single frame")
    for place, name in source.silent[:SHOWN_SILENT] if reading.frames else ():
        talk.say(f"  {name}: no data: {stage.reasons.why(place)}")
    if reading.own_drops:
        talk.say(f"  {reading.own_drops} datagrams lost in this machine's receive buffer, not in the network")
    if as_json and recording.to_stdout:  # which has the data
        click.echo(json.dumps(told), err=True)
    if stopped:
        return Exit.INTERRUPTED
    if not reading.frames and not reading.skipped:
        raise nothing_came(source, stage.reasons)
    return Exit.INCOMPLETE if reading.skipped or reading.own_drops or reading.tally.ignored_flows else Exit.DONE


def _skipped(reason: str, nbytes: int, reading: Reading, recording: Recording, kept: int) -> str:
    """Bytes that could not be decoded; where only a configuration was missing, the frames may be kept all the same."""
    from pmutools.c37118.framer import SkipReason

    if reason != SkipReason.NO_CONFIG or not reading.undecoded:
        return f"{nbytes} bytes skipped: {reason}"
    if kept == reading.undecoded:
        fate = "kept undecoded"
    elif recording.triggers:
        fate = f"{kept} of them kept undecoded, the others are in no event"
    else:
        fate = "not kept; a capture (.pcapng, .c37118, .mcap) keeps them undecoded"
    done = "undecoded" if kept else "skipped"
    return f"{nbytes} bytes {done}: {reason}: no configuration came for {reading.undecoded} frames: {fate}"


def _paths_text(paths: Sequence[str]) -> str:
    if not paths:
        return "nothing written"
    if len(paths) <= SHOWN_PATHS:
        return ", ".join(paths)
    folders = sorted({str(Path(path).parent) for path in paths})
    return f"{len(paths)} files in {', '.join(folders[:SHOWN_PATHS])}{' ...' if len(folders) > SHOWN_PATHS else ''}"


def nothing_came(source: LiveSource, reasons: Reasons) -> SourceError:
    """The error of a reader that heard nothing at all."""
    endpoints = [str(endpoint) for endpoint in source.receivers.endpoints]
    named = ", ".join(endpoints[:SHOWN_PATHS]) + (" ..." if len(endpoints) > SHOWN_PATHS else "")
    return SourceError(f"no data from {named}: {reasons.why_all(len(endpoints))}")
