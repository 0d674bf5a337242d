"""``.mcap`` session logs as source and sink: PMU frames on ``/pmu/NAME/frame``, configurations as attachments.

Header and command frames have no place in a log; data frames for which no configuration came are there as their bytes.
A log that was cut is read up to the cut.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from pmutools.c37118.config import StreamConfig, encode_config, whole
from pmutools.c37118.constants import FrameType
from pmutools.c37118.demux import Message
from pmutools.c37118.framer import Frame
from pmutools.c37118.frames import unpack_data
from pmutools.c37118.layout import layout_of
from pmutools.flow import Chunk, Flow
from pmutools.formats.columns import unique
from pmutools.formats.sink import FrameSink, SinkOptions
from pmutools.formats.source import ByteSource
from pmutools.schema.log_reader import LogReader
from pmutools.schema.log_writer import LogWriter
from pmutools.schema.pmu_log import PmuTopics, iter_pmu_frames, pmu_frame, undecoded_frame


def read(path: Path, configs: Iterable[StreamConfig] = ()) -> ByteSource:
    """Open a log: one flow a PMU, whatever else it holds passed over."""
    reader = LogReader(path)

    def chunks() -> Iterator[Chunk]:
        for frame in iter_pmu_frames(reader):
            flow = Flow("file", f"{path.name}/{frame.name}")
            yield Chunk(frame.wire, frame.arrival_ns, flow, frame.stamp_source)

    def defects() -> dict[str, int]:
        damage = reader.damage
        counts = {
            "log without an end": int(damage.cut),
            "damaged records": damage.records,
            "bytes in no record": damage.lost_bytes,
            "messages on no channel": damage.orphans,
            "undecodable messages": damage.undecodable,
            "missing messages": damage.missing,
        }
        return {name: count for name, count in counts.items() if count}

    return ByteSource(path, "mcap", chunks(), defects, configs)


class LogSink(FrameSink):
    """Logs data frames by the name of their station (of a concentrator's stream: its IDCODE).

    Connections between the same two endpoints are one PMU.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._log = LogWriter(path)
        self._topics = PmuTopics(self._log)
        self._names: dict[tuple[Flow, int], str] = {}
        self._undecoded: dict[tuple[Flow, int], str] = {}
        self._configs: dict[tuple[Flow, int], StreamConfig] = {}

    def put(self, message: Message) -> None:
        frame, flow, config = message
        if config is None and frame.type is FrameType.DATA:
            self._put_undecoded(frame, flow)
        if config is None or not (frame.type is FrameType.DATA or frame.type.is_config):
            return
        key = (flow.ends, config.idcode)
        name = self._names.get(key)
        if name is None:
            name = self._names[key] = unique([_name(config)], [*self._names.values(), *self._undecoded.values()])[0]
        if frame.type.is_config:
            self._topics.config(name, whole(frame.data, config), frame.arrival_ns or 0)
            if frame.type.rules_data:
                self._configs[key] = config
            return
        if self._configs.get(key) != config:
            self._topics.config(name, encode_config(config), frame.arrival_ns or 0)
            self._configs[key] = config
        logged = pmu_frame(name, frame, unpack_data(frame.data, config, layout_of(config)))
        self._topics.write(logged)
        self._log.boundary(logged.arrival_ns or logged.time_ns)

    def _put_undecoded(self, frame: Frame, flow: Flow) -> None:
        key = (flow.ends, frame.idcode)
        name = self._undecoded.get(key)
        if name is None:
            taken = [*self._names.values(), *self._undecoded.values()]
            name = self._undecoded[key] = unique([f"stream-{frame.idcode}"], taken)[0]
        logged = undecoded_frame(name, frame)
        self._topics.write(logged)
        self._log.boundary(logged.arrival_ns or logged.time_ns)

    def flush(self) -> None:
        self._log.flush()

    def close(self) -> None:
        self._log.close()


def _name(config: StreamConfig) -> str:
    return config.name.replace("/", "_")


def create(path: Path, options: SinkOptions) -> LogSink:
    """Begin a log."""
    return LogSink(path)
