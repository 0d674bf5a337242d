"""Capture files: .pcap and .pcapng, also .gz and .zst, to chunks of their UDP and TCP flows and back.

::

    file -> window -> pcap | pcapng -> link -> ip -> (udp) | tcp -> Chunk        reader.CaptureReader
    Chunk -> packets -> pcap | pcapng -> file                                    writer.CaptureWriter
"""

from pmutools.formats.capture.reader import CaptureReader, is_capture
from pmutools.formats.capture.tally import Fate, Tally
from pmutools.formats.capture.writer import CaptureWriter

__all__ = ["CaptureReader", "CaptureWriter", "Fate", "Tally", "is_capture"]
