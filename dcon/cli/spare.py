"""What a command writes must not be what it reads, nor a session that is there already."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from pmutools.cli.sources import spare as spare_inputs
from pmutools.errors import SettingsError


def spare(output: str | Path, sessions: Sequence[str]) -> None:
    """Raise SettingsError if ``output`` is a file of the sessions, under whatever name."""
    spare_inputs(output, list(_files(sessions)))


def spare_in(folder: Path, names: Sequence[str], sessions: Sequence[str]) -> None:
    """:func:`spare` for what is written to ``folder``: its files of these names, and all in its folders of them."""
    for name in names:
        place = folder / name
        for path in place.iterdir() if place.is_dir() else (place,):
            spare(path, sessions)


def named_in(changes: Sequence[str]) -> list[str]:
    """Files that changes of settings (``SECTION.KEY=VALUE``) name to be read."""
    from dcon.settings import PROBE_FILE

    pairs = (change.partition("=") for change in changes)
    return [text.strip() for key, _, text in pairs if key.strip().lower() == PROBE_FILE]


def keep_sessions(paths: Sequence[str | Path]) -> None:
    """Raise SettingsError if there is a file already where a session is to be logged."""
    for path in map(Path, paths):
        if path.exists() or path.is_symlink():
            raise SettingsError(f"{path} is there already, and would be overwritten; write to another folder")


def _files(sessions: Sequence[str]) -> Iterator[str]:
    """The files named, and those beside them that may be their further parts."""
    from dcon.session.parts import later_paths

    for session in sessions:
        yield session
        yield from map(str, later_paths(session).values())
