"""The output process: commands from the watchdog to a DAC or a Modbus device, and what they read back.

What is driven is decided by :class:`~dcon.output.outlet.Outlet`. Readbacks go to the watchdog and to the control
process; the loop ``output`` beats. Killed with SIGKILL, it leaves the output at its last value: the relays are what
opens then.
"""

from __future__ import annotations

import logging
import math
import select
import socket
from pathlib import Path

from dcon.drivers.driver import Driver
from dcon.drivers.iio import IioDriver
from dcon.drivers.modbus_output import ModbusDriver
from dcon.link import paths
from dcon.link.beats import LoopName, LoopState, Readback, encode_readback
from dcon.link.notify import ALIVE, READY, STOPPING, Notifier
from dcon.link.paths import Sender
from dcon.link.pulse import Pulse
from dcon.output.outlet import Drive, Outlet
from dcon.places import IioPlace, ModbusPlace
from dcon.sections import Output
from pmutools.clock import Clock, SystemClock
from pmutools.errors import SettingsError

LOG = logging.getLogger(__name__)
BEAT_NS = 20_000_000
ALIVE_NS = 1_000_000_000
"""So often systemd is told that the rounds go on."""
POLL_NS = 2_000_000
"""How often a readback is asked for that has not come yet."""
REMEMBERED = 256
"""Commands whose readback may still come."""
AT_ONCE = 64
"""Datagrams taken in one turn."""
DATAGRAM_BYTES = 64


def open_driver(output: Output) -> Driver:
    """The driver of ``[output]``. Raises SettingsError where that needs none, SourceError where it cannot be opened."""
    match output.url:
        case IioPlace() as place:
            return IioDriver(place)
        case ModbusPlace() as place:
            return ModbusDriver(place)
        case None:
            raise SettingsError("[output] has no url: there is nothing to drive")
    raise SettingsError(
        f"[output] {output.url}: the watchdog sends datagrams itself; iio:// and modbus:// are driven here"
    )


class OutputProcess:
    """One driver between ``output.in`` and the device."""

    def __init__(
        self,
        output: Output,
        run_dir: Path,
        *,
        driver: Driver | None = None,
        clock: Clock | None = None,
        notifier: Notifier | None = None,
    ) -> None:
        """Raises SourceError where another process has the place, or the device cannot be opened."""
        self._clock = clock or SystemClock()
        self._notifier = notifier or Notifier({})
        self._notified_ns: int | None = None
        self._inbox = paths.bind_datagram(run_dir, paths.OUTPUT)
        try:
            self.driver = driver or open_driver(output)
        except BaseException:
            paths.release(self._inbox)
            raise
        self._watchdog, self._control = Sender(run_dir / paths.WATCHDOG), Sender(run_dir / paths.CONTROL)
        self._pulse = Pulse(LoopName.OUTPUT, self._watchdog, BEAT_NS)
        self.outlet = Outlet(round(output.hold_ms * 1e6), self._clock.monotonic_ns())
        self.readbacks = 0
        """Those that were sent."""
        self.stopping = False
        self._asked: dict[int, int] = {}
        """Sequence of the command by number of the driver's call, while no readback has come."""
        self._poll_ns = 0
        self._trouble, self._troubled_ns = "", 0

    def stop(self) -> None:
        """Ask for the end of :meth:`run`, from a signal handler too."""
        self.stopping = True

    def run(self) -> None:
        """Until :meth:`stop`; leaves 0 V."""
        now_ns = self._clock.monotonic_ns()
        try:
            self._drive(Drive(0.0), now_ns)
            while not self.stopping:
                self._wait(now_ns)
                now_ns = self._clock.monotonic_ns()
                if (drive := self.outlet.turn(self._datagrams(), now_ns)) is not None:
                    self._drive(drive, now_ns)
                if self._asked and now_ns >= self._poll_ns:
                    self._read_back(now_ns)
                self._pulse.beat(now_ns, self._judge(now_ns))
                self._notify(now_ns)
        finally:
            self._notifier.tell(STOPPING)
            self._pulse.beat(self._clock.monotonic_ns(), LoopState.ENDING)
            self.driver.close()
            paths.release(self._inbox)
            self._watchdog.close()
            self._control.close()

    def _wait(self, now_ns: int) -> None:
        next_ns = min(self.outlet.due_ns, self._pulse.due_ns, self._poll_ns if self._asked else self._pulse.due_ns)
        select.select([self._inbox], [], [], max(0.0, (next_ns - now_ns) / 1e9))

    def _datagrams(self) -> list[bytes]:
        found: list[bytes] = []
        try:
            while len(found) < AT_ONCE:
                found.append(self._inbox.recv(DATAGRAM_BYTES, socket.MSG_DONTWAIT))
        except OSError:
            pass
        return found

    def _drive(self, drive: Drive, now_ns: int) -> None:
        driver = self.driver
        driver.drive(drive.time_ns, drive.output_v)
        if drive.sequence is not None and driver.reads_back:
            self._asked[driver.driven] = drive.sequence
            if len(self._asked) > REMEMBERED:
                del self._asked[next(iter(self._asked))]
            self._poll_ns = now_ns + driver.settle_ns

    def _read_back(self, now_ns: int) -> None:
        self._poll_ns = now_ns + POLL_NS
        found = self.driver.readback()
        if found is None or (sequence := self._asked.pop(found.number, None)) is None:
            return
        self._asked = {number: asked for number, asked in self._asked.items() if number > found.number}
        if math.isfinite(found.output_v):
            answer = encode_readback(Readback(sequence, self._clock.monotonic_ns(), found.output_v))
            self._watchdog.send(answer)
            self._control.send(answer)
            self.readbacks += 1

    def _notify(self, now_ns: int) -> None:
        """READY with the first round; then each second that rounds go on, and how the device is."""
        if self._notified_ns is not None and now_ns - self._notified_ns < ALIVE_NS:
            return
        first, self._notified_ns = self._notified_ns is None, now_ns
        status = self.driver.trouble or f"{self.outlet.commands} commands, {self.readbacks} read back"
        self._notifier.tell(*((READY,) if first else ()), ALIVE, status=status)

    def _judge(self, now_ns: int) -> LoopState:
        """FAILED while something has been wrong with the device for longer than the output may be held."""
        trouble = self.driver.trouble
        if bool(trouble) != bool(self._trouble):
            self._troubled_ns = now_ns
            LOG.warning("%s", trouble or "the output is driven again")
        self._trouble = trouble
        return LoopState.FAILED if trouble and now_ns - self._troubled_ns >= self.outlet.hold_ns else LoopState.RUNNING
