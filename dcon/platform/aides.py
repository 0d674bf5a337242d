"""The aides of the control process: three loops beside it that may wait, so that it need not.

- ``gps`` asks whoever disciplines this machine's clock (``[platform] time_source``) whether it has its lock;
- ``pdci`` takes the status of the DC line (``[pdci] url``);
- ``gui`` lets signed orders of operators pass.

Each tells the control process and beats to the watchdog every 100 ms. A loop itself never waits for longer: what may
take its time to answer (gpsd, chrony, Modbus) is asked in threads beside it. So a gpsd that hangs shows as a lock that
grows old, a line's device that hangs as a status that does, and a loop that hangs as a beat that is missing.

``python -m dcon.platform.aides --ini FILE --run-dir DIR`` ends with its parent.
"""

from __future__ import annotations

import argparse
import json
import logging
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from dcon.core.values import Pdci
from dcon.drivers.line_status import LineOnModbus, StatusInbox
from dcon.link import paths
from dcon.link.beats import LoopName, LoopState
from dcon.link.keys import read_keys
from dcon.link.paths import Sender
from dcon.places import LineSource, ModbusLine
from dcon.platform.gps_lock import Lock, Verdict, judge
from dcon.platform.handing import Handing, Reply
from dcon.platform.order_gate import OrderGate, Passed
from dcon.platform.pulse import Pulse
from dcon.sections import Platform
from dcon.settings import Settings, load
from pmutools import linux
from pmutools.clocksources.asking import Patience
from pmutools.clocksources.watch import HERE, ClockSources, Places
from pmutools.errors import PmuError
from pmutools.log_thread import log_in_thread
from pmutools.measure.clockquality import ClockQuality
from pmutools.net.endpoint import Endpoint
from pmutools.net.sockets import explain, resolve
from pmutools.timebase import NS

LOG = logging.getLogger("dcon.platform.aides")  # also as __main__
ROUND_S = 0.1
"""Longest wait of a loop."""
AGAIN_S = 0.005
"""From one try to hand on an order to the next."""
TELL_NS = NS
"""The lock is told so often, and when it changes."""
ASK_S = 1.0
"""From one question to the next."""
PATIENCE_S = 3.0
LEAVE_S = 2.0
SPARE_S = 0.02
"""Least time between two rounds of the ``pdci`` loop: a flood of datagrams is taken in gulps, and told once each."""
AT_ONCE = 2048
"""Datagrams taken in one round."""


class Aide(threading.Thread):
    """One loop: its rounds, its beats, and its words to the control process."""

    def __init__(self, loop: LoopName, run_dir: Path) -> None:
        super().__init__(name=loop, daemon=True)
        self._watchdog, self._control = Sender(run_dir / paths.WATCHDOG), Sender(run_dir / paths.CONTROL)
        self._pulse = Pulse(loop, self._watchdog)
        self._stopped = threading.Event()
        self.failure = ""
        """Why the loop has ended by itself."""

    def run(self) -> None:
        try:
            while not self._stopped.is_set():
                self.round()
                self._pulse.beat(time.monotonic_ns())
        except Exception as error:  # the edge of the loop: its beats stop, and the process ends
            LOG.exception("the %s loop failed", self.name)
            self.failure = f"{type(error).__name__}: {error}"
        finally:
            self._pulse.due_ns = 0
            self._pulse.beat(time.monotonic_ns(), LoopState.FAILED if self.failure else LoopState.ENDING)
            self.release()

    def stop(self) -> None:
        """Ask for the end of the loop."""
        self._stopped.set()

    def round(self) -> None:
        """Do what there is to do, and wait for :data:`ROUND_S` at most."""
        raise NotImplementedError

    def release(self) -> None:
        """Let go of what the loop holds."""
        self._watchdog.close()
        self._control.close()

    def tell(self, news: dict[str, Any]) -> None:
        """To the control process."""
        self._control.send(json.dumps(news, allow_nan=False).encode())


class GpsAide(Aide):
    """The lock of this machine's clock."""

    def __init__(self, platform: Platform, run_dir: Path, places: Places = HERE) -> None:
        super().__init__(LoopName.GPS, run_dir)
        self._source, self._limit_ns = platform.time_source, round(platform.time_bound_ms * 1e6)
        self._lock = Lock()
        self._sources = ClockSources(places)
        self._told: tuple[Verdict | None, bool] = None, False
        self._told_ns = 0
        self._broken: Exception | None = None
        if self._source != "none":
            threading.Thread(target=self._ask, name="gps-questions", daemon=True).start()

    def _ask(self) -> None:
        """Ask again and again; every answer is judged as it comes."""
        quality = ClockQuality()
        field = "gps" if self._source == "gpsd" else self._source
        try:
            while not self._stopped.is_set():
                if field == "auto":
                    quality = self._sources.ask(quality, self._stopped, self._judge)
                else:
                    quality = self._sources.ask_one(field, ClockQuality(), Patience(PATIENCE_S, self._stopped))
                    self._judge(quality)
                self._stopped.wait(ASK_S)
        except Exception as error:  # the edge of this thread: the loop fails of it
            self._broken = error

    def _judge(self, quality: ClockQuality) -> None:
        if not self._stopped.is_set():
            self._lock.hear(judge(self._source, quality, self._sources.silent, self._limit_ns), time.monotonic_ns())

    def round(self) -> None:
        self._stopped.wait(ROUND_S)
        if self._broken is not None:
            raise self._broken
        now_ns = time.monotonic_ns()
        verdict, age_s = self._lock.said(now_ns), self._lock.age_s(now_ns)
        if verdict is None or age_s is None:
            return
        state = verdict._replace(detail=""), age_s == 0
        if state == self._told and now_ns - self._told_ns < TELL_NS:
            return
        if state != self._told:
            level = logging.INFO if verdict.locked else logging.WARNING
            LOG.log(level, "GPS lock of the clock: %s, by %s: %s", "yes" if verdict.locked else "no", *verdict[1:])
        self._told, self._told_ns = state, now_ns
        self.tell({"kind": "gps", "age_s": age_s, "source": verdict.source, "detail": verdict.detail})


class PdciAide(Aide):
    """The status of the DC line."""

    def __init__(self, source: LineSource | None, run_dir: Path) -> None:
        """Raises SourceError where the address cannot be bound."""
        super().__init__(LoopName.PDCI, run_dir)
        self._sock = _bound(source) if isinstance(source, Endpoint) else None
        self._from = source.source if isinstance(source, Endpoint) else None
        self._device = LineOnModbus(source) if isinstance(source, ModbusLine) else None
        self.inbox = StatusInbox()
        self.foreign = 0
        """Datagrams from another address than the one configured."""
        self._told: Pdci | None = None

    def round(self) -> None:
        if self._sock is None:
            self._stopped.wait(ROUND_S)
        elif select.select([self._sock], [], [], ROUND_S)[0]:
            status = self.inbox.take(self._datagrams(self._sock), time.monotonic_ns(), time.time_ns())
            if status is not None:
                self._tell(status)
            self._stopped.wait(SPARE_S)
        if self._device is not None and (newest := self._device.newest) is not None and newest is not self._told:
            self._tell(newest)

    def _tell(self, line: Pdci) -> None:
        self._told = line
        said = line._asdict()
        if line.scheduled_mw != line.scheduled_mw:  # NaN, which JSON has not
            said["scheduled_mw"] = None
        self.tell({"kind": "pdci", **said})

    def _datagrams(self, sock: socket.socket) -> list[bytes]:
        found: list[bytes] = []
        with suppress(OSError):
            for _ in range(AT_ONCE):
                data, sender = sock.recvfrom(128)
                if self._from is None or sender[0] == self._from:
                    found.append(data)
                else:
                    self.foreign += 1
        return found

    def release(self) -> None:
        super().release()
        if self._sock is not None:
            self._sock.close()
        if self._device is not None:
            self._device.close()


def _bound(where: Endpoint) -> socket.socket:
    address = resolve(where.host, where.port, datagram=True)
    sock = socket.socket(address.family, socket.SOCK_DGRAM)
    try:
        sock.setblocking(False)
        sock.bind(address.sockaddr)
    except OSError as error:
        sock.close()
        raise explain(error, f"[pdci] {where}") from None
    return sock


class GuiAide(Aide):
    """Operators' orders."""

    def __init__(self, gate: OrderGate, run_dir: Path) -> None:
        """Raises SourceError where another process has the place."""
        super().__init__(LoopName.GUI, run_dir)
        self._inbox = paths.bind_datagram(run_dir, paths.AIDE)
        self.gate = gate
        self.handing = Handing()
        self._run_dir = run_dir.resolve()

    def round(self) -> None:
        passed = Passed()
        if select.select([self._inbox], [], [], AGAIN_S if len(self.handing) else ROUND_S)[0]:
            with suppress(BlockingIOError):
                passed = self.gate.take(self._inbox.recv(1 << 16), time.monotonic_ns(), time.time_ns())
        now_ns = time.monotonic_ns()
        self.handing.add(passed, now_ns)
        replies = self.handing.send(self._control.send, now_ns)
        if passed.reply is not None:
            replies.append(Reply(passed.reply_to, passed.reply))
        for path, said in replies:
            self._reply(Path(path), said)

    def _reply(self, where: Path, reply: dict[str, Any]) -> None:
        """To a name in the run folder only: who writes to this loop must not have it write elsewhere."""
        if where.name and where.parent.resolve() == self._run_dir:
            sender = Sender(where)
            sender.send(json.dumps(reply).encode())
            sender.close()

    def release(self) -> None:
        super().release()
        paths.release(self._inbox)


def aides(settings: Settings, run_dir: Path) -> list[Aide]:
    """The three loops, not yet started. Raises SourceError where a place is taken."""
    made: list[Aide] = []
    try:
        made.append(GuiAide(_gate(settings, run_dir), run_dir))
        made.append(PdciAide(settings.line_input.url, run_dir))
        made.append(GpsAide(settings.platform, run_dir))
    except BaseException:
        for aide in made:
            aide.release()
        raise
    return made


def _gate(settings: Settings, run_dir: Path) -> OrderGate:
    operators = {} if settings.server.keys is None else read_keys(settings.server.keys)
    return OrderGate(operators, settings.server.window_s, run_dir, time.time_ns())


def work(loops: list[Aide], stopping: Callable[[], bool]) -> str:
    """Run the loops until ``stopping`` or until one fails; returns why, "" where none did."""
    for aide in loops:
        aide.start()
    while not stopping() and all(aide.is_alive() for aide in loops):
        time.sleep(ROUND_S)
    failure = "; ".join(f"the {aide.name} loop failed: {aide.failure}" for aide in loops if aide.failure)
    for aide in loops:
        aide.stop()
    for aide in loops:
        aide.join(LEAVE_S)
    return failure


def main(arguments: list[str]) -> int:
    """``python -m dcon.platform.aides``."""
    parser = argparse.ArgumentParser(prog="dcon.platform.aides")
    parser.add_argument("--ini", required=True)
    parser.add_argument("--run-dir", type=Path, required=True)
    given = parser.parse_args(arguments)
    linux.end_with_parent(signal.SIGKILL)
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopping.set())
    try:
        with log_in_thread():  # a stuck reader of what is logged must not hold up the beats
            failure = work(aides(load(given.ini), paths.prepare(given.run_dir)), stopping.is_set)
    except PmuError as error:
        failure = str(error)
    if failure:
        sys.stderr.write(f"aides: {failure}\n")
    return 1 if failure else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
