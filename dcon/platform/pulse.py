"""The heartbeat of a loop, to the watchdog."""

from __future__ import annotations

import struct
import zlib
from enum import IntEnum

from dcon.link.paths import Sender
from pmutools.timebase import NS

_BODY = struct.Struct(">4s8sIqB3x")
_CRC = struct.Struct(">I")


class LoopState(IntEnum):
    """What a beat says of its loop."""

    STARTING = 0
    RUNNING = 1
    ENDING = 2
    FAILED = 3


def _beat(loop: str, counter: int, monotonic_ns: int, state: LoopState) -> bytes:
    """``DCB1``; the counter wraps at 2**32."""
    body = _BODY.pack(b"DCB1", loop.encode("ascii"), counter % (1 << 32), monotonic_ns, state)
    return body + _CRC.pack(zlib.crc32(body))


class Pulse:
    """Sends the beats of one loop, from the loop itself: when it hangs, they stop."""

    def __init__(self, loop: str, sender: Sender, period_ns: int = NS // 10) -> None:
        self._loop, self._sender, self._period_ns = loop, sender, period_ns
        self._counter = 0
        self.due_ns = 0
        """When the next is due."""

    def beat(self, now_ns: int, state: LoopState = LoopState.RUNNING) -> None:
        """Send a beat where it is due, or says that the loop ends."""
        if now_ns >= self.due_ns or state is LoopState.ENDING:
            self._sender.send(_beat(self._loop, self._counter, now_ns, state))
            self._counter += 1
            self.due_ns = now_ns + self._period_ns
