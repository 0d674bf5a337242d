"""``pmu ini``."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pmutools.cli.shell import Exit, Talk, common, interruptible
from pmutools.cli.sources import DURATION
from pmutools.errors import SettingsError, SourceError

if TYPE_CHECKING:
    from pmutools.c37118.config import StreamConfig
    from pmutools.tools.survey import Survey, SurveyedEndpoint, SurveyedStream


@click.command(name="ini", short_help="A starter initialisation file from live streams.")
@click.argument("urls", nargs=-1, required=True, metavar="URL...")
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE", help="Write to FILE instead of stdout.")
@click.option(
    "--save-config",
    "folder",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Keep each stream's configuration as a .c37118 file in DIR, and refer to it.",
)
@click.option("--force", is_flag=True, help="Overwrite files that are there.")
@DURATION
@common
def command(
    urls: tuple[str, ...],
    out: Path | None,
    folder: Path | None,
    force: bool,
    duration_ns: int | None,
    as_json: bool,
    quiet: bool,
    verbose: int,
) -> int:
    """Listen to live endpoints and write a starter initialisation file: a [pmu NAME] a station, with what was seen.

    Listens until every endpoint has shown a configuration and data, at most 10 s; a spontaneous stream may send its
    configuration only once a minute, so give it --duration 70. With --json, stdout is what was seen, as data.
    Exit code 1 says that no stream was found, 3 that bytes came that could not be read.
    """
    from pmutools.cli.herald import Herald
    from pmutools.cli.news import News
    from pmutools.tools.survey import survey

    talk = Talk(quiet, verbose)
    if out is not None:
        _spare(out, force)

    def progress(endpoints: Sequence[SurveyedEndpoint]) -> None:
        seen = sum(1 for endpoint in endpoints if endpoint.streams)
        talk.progress(f"{seen} of {len(endpoints)} endpoints, {sum(len(e.streams) for e in endpoints)} streams")

    with interruptible() as stop:
        seen = survey(urls, duration_ns=duration_ns, stop=stop, tell=News(Herald(talk).say, verbose), progress=progress)
    talk.progress("")
    _tell(seen, talk)
    if seen.streams:
        configs = {} if folder is None else _save_configs(seen.streams, folder, out, force, talk)
        _write(seen, configs, out, as_json)
    if as_json:
        click.echo(json.dumps(seen.to_json()))
    if stop():
        return Exit.INTERRUPTED
    if not seen.streams:
        return Exit.FAILED
    return Exit.INCOMPLETE if seen.skipped or seen.own_drops else Exit.DONE


def _tell(survey: Survey, talk: Talk) -> None:
    """Say what is missing in the file."""
    for endpoint in survey.endpoints:
        if not endpoint.streams:
            talk.complain(f"pmu ini: {endpoint.endpoint}: {endpoint.reason}")
    for reason, nbytes in survey.skipped.items():
        talk.say(f"{nbytes} bytes skipped: {reason}")


def _write(survey: Survey, configs: dict[SurveyedStream, str], out: Path | None, as_json: bool) -> None:
    from pmutools.cli.ini_text import ini_text, sections_of

    text = ini_text(survey, sections_of(survey, configs))
    if out is not None:
        _put(out, text.encode())
    elif not as_json:
        click.echo(text, nl=False)


def _save_configs(
    streams: Sequence[SurveyedStream], folder: Path, out: Path | None, force: bool, talk: Talk
) -> dict[SurveyedStream, str]:
    """Write each stream's configuration; their paths as the initialisation file names them.

    They are found by their IDCODE again, so those of an IDCODE that has two are left out.
    """
    from pmutools.c37118.config import encode_config
    from pmutools.timebase import NS

    base = Path.cwd() if out is None else out.resolve().parent
    files: dict[Path, bytes] = {}
    paths: dict[SurveyedStream, str] = {}
    found: dict[int, set[StreamConfig]] = {}
    for stream in streams:
        found.setdefault(stream.inventory.idcode, set()).add(stream.inventory.config)
    if several := [str(idcode) for idcode, configs in found.items() if len(configs) > 1]:
        talk.complain(f"pmu ini: IDCODE {', '.join(several)} has several configurations: not saved")
    for stream in streams:
        config = stream.inventory.config
        if len(found[config.idcode]) > 1:
            continue
        path = folder / f"{config.idcode}.c37118"
        _spare(path, force)
        files[path] = encode_config(config, soc=stream.inventory.first_ns // NS)
        paths[stream] = Path(os.path.relpath(path.resolve(), base)).as_posix()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SourceError(f"cannot make {folder}: {error.strerror}") from None
    for path, data in files.items():
        _put(path, data)
    return paths


def _spare(path: Path, force: bool) -> None:
    if path.exists() and not force:
        raise SettingsError(f"{path} is there already; --force overwrites it, or name another file")


def _put(path: Path, data: bytes) -> None:
    try:
        path.write_bytes(data)
    except OSError as error:
        raise SourceError(f"cannot write {path}: {error.strerror}; check the folder and the space left") from None
