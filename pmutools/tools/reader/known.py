"""Which columns there are, once all streams that are asked for have shown their configurations."""

from __future__ import annotations

from collections.abc import Callable

from pmutools.c37118.config import StreamConfig
from pmutools.errors import SettingsError
from pmutools.flow import Flow
from pmutools.formats.columns import Column, Phasors, columns_of
from pmutools.formats.fields import Fields, no_such_column
from pmutools.formats.source import Block
from pmutools.formats.table_rows import has_columns, names_of
from pmutools.parsers import NAMED_STREAMS
from pmutools.timebase import NS
from pmutools.tools.live import LiveSource
from pmutools.tools.reader.reading import Round

SETTLE_NS = 2 * NS
"""How long after the first data others may come over the same endpoint."""


class Known:
    """The streams seen, and whether those are all: every endpoint has brought one, :data:`SETTLE_NS` have passed since
    the first, and no data wait for a configuration."""

    def __init__(self, source: LiveSource) -> None:
        self._source = source
        self._owners: set[int] = set()
        self._first_ns: int | None = None
        self.configs: dict[tuple[Flow, int], StreamConfig] = {}
        self.settled = False

    def see(self, found: Round) -> list[StreamConfig]:
        """Take note of a round; the configurations that are new."""
        receivers, now_ns = self._source.receivers, self._source.clock.monotonic_ns()
        fresh = []
        for item in found:
            if not isinstance(item, Block):
                continue
            flow, config = item.flow, item.batch.config
            key = flow.ends, config.idcode
            if self.configs.get(key) != config:
                self.configs[key] = config
                self._owners.update(receivers.owners(flow, config.idcode))
                fresh.append(config)
                self._first_ns = now_ns if self._first_ns is None else self._first_ns
        if not self.settled and self._first_ns is not None and len(self._owners) == len(receivers.endpoints):
            waited = now_ns - self._first_ns >= SETTLE_NS or _alone(self._source)
            self.settled = waited and not receivers.demux.pending
        return fresh

    def names(self, phasors: Phasors) -> list[str]:
        """All columns of all streams, each once."""
        return list(dict.fromkeys(name for config in self.configs.values() for name in names_of(config, phasors)))

    def columns(self, phasors: Phasors) -> dict[str, Column]:
        """The columns with values, by name."""
        return {column.name: column for config in self.configs.values() for column in columns_of(config, phasors)}


def _alone(source: LiveSource) -> bool:
    """Whether no endpoint can bring more than one stream: then nothing is to be waited for."""
    return all(endpoint.idcode is not None for endpoint in source.receivers.endpoints)


class FieldCheck:
    """Holds the fields wanted against the streams: an item that fits none of them is an error once all are known.

    ``tell`` is given a line about streams that are left out because they have none of the fields.
    """

    def __init__(self, fields: Fields, phasors: Phasors, known: Known, tell: Callable[[str], None]) -> None:
        self._fields, self._phasors, self._known, self._tell = fields, phasors, known, tell
        self._left_out: list[int] = []
        self._checked = False

    def __call__(self, found: Round) -> None:
        """Look at a round. Raises SettingsError, with the nearest columns there are."""
        for config in self._known.see(found):
            if not has_columns(config, self._phasors, self._fields):
                self._left_out.append(config.idcode)
        if not self._known.settled:
            return
        if not self._checked:
            self._checked = True
            names = self._known.names(self._phasors)
            if unknown := self._fields.unknown(names):
                raise SettingsError(f"--fields: {no_such_column(unknown[0], names)} (--list-fields prints all)")
        if self._left_out:
            more = " ..." if len(self._left_out) > NAMED_STREAMS else ""
            streams = ", ".join(map(str, self._left_out[:NAMED_STREAMS])) + more
            self._tell(f"left out, as they have none of the fields: streams {streams}")
            self._left_out.clear()

    @property
    def unmatched(self) -> tuple[str, ...]:
        """Items that have fitted no stream so far."""
        return self._fields.unknown(self._known.names(self._phasors))
