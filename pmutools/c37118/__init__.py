"""IEEE C37.118.2-2011 synchrophasor frames: a sans-I/O codec.

One layout behind three ways in: single frames (:func:`decode_data`), batches of equal frames
(:func:`pmutools.c37118.batch.decode_batch`, which needs numpy and is therefore not imported here), and the scapy
layer in :mod:`pmutools.c37118_scapy`. Bytes of unknown beginning go through :class:`Framer` or :class:`Demux`.
"""

from pmutools.c37118.config import (
    AnalogChannel,
    AnalogScale,
    DigitalWord,
    PhasorChannel,
    PhasorScale,
    Station,
    StationDetails,
    StreamConfig,
    decode_config,
    encode_config,
)
from pmutools.c37118.config_kinds import as_kind
from pmutools.c37118.constants import Command, Format, FrameType, Stat
from pmutools.c37118.demux import Demux, Loss, Message
from pmutools.c37118.framer import Frame, Framer, Skipped, SkipReason
from pmutools.c37118.frames import (
    CommandFrame,
    Data,
    HeaderFrame,
    StationData,
    decode_command,
    decode_data,
    decode_header,
    encode_command,
    encode_data,
    encode_header,
    encode_message,
    restamp,
)
from pmutools.c37118.prefix import Prefix, decode_prefix

__all__ = [
    "AnalogChannel",
    "AnalogScale",
    "Command",
    "CommandFrame",
    "Data",
    "Demux",
    "DigitalWord",
    "Format",
    "Frame",
    "FrameType",
    "Framer",
    "HeaderFrame",
    "Loss",
    "Message",
    "PhasorChannel",
    "PhasorScale",
    "Prefix",
    "SkipReason",
    "Skipped",
    "Stat",
    "Station",
    "StationData",
    "StationDetails",
    "StreamConfig",
    "as_kind",
    "decode_command",
    "decode_config",
    "decode_data",
    "decode_header",
    "decode_prefix",
    "encode_command",
    "encode_config",
    "encode_data",
    "encode_header",
    "encode_message",
    "restamp",
]
