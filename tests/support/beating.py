"""A platform as the watchdog sees it: commands and beats, 60 times a second, to be killed or stopped.

``python -m support.beating FOLDER [NAME=VALUE ...]``. It asks for the relays after ten ticks, and commands 5 V once
the watchdog says that they are closed. With ``flood=N`` it sends N datagrams of garbage a second instead.
"""

from __future__ import annotations

import os
import socket
import sys
import time
from contextlib import suppress

from dcon.link.beats import LoopName, Verb, decode_status, encode_beat, encode_word
from dcon.watchdog.codec import RELAYS, encode_command  # it starts faster than the driver's

LOOPS = [LoopName(name) for name in ("control", "udp", "parse", "gps", "gui", "pdci")]
PERIOD_NS = 10**9 // 60


def platform(folder: str, volts: float = 5.0) -> None:
    """Until killed."""
    out = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    inbox = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    for sock in (out, inbox):
        sock.setblocking(False)
    inbox.bind(os.path.join(folder, "control.in"))
    to, closed, start_ns = os.path.join(folder, "watchdog.in"), False, time.monotonic_ns()
    tick = 0
    while True:
        with suppress(BlockingIOError):
            while True:
                status = decode_status(inbox.recv(64))
                closed = status is not None and status.closed
        driven = volts if closed else 0.0
        command = encode_command(tick, time.time_ns(), driven * 12.5, driven, RELAYS if tick > 10 else 0)
        beats = [encode_beat(loop, tick, time.monotonic_ns()) for loop in LOOPS]
        with suppress(OSError):
            for datagram in (command, *beats):
                out.sendto(datagram, to)
        tick += 1
        time.sleep(max(0.0, (start_ns + tick * PERIOD_NS - time.monotonic_ns()) / 1e9))


def flood(folder: str, per_s: float) -> None:
    """Garbage, until killed; a word that is refused says that it begins."""
    out = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    out.setblocking(False)
    to, start_ns, sent = os.path.join(folder, "watchdog.in"), time.monotonic_ns(), 0
    out.sendto(encode_word(Verb.RESET, "flood"), to)
    while True:
        due = int((time.monotonic_ns() - start_ns) / 1e9 * per_s)
        for _ in range(sent, due):
            with suppress(OSError):
                out.sendto(b"garbage" * 8, to)
        sent = due
        time.sleep(0.001)


if __name__ == "__main__":
    given = dict(word.split("=") for word in sys.argv[2:])
    if "flood" in given:
        flood(sys.argv[1], float(given["flood"]))
    else:
        platform(sys.argv[1], **{name: float(value) for name, value in given.items()})
