"""PMU frames in a log: ``/pmu/NAME/frame``, each with the configuration that explains it attached before it."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol

from pmutools.c37118 import Data, Frame, FrameType, StreamConfig, decode_config
from pmutools.c37118.constants import PREFIX_SIZE
from pmutools.c37118.prefix import decode_prefix
from pmutools.errors import WireError
from pmutools.flow import StampSource
from pmutools.schema.descriptors import message_class
from pmutools.schema.log_reader import LogAttachment, LogMessage, LogReader
from pmutools.schema.log_writer import LogWriter

_NAN = float("nan")
_CONFIG_NAME = re.compile(r"(.+)\.cfg[123]")
_STAMP_SOURCES = {str(source): source for source in StampSource}


class PmuFrame(NamedTuple):
    """One data frame of the PMU ``name``, as received and decoded; ``arrival_ns`` None where nobody took it.

    ``stat``, ``frequency_hz`` and ``rocof_hz_s`` are those of the PMU's own station; the ``station_`` tuples hold those
    of all S stations where the frame has several. ``tick_ns`` is the control tick that consumed it, 0 for none.
    """

    name: str
    wire: bytes
    time_ns: int
    arrival_ns: int | None
    stamp_source: StampSource
    stat: int
    time_quality: int
    frequency_hz: float
    rocof_hz_s: float = _NAN
    v1: complex = complex(_NAN, _NAN)
    phasors: tuple[complex, ...] = ()
    analogs: tuple[float, ...] = ()
    digitals: tuple[int, ...] = ()
    station_stat: tuple[int, ...] = ()
    station_frequency_hz: tuple[float, ...] = ()
    station_rocof_hz_s: tuple[float, ...] = ()
    tick_ns: int = 0
    time_base: int = 1_000_000

    def encode(self, tick_ns: int = 0) -> bytes:
        """The ``PmuFrame`` message; ``tick_ns`` overrides the frame's."""
        return encode_frame(self, tick_ns)


class Loggable(Protocol):
    """What may be logged as a frame of a PMU: a :class:`PmuFrame`, or something that makes its message quicker."""

    @property
    def name(self) -> str: ...
    @property
    def time_ns(self) -> int: ...
    @property
    def arrival_ns(self) -> int | None: ...
    def encode(self, tick_ns: int = 0) -> bytes: ...


class WireFrame(NamedTuple):
    """Bytes to play back: a data frame, or (told by its SYNC) the configuration of those that follow."""

    name: str
    wire: bytes
    arrival_ns: int | None
    stamp_source: StampSource


class PmuTopics:
    """The PMU topics of one log, announced as their first frames come."""

    def __init__(self, log: LogWriter) -> None:
        self.log = log
        self._channels: dict[str, int] = {}
        self._described: dict[str, dict[str, str]] = {}

    def config(self, name: str, frame: bytes, time_ns: int = 0) -> None:
        """Attach a configuration frame of ``name``, which holds for the frames written after it."""
        try:
            prefix, config = decode_config(frame)
        except WireError:
            kind = 3  # one fragment of a CFG-3
        else:
            kind = {FrameType.CFG1: 1, FrameType.CFG2: 2}.get(prefix.type, 3)
            self._described[name] = _describe(config)
        self.log.attach(f"{name}.cfg{kind}", frame, time_ns)

    def write(self, frame: Loggable, tick_ns: int = 0) -> None:
        """Log one frame, at its arrival (or its own time); ``tick_ns`` overrides the frame's."""
        time_ns = frame.time_ns
        self.put(frame.name, frame.encode(tick_ns), frame.arrival_ns or time_ns, time_ns)

    def put(self, name: str, data: bytes, log_time_ns: int, publish_time_ns: int) -> None:
        """Log one frame that is a ``PmuFrame`` message already."""
        channel = self._channels.get(name)
        if channel is None:
            described = self._described.get(name, {})
            channel = self._channels[name] = self.log.channel(topic_of(name), "PmuFrame", described)
        self.log.write(channel, data, log_time_ns, publish_time_ns)


def encode_frame(frame: PmuFrame, tick_ns: int = 0) -> bytes:
    """The ``PmuFrame`` message; ``tick_ns`` overrides the frame's."""
    message = message_class("PmuFrame")(
        time_ns=frame.time_ns,
        arrival_ns=frame.arrival_ns or 0,
        tick_ns=tick_ns or frame.tick_ns,
        stamp_source=frame.stamp_source,
        wire=frame.wire,
        time_base=frame.time_base,
        stat=frame.stat,
        time_quality=frame.time_quality,
        v1_re=frame.v1.real,
        v1_im=frame.v1.imag,
        frequency_hz=frame.frequency_hz,
        rocof_hz_s=frame.rocof_hz_s,
        phasor_re=[phasor.real for phasor in frame.phasors],
        phasor_im=[phasor.imag for phasor in frame.phasors],
    )
    if frame.analogs or frame.digitals:  # as keywords, empty lists too would cost 0.3 us each
        message.analog.extend(frame.analogs)
        message.digital.extend(frame.digitals)
    if frame.station_stat:
        message.station_stat.extend(frame.station_stat)
        message.station_frequency_hz.extend(frame.station_frequency_hz)
        message.station_rocof_hz_s.extend(frame.station_rocof_hz_s)
    return bytes(message.SerializeToString())


def topic_of(name: str) -> str:
    return f"/pmu/{name}/frame"


def name_of(topic: str) -> str:
    return topic.removeprefix("/pmu/").removesuffix("/frame")


def pmu_frame(name: str, frame: Frame, data: Data, *, station: int = 0, v1: complex = complex(_NAN, _NAN)) -> PmuFrame:
    """A received frame and what it decodes to; ``station`` is the PMU's own in a frame of several."""
    own, several = data.station(station), data.stations if len(data.layout.slots) > 1 else ()
    return PmuFrame(
        name,
        bytes(frame.data),
        data.time_ns,
        frame.arrival_ns,
        frame.stamp_source,
        own.stat,
        data.time_quality,
        own.frequency,
        own.rocof,
        v1,
        tuple(phasor for each in several for phasor in each.phasors) if several else own.phasors,
        tuple(analog for each in several for analog in each.analogs) if several else own.analogs,
        tuple(word for each in several for word in each.digitals) if several else own.digitals,
        tuple(each.stat for each in several),
        tuple(each.frequency for each in several),
        tuple(each.rocof for each in several),
        time_base=data.layout.time_base,
    )


def undecoded_frame(name: str, frame: Frame) -> PmuFrame:
    """A frame for which no configuration came: its bytes, and what is told without one, which the time is not."""
    stat = int.from_bytes(frame.data[PREFIX_SIZE : PREFIX_SIZE + 2], "big")
    quality = decode_prefix(frame.data).time_quality
    return PmuFrame(name, bytes(frame.data), 0, frame.arrival_ns, frame.stamp_source, stat, quality, _NAN, time_base=0)


def from_message(name: str, message: Any) -> PmuFrame:
    """The inverse of :func:`encode_frame`, for a decoded protobuf message."""
    return PmuFrame(
        name,
        message.wire,
        message.time_ns,
        message.arrival_ns or None,
        _STAMP_SOURCES.get(message.stamp_source, StampSource.CAPTURE),
        message.stat,
        message.time_quality,
        message.frequency_hz,
        message.rocof_hz_s,
        complex(message.v1_re, message.v1_im),
        tuple(map(complex, message.phasor_re, message.phasor_im)),
        tuple(message.analog),
        tuple(message.digital),
        tuple(message.station_stat),
        tuple(message.station_frequency_hz),
        tuple(message.station_rocof_hz_s),
        message.tick_ns,
        message.time_base,
    )


def iter_pmu_frames(source: LogReader | str | os.PathLike[str]) -> Iterator[WireFrame]:
    """Every frame of a log as it was received, configurations first, in file order.

    Give a :class:`LogReader` to look at its ``damage`` afterwards. Raises SourceError as that does.
    """
    reader = source if isinstance(source, LogReader) else LogReader(source)
    for record in reader.records({"PmuFrame"}):
        if isinstance(record, LogMessage):
            message = reader.decode(record)
            if message is not None:
                stamp_source = _STAMP_SOURCES.get(message.stamp_source, StampSource.CAPTURE)
                yield WireFrame(name_of(record.channel.topic), message.wire, message.arrival_ns or None, stamp_source)
        elif isinstance(record, LogAttachment) and (name := config_name(record.name)) is not None:
            yield WireFrame(name, record.data, record.time_ns or None, StampSource.CAPTURE)


def config_name(attachment: str) -> str | None:
    """Which PMU's configuration an attachment is; None where it is something else."""
    match = _CONFIG_NAME.fullmatch(attachment)
    return match[1] if match else None


def _describe(config: StreamConfig) -> dict[str, str]:
    """Channel metadata: what the places in the lists of a PmuFrame mean."""
    stations = config.stations
    return {
        "idcode": str(config.idcode),
        "rate_hz": str(config.rate),
        "stations": ", ".join(station.name for station in stations),
        "phasors": ", ".join(f"{s.name}.{phasor.name} [{phasor.kind}]" for s in stations for phasor in s.phasors),
        "analogs": ", ".join(f"{station.name}.{analog.name}" for station in stations for analog in station.analogs),
    }
