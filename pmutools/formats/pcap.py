"""``.pcap`` and ``.pcapng`` as source and sink; the work is done in :mod:`pmutools.formats.capture`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.demux import Message
from pmutools.c37118.frames import stamp_ns
from pmutools.flow import Chunk
from pmutools.formats.capture import CaptureReader, CaptureWriter, Fate
from pmutools.formats.capture.pcapng import is_pcapng
from pmutools.formats.capture.window import Window
from pmutools.formats.sink import FrameSink, SinkOptions
from pmutools.formats.source import ByteSource

LOSSES = (Fate.TRUNCATED, Fate.FRAGMENT_LOST, Fate.DAMAGED, Fate.TCP_STRAY, Fate.UNSUPPORTED_LINK)
DYNAMIC_PORT = 49152


def read(path: Path, configs: Iterable[StreamConfig] = ()) -> ByteSource:
    """Open a capture; what of the file was damaged or lost is counted in ``defects``, other traffic is not."""
    reader = CaptureReader(path)
    with Window(path) as window:
        window.advance(0, 12)
        kind = "pcapng" if is_pcapng(window.data) else "pcap"

    def defects() -> dict[str, int]:
        tally = reader.tally
        counts = {
            "bytes of damaged records": tally.skipped_bytes,
            "bytes of a cut record": tally.cut_bytes,
            "compression damaged": int(tally.decompression_failed),
            "bytes missing from TCP": tally.lost_bytes,
        }
        counts |= {f"packets {fate}": tally.packets[fate] for fate in LOSSES}
        return {name: count for name, count in counts.items() if count}

    return ByteSource(path, kind, reader, defects, configs, reader.trains())


class CaptureSink(FrameSink):
    """One packet a frame. In a .pcap, which needs a time, a frame without an arrival has that of its stamp.

    The unknown end of a TCP flow becomes the unspecified address, at the first dynamic port.
    """

    def __init__(self, path: Path, suffix: str) -> None:
        super().__init__(path)
        self._writer = CaptureWriter(path, suffix)
        self._stamps_needed = suffix == ".pcap"
        self._last_ns = 0

    def put(self, message: Message) -> None:
        frame, flow, config = message
        arrival_ns = frame.arrival_ns
        if arrival_ns is None and self._stamps_needed:
            if config is not None:
                self._last_ns = stamp_ns(frame.data, config)
            arrival_ns = self._last_ns
        if flow.transport == "tcp" and not flow.destination:
            host = "[::]" if flow.source.startswith("[") else "0.0.0.0"
            flow = flow._replace(destination=f"{host}:{DYNAMIC_PORT}")
        self._writer.write(Chunk(frame.data, arrival_ns, flow, frame.stamp_source))

    def flush(self) -> None:
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()


def create(path: Path, options: SinkOptions) -> CaptureSink:
    """Begin a capture; the suffix says which kind."""
    return CaptureSink(path, options.suffix)
