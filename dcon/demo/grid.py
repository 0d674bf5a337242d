"""The demo's grid as a process of its own: it integrates in real time, sends eight PMUs, and takes the command.

``python -m dcon.demo.grid --start-ns N --command-port P --pmu-port P0 ...``; knows nothing of the controller but
datagrams. What its PMUs send goes through the player's fault pipeline. With ``--status-port`` it tells the status of
the DC line ten times a second.
"""

from __future__ import annotations

import argparse
import heapq
import socket
import sys
from contextlib import suppress

from dcon.core.values import Pdci
from dcon.demo.course import Course
from dcon.drivers import line_status
from dcon.link import command as datagrams
from dcon.link.sealed import follows
from pmutools import timebase
from pmutools.c37118.session import served
from pmutools.clock import SystemClock, utc_offset
from pmutools.errors import PmuError
from pmutools.grid.emulate import EmulatedStream
from pmutools.grid.grid import Grid
from pmutools.grid.plant import build
from pmutools.grid.pmu_model import fleet, measure
from pmutools.impair.outgoing import Fate
from pmutools.impair.pipeline import Pipeline
from pmutools.impair.profiles import load_profile
from pmutools.net.endpoint import parse_endpoint
from pmutools.net.server import Senders
from pmutools.net.udp import UdpSocket
from pmutools.realtime import go_realtime

RATE = 60
SILENCE_NS = 500_000_000
"""Without a command for so long the line goes back to its schedule."""
SPIN_NS = 100_000
PRIORITY = 5
"""Where the system permits it: a grid keeps its time whatever else a machine does. Below the controller's."""
SCHEDULED_MW = 2000.0
"""Of the line, north to south: room for ±125 MW on either side."""
STATUS_SLOTS = RATE // 10
"""From one status of the line to the next."""


class LiveGrid:
    """The grid, its PMUs on the wire, and its command input."""

    def __init__(
        self,
        course: Course,
        start_ns: int,
        command_port: int,
        pmu_port: int,
        profile: str,
        noise_rad: float,
        seed: int,
        status_port: int | None = None,
    ) -> None:
        self.clock = SystemClock(spin_ns=SPIN_NS)
        self.grid = Grid(build("modal"), course.scenario, start_ns=start_ns, seed=seed)
        self.start_ns, self.end_ns = start_ns, start_ns + round(course.end_s * timebase.NS)
        self.inbox = UdpSocket("127.0.0.1", command_port)
        self.senders = Senders(self.clock)
        self.pmus = fleet(noise_rad=noise_rad, seed=seed)
        faults = load_profile(profile)
        self.streams: list[EmulatedStream] = []
        self.handles: list[int] = []
        self.pipelines: list[Pipeline] = []
        for number, pmu in enumerate(self.pmus):
            stream = EmulatedStream([pmu], RATE)
            handle = self.senders.add(served(stream.config))
            self.senders.send_to(parse_endpoint(f"udp://127.0.0.1:{pmu_port + number}"), [handle])
            self.streams.append(stream)
            self.handles.append(handle)
            names = (str(pmu.idcode), pmu.bus)
            self.pipelines.append(Pipeline(faults, pmu.name, seed, config=stream.config, aliases=names))
        self.last_sequence: int | None = None
        self.last_command_ns = 0
        self.status_to: socket.socket | None = None
        if status_port is not None:
            self.status_to = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self.status_to.setblocking(False)
            self.status_to.connect(("127.0.0.1", status_port))

    def run(self) -> None:
        """From the start to the end of the course, in real time."""
        go_realtime(fifo=True, priority=PRIORITY)
        offset = utc_offset(self.clock)
        self.senders.announce()
        due: list[tuple[int, int, int, bytes]] = []
        order = slot = 0
        announced_s = 0
        while (stamp_ns := self.start_ns + (slot * timebase.NS + RATE // 2) // RATE) < self.end_ns or due:
            next_ns = min(stamp_ns if stamp_ns < self.end_ns else 1 << 62, due[0][0] if due else 1 << 62)
            self.senders.serve_until(offset.monotonic_ns(next_ns))
            self._take_commands()
            if next_ns == stamp_ns:
                self._silence(stamp_ns)
                self.grid.advance(stamp_ns)
                self._tell_status(slot, stamp_ns)
                buses = self.grid.buses()
                for number, (pmu, stream) in enumerate(zip(self.pmus, self.streams, strict=True)):
                    report = measure(pmu, buses, stamp_ns, slot)
                    frame = stream.data_frame([report])
                    for out in self.pipelines[number].apply(slot, frame, stamp_ns - self.start_ns):
                        if out.fate is Fate.SENT:
                            heapq.heappush(due, (self.start_ns + out.offset_ns, order, number, out.data))
                            order += 1
                slot += 1
                if slot // RATE > announced_s:  # late listeners wait a second, not a minute
                    announced_s = slot // RATE
                    self.senders.announce()
                    offset = utc_offset(self.clock, 3)
            now_ns = offset.realtime_ns(self.clock.monotonic_ns())
            ready = []
            while due and due[0][0] <= now_ns:
                _, _, number, data = heapq.heappop(due)
                ready.append((self.handles[number], data))
            if ready:
                self.senders.publish(ready)

    def _take_commands(self) -> None:
        for chunk in self.inbox.read():
            command = datagrams.decode(chunk.data)
            last = self.last_sequence
            if command is None or (last is not None and not follows(command.sequence, last)):
                continue
            self.last_sequence = command.sequence
            self.last_command_ns = chunk.arrival_ns or command.time_ns
            self.grid.command(command.command_mw, self.last_command_ns)

    def _tell_status(self, slot: int, now_ns: int) -> None:
        """The schedule, and on it what has arrived of the command by now."""
        if self.status_to is None or slot % STATUS_SLOTS:
            return
        line = Pdci(now_ns, SCHEDULED_MW + self.grid.command_mw, scheduled_mw=SCHEDULED_MW)
        with suppress(OSError):  # nobody has to listen
            self.status_to.send(line_status.encode(slot // STATUS_SLOTS, line))

    def _silence(self, now_ns: int) -> None:
        """The line goes back to its schedule, and the next to command may begin its sequence anew."""
        if self.last_sequence is not None and now_ns - self.last_command_ns > SILENCE_NS:
            self.last_sequence = None
            self.grid.command(0.0, now_ns)

    def close(self) -> None:
        self.senders.close()
        self.inbox.close()
        if self.status_to is not None:
            self.status_to.close()


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="dcon.demo.grid")
    parser.add_argument("--start-ns", type=int, required=True)
    parser.add_argument("--command-port", type=int, required=True)
    parser.add_argument("--pmu-port", type=int, required=True)
    parser.add_argument("--open-loop-s", type=float, required=True)
    parser.add_argument("--swing-s", type=float, required=True)
    parser.add_argument("--profile", required=True)
    parser.add_argument("--noise-rad", type=float, required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--status-port", type=int, help="Send the line's status (DCP1) to this port of loopback.")
    given = parser.parse_args(arguments)
    try:
        grid = LiveGrid(
            Course(given.open_loop_s, given.swing_s),
            given.start_ns,
            given.command_port,
            given.pmu_port,
            given.profile,
            given.noise_rad,
            given.seed,
            given.status_port,
        )
    except PmuError as error:
        sys.stderr.write(f"grid: {error}\n")
        return 1
    try:
        grid.run()
    except KeyboardInterrupt:
        return 130
    finally:
        grid.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
