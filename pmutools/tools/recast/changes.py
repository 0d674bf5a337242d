"""What recasting did, counted and told; and what all ways of it share."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from pmutools.c37118.batch import Batch
from pmutools.c37118.checksum import seal_array
from pmutools.c37118.config import StreamConfig, encode_config
from pmutools.c37118.demux import Loss, Message
from pmutools.c37118.prefix import decode_prefix
from pmutools.flow import Flow
from pmutools.formats.source import Block, frames_of

Item = Block | Message | Loss
Stream = tuple[Flow, int]


@dataclass
class Changes:
    """What the functions of this package did; they fill it in as they go."""

    renumbered: dict[int, int] = field(default_factory=dict)
    """IDCODEs of streams that were seen, old to new."""
    renamed: dict[str, str] = field(default_factory=dict)
    """Names of stations that were seen, old to new."""
    missing: set[str] = field(default_factory=set)
    """IDCODEs and names to be changed that were not seen (yet)."""
    reformatted: int = 0
    """Frames encoded anew."""
    clipped: int = 0
    """Values beyond the range of their integer field; the end of the range was sent."""
    concentrated: int = 0
    """Frames of the concentrated stream."""
    filled: int = 0
    """Stations in them without a frame at that instant."""
    late: int = 0
    """Frames left out because their instant had been sent before they came."""
    repeated: int = 0
    """Frames left out because their station had one for the instant already."""
    reconfigured: int = 0
    """Frames left out because their stream's channels were no longer those that it began with."""


def described(changes: Changes) -> list[str]:
    """What was done and what was lost by it, one line each; nothing for what did not happen."""
    lines = [f"stream {old} sent as {new}" for old, new in changes.renumbered.items()]
    lines += [f"station {old} sent as {new}" for old, new in changes.renamed.items()]
    lines += [f"{name}: not in the source, so nothing was changed" for name in sorted(changes.missing)]
    if changes.concentrated:
        lines.append(f"{changes.concentrated} frames concentrated, {changes.filled} stations filled in as absent")
    for count, text in (
        (changes.reformatted, "frames encoded in another FORMAT"),
        (changes.clipped, "values clipped to the range of their 16-bit field"),
        (changes.late, "frames came too late to be concentrated and were left out"),
        (changes.repeated, "frames left out whose station had sent that instant already"),
        (changes.reconfigured, "frames left out after their stream changed its channels"),
    ):
        if count:
            lines.append(f"{count} {text}")
    return lines


def configured(message: Message, config: StreamConfig) -> Message:
    """A configuration frame with another content, at the same time."""
    prefix = decode_prefix(message.frame.data)
    data = encode_config(config, soc=prefix.soc, fracsec=prefix.fracsec, time_quality=prefix.time_quality)
    return message._replace(frame=message.frame._replace(data=data), config=config)


def sealed_frames(wire: npt.NDArray[np.void], config: StreamConfig) -> npt.NDArray[np.void]:
    """``wire``, which is ours, with its CHK made anew."""
    seal_array(wire.view(np.uint8).reshape(len(wire), config.frame_size))
    wire.flags.writeable = False
    return wire


def announcement(flow: Flow, config: StreamConfig, batch: Batch) -> Message:
    """The configuration frame of ``config``, stamped and arriving as the first frame of ``batch``."""
    return next(frames_of(Block(flow, replace(batch[:1], config=config, wire=None)), {}))
