"""Files of the operators' link: keys, which only their owner may read, and the sequences used up."""

from __future__ import annotations

import json
import os
import secrets
import stat
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from dcon.core.system import ORDERS
from dcon.link.orders import WORDS, Operator
from pmutools.errors import SettingsError, SourceError
from pmutools.parsers import parsed_by, suggestion, words
from pmutools.settings import fill, parse_ini

KEY_BYTES = 32
SHORTEST_KEY = 16
"""Bytes."""
LARGEST_FILE = 1 << 20
SEQUENCES = "operators.seq"
"""In the run folder."""


def _key(text: str) -> bytes:
    try:
        key = bytes.fromhex(text)
    except ValueError:
        key = b""
    if len(key) < SHORTEST_KEY:
        raise ValueError(f"must be at least {2 * SHORTEST_KEY} hexadecimal digits; dcon keys makes one")
    return key


def _may(text: str) -> frozenset[str] | None:
    names = words(text)
    if names == ("all",):
        return None
    for name in names:
        if name not in ORDERS:
            raise ValueError(f"{name!r} is no order; {suggestion(name, (*map(str, ORDERS), 'all'))}")
    return frozenset(names)


@dataclass(frozen=True, slots=True)
class _Section:
    key: bytes = field(metadata=parsed_by(_key))
    may: frozenset[str] | None = field(default=None, metadata=parsed_by(_may))


def read_keys(path: str | os.PathLike[str]) -> dict[str, Operator]:
    """``[operator NAME]`` sections of a file: ``key`` (hexadecimal), ``may`` (a list of orders; default all).

    Raises SourceError for a file that cannot be read, or that others than its owner may read or write; SettingsError
    for what is in it. No error holds a key.
    """
    try:
        with Path(path).open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            text = file.read(LARGEST_FILE).decode(errors="replace")
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}") from None
    if stat.S_IMODE(mode) & 0o077:
        raise SourceError(f"{path}: others may read or write these keys; chmod 600 {path}")
    ini = parse_ini(text, str(path))
    ini.only("operator *")
    operators = {}
    for section in ini.family("operator"):
        values = fill(_Section, section)
        operators[section.argument] = Operator(section.argument, values.key, values.may)
    if not operators:
        raise SettingsError(f"{path}: no [operator NAME]; dcon keys adds one")
    return operators


def add_key(path: str | os.PathLike[str], name: str, may: Collection[str] = ()) -> None:
    """Add a new operator with a random key to a file, which is made, mode 0600, where it is not there.

    Raises SourceError where the file cannot be written, SettingsError where it has that operator, or the name cannot
    be one.
    """
    if not name or not name.isprintable() or len(name) > WORDS or name != name.strip() or set(name) & set("[];#"):
        rule = f"1 to {WORDS} printable characters, none of them [ ] ; #"
        raise SettingsError(f"{name!r} is no name of an operator: {rule}")
    if may:
        try:
            _may(",".join(may))
        except ValueError as error:
            raise SettingsError(f"--may: {error}") from None
    if os.path.lexists(path) and name in read_keys(path):
        raise SettingsError(f"{path}: has an operator {name!r} already; remove that section first")
    lines = [f"[operator {name}]", f"key = {secrets.token_hex(KEY_BYTES)}", f"may = {','.join(may) or 'all'}", "", ""]
    try:
        with open(os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600), "w") as file:
            file.write("\n".join(lines))
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}") from None


def load_sequences(folder: Path) -> dict[str, int] | None:
    """The last sequence of each operator; None where the file is not there or damaged: then nothing old may count."""
    try:
        values = json.loads((folder / SEQUENCES).read_bytes())
    except (OSError, ValueError):
        return None
    if not isinstance(values, dict) or any(type(sequence) is not int for sequence in values.values()):
        return None
    return values


def save_sequences(folder: Path, last: Mapping[str, int]) -> bool:
    """Replace the file at once or not at all; whether that could be done."""
    fresh = folder / f"{SEQUENCES}.new"
    try:
        fresh.write_text(json.dumps(last))
        os.replace(fresh, folder / SEQUENCES)
    except OSError:
        return False
    return True
