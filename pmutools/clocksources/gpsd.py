"""gpsd: JSON reports, one a line, over TCP. They say how good the receiver's time is, and how it compares with ours."""

from __future__ import annotations

import json
import math
import select
import socket
from contextlib import suppress
from typing import Any, NamedTuple

from pmutools.clocksources.asking import SLICE_S, NoAnswer, Patience
from pmutools.measure.clocks import PULSE_NS, GpsClock
from pmutools.net.endpoint import join_host
from pmutools.timebase import NS

WATCH = b'?WATCH={"enable":true,"json":true,"pps":true};\r\n'
PATIENCE_S = 3.0
"""Receivers report once a second; one that was asleep takes longer, and is awake the next time."""
CONNECT_S = 0.5
LINE_BYTES = 1 << 16
"""Longest report (gpsd's own limit is about 10 KiB)."""
DEVICES = 16
"""Receivers that are told apart."""
ENOUGH = 2
"""So many position reports without a pulse between them: there is no pulse."""


class Gpsd(NamedTuple):
    """Where gpsd is."""

    host: str = "127.0.0.1"
    port: int = 2947

    def __str__(self) -> str:
        return join_host(self.host, self.port)


GPSD = Gpsd()


class GpsReports:
    """Takes what gpsd sends, in pieces of any size; keeps the last of each kind of report and a piece of a line."""

    def __init__(self) -> None:
        self.release = ""
        self.devices: int | None = None
        self.positions = 0
        """Reports with a fix."""
        self.unreadable = 0
        """Lines that are no report."""
        self._has_spoken = False
        self._rest = b""
        self._fixes: dict[str, tuple[int, float | None]] = {}
        """Mode and time uncertainty of each receiver."""
        self._offsets: dict[str, int] = {}
        self._precision_ns = PULSE_NS
        self._satellites: int | None = None

    @property
    def complete(self) -> bool:
        """Whether more reports would tell nothing new."""
        return "PPS" in self._offsets or self.positions >= ENOUGH

    def feed(self, data: bytes) -> None:
        """Take bytes; a line that is too long to be a report is passed over."""
        self._has_spoken = True
        *lines, rest = (self._rest + data).split(b"\n")
        for line in lines:
            if line.strip():
                self._take(line)
        if len(rest) > LINE_BYTES:
            rest, self.unreadable = b"", self.unreadable + 1
        self._rest = rest

    def clock(self) -> GpsClock:
        """What was reported so far. Raises NoAnswer where that is nothing about time."""
        if not self.release and not self.positions:
            raise NoAnswer("what answers there is not gpsd" if self._has_spoken else "gpsd says nothing; does it hang?")
        if self.devices == 0:
            raise NoAnswer("gpsd has no receiver")
        mode, time_error_s = max(self._fixes.values(), key=lambda fix: fix[0], default=(0, None))
        pps = self._offsets.get("PPS")
        return GpsClock(
            mode=mode,
            time_error_s=time_error_s,
            pps=pps is not None,
            clock_offset_ns=pps,
            precision_ns=self._precision_ns,
            serial_offset_ns=self._offsets.get("TOFF"),
            satellites=self._satellites,
        )

    def _take(self, line: bytes) -> None:
        try:
            report = json.loads(line)
            kind = report["class"]
            match kind:
                case "VERSION":
                    self.release = str(report.get("release", "?"))
                case "DEVICES":
                    self.devices = len(report.get("devices", ()))
                case "TPV":
                    self._position(report)
                case "PPS":
                    self._offsets[kind] = _offset_ns(report)
                    self._precision_ns = max(1, round(NS * 2.0 ** int(report.get("precision", -20))))
                case "TOFF":
                    self._offsets[kind] = _offset_ns(report)
                case "SKY" if "satellites" in report or "uSat" in report:
                    self._satellites = _used(report)
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
            self.unreadable += 1

    def _position(self, report: dict[str, Any]) -> None:
        mode, error_s, device = int(report.get("mode", 0)), report.get("ept"), str(report.get("device", ""))
        self.positions += mode >= 2
        if device in self._fixes or len(self._fixes) < DEVICES:
            self._fixes[device] = mode, None if error_s is None or not math.isfinite(error_s) else float(error_s)


def _offset_ns(report: dict[str, Any]) -> int:
    """System clock less true time. Versions before 3.10 give microseconds."""

    def time_ns(who: str) -> int:
        fraction = report.get(f"{who}_nsec")
        return int(report[f"{who}_sec"]) * NS + int(report[f"{who}_musec"] * 1000 if fraction is None else fraction)

    return time_ns("clock") - time_ns("real")


def _used(report: dict[str, Any]) -> int:
    """Satellites that the fix is made of. Versions before 3.22 have no sum."""
    if "uSat" in report:
        return int(report["uSat"])
    return sum(bool(satellite.get("used")) for satellite in report["satellites"])


def ask_gpsd(gpsd: Gpsd, patience: Patience) -> GpsClock:
    """Connect, listen for a second or two, leave. Raises NoAnswer.

    gpsd keeps a receiver awake for a minute after its last listener, so who asks more often has it awake.
    """
    patience = patience.at_most(PATIENCE_S)
    try:
        connection = socket.create_connection(gpsd, max(0.01, min(CONNECT_S, patience.left_s)))
    except OSError as error:
        reason = "nobody listens" if isinstance(error, ConnectionRefusedError) else error.strerror or str(error)
        raise NoAnswer(f"no gpsd at {gpsd.host}:{gpsd.port}: {reason}") from None
    reports = GpsReports()
    with connection, suppress(OSError):  # what was said until then counts
        connection.sendall(WATCH)
        while not reports.complete and reports.devices != 0 and (left_s := patience.left_s) > 0:
            if select.select([connection], [], [], min(left_s, SLICE_S))[0]:
                if not (data := connection.recv(LINE_BYTES)):
                    break
                reports.feed(data)
    return reports.clock()
