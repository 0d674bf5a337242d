"""``python -m dcon.front``."""

from __future__ import annotations

import argparse
import socket
import sys
from pathlib import Path

from dcon.front.front import BEAT_NS, PRIORITY, Front, Outlet
from dcon.front.receiving import Reception
from dcon.link.beats import LoopName
from dcon.link.counts import FrontCounts
from dcon.link.failure import Failure
from dcon.link.paths import WATCHDOG, Sender
from dcon.link.pulse import Pulse
from dcon.settings import load
from pmutools.clock import SystemClock
from pmutools.errors import PmuError
from pmutools.realtime import go_realtime


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="dcon.front")
    parser.add_argument("--ini", required=True)
    parser.add_argument("--fd", type=int, required=True)
    parser.add_argument("--run-dir", type=Path, required=True)
    given = parser.parse_args(arguments)
    sock = socket.socket(fileno=given.fd)
    counts = FrontCounts()
    outlet = Outlet(sock, counts)
    clock = SystemClock()
    try:
        settings = load(given.ini)
        reception = Reception.of([site.endpoint for site in settings.sites], clock, counts)
    except PmuError as error:
        outlet.add(Failure.of(error))
        outlet.flush()
        return 1
    try:
        sender = Sender(given.run_dir / WATCHDOG)
        udp, parse = (Pulse(name, sender, BEAT_NS) for name in (LoopName.UDP, LoopName.PARSE))
        go_realtime(fifo=settings.platform.fifo, priority=PRIORITY)
        Front(reception, outlet, udp, parse, clock).run()
    finally:
        reception.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
