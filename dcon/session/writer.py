"""A session as MCAP, written entry by entry: what they say is made elsewhere (:mod:`dcon.session.encode`).

All messages of a tick lie in one chunk: damage takes whole ticks, and the reader says where.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from types import TracebackType
from typing import IO

import pmutools
from dcon.link.bundle import Entry
from dcon.session import defaults
from dcon.session.head import INI_NAME, PROBE_NAME, Head
from dcon.session.parts import SESSION
from pmutools.schema.log_writer import LogWriter
from pmutools.schema.messages import MESSAGES
from pmutools.schema.pmu_log import PmuTopics


class SessionWriter:
    """Writes a session log; a context manager. All methods raise SourceError where the system refuses to write.

    Parameters
    ----------
    target
        Path, or a seekable binary stream.
    head
        What the session is.
    configs
        Configuration frame of each PMU, by name; those that come later go to :meth:`config`.
    """

    def __init__(
        self, target: str | os.PathLike[str] | IO[bytes], head: Head, configs: Mapping[str, bytes] | None = None
    ) -> None:
        self._tick_ns: int | None = None
        self._log = LogWriter(target)
        self._pmus = PmuTopics(self._log)
        own = {"version": pmutools.__version__, defaults.KEY: str(defaults.NUMBER)}
        self._log.metadata(SESSION, {**own, **head.metadata, **head.names})
        self._log.attach(INI_NAME, head.ini_text.encode(), media_type="text/plain")
        if head.probe_file:
            self._log.attach(PROBE_NAME, head.probe_file, media_type="text/csv")
        for name, frame in (configs or {}).items():
            self._pmus.config(name, frame)
        self._channels = {
            name: self._log.channel(message.topic, name, head.names)
            for name, message in MESSAGES.items()
            if message.topic.startswith("/dcon/")
        }

    def write(self, entries: Iterable[Entry], tick_ns: int) -> None:
        """Log entries of the tick at ``tick_ns``: all of them, or some, and more with the same ``tick_ns``."""
        if tick_ns != self._tick_ns:
            self._log.boundary(tick_ns)
            self._tick_ns = tick_ns
        write, channels = self._log.write, self._channels
        for message, name, data, log_time_ns, publish_time_ns in entries:
            if message == "PmuFrame":
                self._pmus.put(name, data, log_time_ns, publish_time_ns)
            else:
                write(channels[message], data, log_time_ns, publish_time_ns)

    @property
    def size(self) -> int:
        """Bytes in the file; grows with every chunk that is flushed."""
        return self._log.size

    def config(self, name: str, frame: bytes, time_ns: int) -> None:
        """Attach a configuration frame that came at ``time_ns``."""
        self._pmus.config(name, frame, time_ns)

    def flush(self) -> None:
        """A process killed after this loses nothing that was logged before it."""
        self._log.flush()

    def close(self) -> None:
        self._log.close()

    def __enter__(self) -> SessionWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()
