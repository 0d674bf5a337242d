"""The link: a bit rate with a queue, and slots in which everything waiting leaves at once.

Both keep the order in which frames reach them.
"""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass, field

from pmutools.draws import Draws
from pmutools.impair.blocks import Blocks
from pmutools.impair.delays import DrawnTerms
from pmutools.impair.distributions import Distribution, distribution
from pmutools.impair.moment import Moment, Test
from pmutools.impair.outgoing import Fate, Outgoing
from pmutools.impair.selectors import ANY, Selector, selector_of_any
from pmutools.parsers import integer, parsed_by
from pmutools.timebase import NS

_RATE = re.compile(r"(\d+(?:\.\d+)?)\s*([kMG]?)(?:bit(?:/s)?)?", re.ASCII)
_FACTOR = {"": 1.0, "k": 1e3, "M": 1e6, "G": 1e9}


def bit_rate(text: str) -> float:
    """``64k``, ``64kbit``, ``1.5M``: bits per second."""
    match = _RATE.fullmatch(text.strip())
    if match is None or not float(match[1]):
        raise ValueError(f"{text!r} is not a bit rate; write 64k or 1.5M (bit/s)")
    return float(match[1]) * _FACTOR[match[2]]


@dataclass(frozen=True, slots=True)
class Rate:
    """Frames leave one after the other, each taking (bytes + ``overhead``) * 8 / rate.

    ``queue`` frames may wait; what comes to a full queue is lost. ``overhead`` 28 is UDP over IPv4, 46 with Ethernet.
    """

    bits_per_s: float = field(metadata=parsed_by(bit_rate))
    overhead: int = field(default=0, metadata=parsed_by(integer(0, 1000)))
    queue: int = field(default=1000, metadata=parsed_by(integer(1, 1_000_000)))
    when: Selector = field(default=ANY, metadata=parsed_by(selector_of_any))


class RateLink:
    """Rate at work on one stream."""

    def __init__(self, part: Rate, selected: Test) -> None:
        self._ns_per_byte = 8 * NS / part.bits_per_s
        self._part = part
        self._selected = selected
        self._waiting = deque[int]()
        self._free_ns = 0

    def apply(self, outgoing: Outgoing, at: Moment) -> Outgoing:
        if not self._selected(at):
            return outgoing
        waiting, arrival_ns = self._waiting, outgoing.offset_ns
        while waiting and waiting[0] <= arrival_ns:
            waiting.popleft()
        if len(waiting) >= self._part.queue:
            return outgoing._replace(fate=Fate.LOST, marks=(*outgoing.marks, "rate:full"))
        sending_ns = round((len(outgoing.data) + self._part.overhead) * self._ns_per_byte)
        leaves_ns = self._free_ns = max(arrival_ns, self._free_ns) + sending_ns
        waiting.append(leaves_ns)
        mark = f"rate:{(leaves_ns - arrival_ns) / 1e6:.6g}ms"
        return outgoing._replace(offset_ns=leaves_ns, marks=(*outgoing.marks, mark))


MIN_SLOT_NS = 100_000


@dataclass(frozen=True, slots=True)
class Slot:
    """Frames wait for the next slot; slots follow each other at intervals of a DIST (ms), from the start of play.

    At most ``frames`` leave in one slot (0: all).
    """

    interval: Distribution = field(metadata=parsed_by(distribution))
    frames: int = field(default=0, metadata=parsed_by(integer(0)))
    when: Selector = field(default=ANY, metadata=parsed_by(selector_of_any))


class SlotLink:
    """Slot at work on one stream."""

    def __init__(self, part: Slot, draws: Draws, selected: Test) -> None:
        self._intervals_ns = Blocks(DrawnTerms({0: part.interval}, draws))
        self._frames = part.frames
        self._selected = selected
        self._number = 0
        self._slot_ns = 0
        self._used = 0

    def apply(self, outgoing: Outgoing, at: Moment) -> Outgoing:
        if not self._selected(at):
            return outgoing
        while self._slot_ns < outgoing.offset_ns or (self._frames and self._used >= self._frames):
            self._slot_ns += max(MIN_SLOT_NS, self._intervals_ns[self._number])
            self._number += 1
            self._used = 0
        self._used += 1
        mark = f"slot:{(self._slot_ns - outgoing.offset_ns) / 1e6:.6g}ms"
        return outgoing._replace(offset_ns=self._slot_ns, marks=(*outgoing.marks, mark))
