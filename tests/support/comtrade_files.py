"""COMTRADE records written from numbers, with nothing of pmutools; also the sample in ``captures``::

python tests/support/comtrade_files.py captures/fault-waveform.cfg
"""

from __future__ import annotations

import math
import struct
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

Course = Callable[[float], float]


@dataclass(frozen=True)
class Analog:
    """A channel: what it is at each time (seconds from the start), and what the header says of it."""

    name: str
    course: Course
    unit: str = "V"
    phase: str = ""
    component: str = ""
    step: float = 0.01
    skew_us: float = 0.0
    ratio: tuple[float, float, str] = (1.0, 1.0, "P")


@dataclass(frozen=True)
class Status:
    name: str
    course: Callable[[float], bool]
    normal: int = 0


@dataclass(frozen=True)
class Recording:
    """What goes into the files; ``rates`` are (samples/s, last sample number)."""

    analogs: Sequence[Analog]
    statuses: Sequence[Status] = ()
    rates: Sequence[tuple[float, int]] = ((1000, 1000),)
    station: str = "NORTH"
    line_hz: float = 50.0
    start: str = "17/06/2016,13:00:00.000000"
    form: str = "ASCII"
    year: str = "1999"
    stamped: bool = False
    """Times from the data's stamps (µs), no rate in the header."""
    codes: tuple[str, str] | None = None
    times: list[float] = field(init=False)

    def __post_init__(self) -> None:
        times, number, at = [0.0], 1, 0.0
        for rate, last in self.rates:
            while number < last:
                at += 1 / rate
                times.append(at)
                number += 1
        object.__setattr__(self, "times", times)

    def header(self) -> str:
        lines = [f"{self.station},RECORDER,{self.year}" if self.year != "1991" else f"{self.station},RECORDER"]
        lines.append(f"{len(self.analogs) + len(self.statuses)},{len(self.analogs)}A,{len(self.statuses)}D")
        for number, a in enumerate(self.analogs, 1):
            step = 1.0 if self.form == "FLOAT32" else a.step
            primary, secondary, which = a.ratio
            limits = f"-32767,32767,{primary:g},{secondary:g},{which}"
            lines.append(f"{number},{a.name},{a.phase},{a.component},{a.unit},{step!r},0,{a.skew_us:g},{limits}")
        lines += [f"{number},{s.name},,,{s.normal}" for number, s in enumerate(self.statuses, 1)]
        lines.append(f"{self.line_hz:g}")
        rates = ((0, len(self.times)),) if self.stamped else self.rates
        lines += [str(0 if self.stamped else len(rates)), *(f"{rate:g},{last}" for rate, last in rates)]
        lines += [self.start, self.start, self.form]
        if self.year != "1991":
            lines.append("1")
        lines += self.codes or ()
        return "\r\n".join(lines) + "\r\n"

    def samples(self) -> bytes:
        out = bytearray()
        for number, at in enumerate(self.times, 1):
            stamp = round(at * 1e6)
            # a channel that lags is sampled later than the row says
            raw = [a.course(at + a.skew_us * 1e-6) / (1.0 if self.form == "FLOAT32" else a.step) for a in self.analogs]
            bits = [int(s.course(at)) for s in self.statuses]
            if self.form == "ASCII":
                cells = [number, stamp, *(99999 if math.isnan(v) else round(v) for v in raw), *bits]
                out += (",".join(map(str, cells)) + "\r\n").encode()
                continue
            out += struct.pack("<II", number, stamp)
            code, filler = {"BINARY": ("h", -32768), "BINARY32": ("i", -(1 << 31)), "FLOAT32": ("f", 0)}[self.form]
            values = raw if code == "f" else [filler if math.isnan(v) else round(v) for v in raw]
            out += struct.pack(f"<{len(values)}{code}", *values)
            for first in range(0, len(bits), 16):
                out += struct.pack("<H", sum(bit << k for k, bit in enumerate(bits[first : first + 16])))
        return bytes(out)

    def write(self, path: Path) -> Path:
        """The files: ``path`` is the .cfg, its .dat goes beside it; or a .cff."""
        if path.suffix.lower() == ".cff":
            size = f": {len(self.samples())}" if self.form != "ASCII" else ""
            head = (
                f"--- file type: CFG ---\r\n{self.header()}--- file type: INF ---\r\n--- file type: HDR ---\r\nnote\r\n"
            )
            path.write_bytes(f"{head}--- file type: DAT {self.form}{size} ---\r\n".encode() + self.samples())
            return path
        path.write_bytes(self.header().encode())
        path.with_suffix(".DAT" if path.suffix.isupper() else ".dat").write_bytes(self.samples())
        return path


def wave(rms: float, degrees: float, hz: float = 50.0, offset: float = 0.0) -> Course:
    """A cosine of this RMS value; its angle holds at time ``offset``."""
    peak, angle = rms * math.sqrt(2), math.radians(degrees)
    return lambda at: peak * math.cos(2 * math.pi * hz * (at - offset) + angle)


def three_phases(
    rms: float, degrees: float, hz: float = 50.0, *, letter: str = "V", unit: str = "V", step: float = 0.01
) -> list[Analog]:
    return [
        Analog(f"{letter}{phase}", wave(rms, degrees + turn, hz), unit, phase, "LINE", step)
        for phase, turn in (("A", 0), ("B", -120), ("C", 120))
    ]


def sample() -> Recording:
    """A fault on phase A at 0.2 s, cleared at 0.28 s, seen by a recorder with 16 samples a cycle, for 0.5 s."""

    def faulted(at: float) -> bool:
        return 0.2 <= at < 0.28

    def during(before: Course, fault: Course) -> Course:
        return lambda at: (fault if faulted(at) else before)(at)

    kv = [
        Analog("VA", during(wave(63.5, 0), wave(20, -5)), "kV", "A", "LINE 1", 0.005),
        *(Analog(f"V{p}", wave(63.5, turn), "kV", p, "LINE 1", 0.005) for p, turn in (("B", -120), ("C", 120))),
    ]
    amps = [
        Analog("IA", during(wave(1, -30), wave(12, -80)), "A", "A", "LINE 1", 0.001, 0.0, (600, 1, "S")),
        *(
            Analog(f"I{p}", wave(1, turn - 30), "A", p, "LINE 1", 0.001, 0.0, (600, 1, "S"))
            for p, turn in (("B", -120), ("C", 120))
        ),
    ]
    trip = Status("TRIP", lambda at: 0.24 <= at < 0.34)
    breaker = Status("BREAKER CLOSED", lambda at: at < 0.28, normal=1)
    return Recording([*kv, *amps], [trip, breaker], ((800, 400),), "NORTH", 50.0, form="BINARY")


if __name__ == "__main__":
    sample().write(Path(sys.argv[1]))
