"""What a session is, before its first tick: what its log begins with, in one process or shipped to another."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from dcon.link import bundle
from dcon.link.bundle import Bundle

INI_NAME = "dcon.ini"
PROBE_NAME = "probing.csv"


@dataclass(frozen=True)
class Head:
    """What a session is, before its first tick."""

    ini_text: str
    """The initialisation file in force, attached whole."""
    pmus: tuple[str, ...] = ()
    """Names, in the order of the lists in a :class:`~dcon.core.values.Record`; so ``instances``."""
    instances: tuple[str, ...] = ()
    flags: tuple[str, ...] = ()
    """Names of the bits in a record's ``flags``."""
    metadata: Mapping[str, str] = field(default_factory=dict)
    """Seed, plant, scenario and what else is known of the run, as text; the version is added."""
    probe_file: bytes = b""
    """What the file of ``[probing]`` holds, attached; empty for none."""

    @property
    def names(self) -> dict[str, str]:
        """The lists of names as metadata."""
        return {name: json.dumps(list(getattr(self, name))) for name in ("pmus", "instances", "flags")}

    def pieces(self, session: int) -> list[bytes]:
        """As encoded bundles of the session of that number; :func:`head_of` is the inverse."""
        values = {"names": self.names, "metadata": dict(self.metadata)}
        return bundle.pieces(session, values, {INI_NAME: self.ini_text.encode(), PROBE_NAME: self.probe_file})


def head_of(pieces: Sequence[Bundle]) -> Head | None:
    """None until all pieces are there, or where they make no sense."""
    whole = bundle.joined(pieces)
    if whole is None:
        return None
    values, files = whole
    try:
        names = {name: tuple(map(str, json.loads(text))) for name, text in values["names"].items()}
        metadata = {str(key): str(value) for key, value in values["metadata"].items()}
        return Head(files[INI_NAME].decode(), **names, metadata=metadata, probe_file=files[PROBE_NAME])
    except (KeyError, TypeError, ValueError, AttributeError):
        return None
