"""pyc37 (PyPI 1.0.2) as a PMU and as a PDC over TCP on loopback: detached processes with hard time limits.

Each peer runs in a process group of its own, ends itself when its time is up, and is ended by its id::

    with start_pyc37_pmu(port, stream.config(), stream.data) as pmu:
        ...  # a client connects to 127.0.0.1:port
    frames = run_pyc37_pdc("127.0.0.1", port, idcode, frames=10)
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any

from support.frames import Described, random_stream
from support.requires import requires_module
from support.wire import Stamp

PYC37_LIMITS = """
What pyc37 and pypmu (the same codec) cannot do, as read in their source and seen when run:
- PMU: TCP only; answers CFG-1 with an AA31 frame (the runner here gives it a true CFG-1); ignores CFG-3, and commands
  that arrive together; looks for commands for 100 ms before each data frame, so at most 8 frames/s leave it; puts the
  present time, in microseconds, on every frame unless told not to.
- PDC: one recv is one frame, so frames that arrive together are thrown away; reads an ended connection for ever;
  connects silently to nothing; knows no CFG-3 and keeps only a CFG-2.
- Decoding: FREQ as a float must be within +-32.767 and is taken for a deviation in mHz; integer polar angles are
  multiplied by PHUNIT; DFREQ is left raw; header text comes as the repr of bytes; STAT with PMU_TQ, unlocked time or a
  trigger reason above 7 is refused, bit 14 is lost and bit 13 inverted (the runners put it right); FRACSEC loses its
  highest bit; MSG_TQ 12 to 14, SOC 0 on encoding, ANUNIT types above 2, DIGUNIT with a normal-state mask, the integer
  fillers -32768, FORMAT bits above 3 and names outside ASCII are refused or changed.
"""
_RUNNERS = Path(__file__).resolve().parents[1] / "peers"
_START_S = 10.0


@dataclass
class Process:
    """A running peer. Leaving the context ends it and everything it started."""

    popen: subprocess.Popen[str]

    def stop(self) -> None:
        self.popen.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.popen.wait(timeout=3)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.popen.pid, signal.SIGKILL)
        self.popen.wait(timeout=5)
        if self.popen.stdout is not None:
            self.popen.stdout.close()

    def __enter__(self) -> Process:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.stop()


def free_port() -> int:
    """A TCP port of loopback that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def start_pyc37_pmu(
    port: int,
    config: bytes,
    data: Sequence[bytes],
    *,
    header: str = "pyc37",
    stamp_now: bool = False,
    age_s: float | None = None,
    limit_s: float = 30,
) -> Process:
    """pyc37 serving the stream of a CFG-2 frame on ``127.0.0.1:port``; returns when it listens.

    Every client gets the data frames once, decoded and encoded again by pyc37, after its start command and at about
    8 frames/s; with ``stamp_now`` stamped with the time they leave. With ``age_s`` a frame leaves when it is so old by
    its stamp, at any rate, and a client gets those that become so while it is there. The process ends ``limit_s``
    seconds after its start.
    """
    job = {"port": port, "config": config.hex(), "data": [frame.hex() for frame in data], "header": header}
    process = Process(_start("pyc37_pmu.py", job | {"stamp_now": stamp_now, "age_s": age_s, "limit_s": limit_s}))
    assert process.popen.stdout is not None
    readable, _, _ = select.select([process.popen.stdout], [], [], _START_S)
    if not readable or process.popen.stdout.readline() != "ready\n":
        process.stop()
        raise RuntimeError(f"pyc37 PMU did not start on port {port}")
    return process


def run_pyc37_pdc(
    host: str,
    port: int,
    idcode: int,
    frames: int,
    timeout_s: float = 15,
    *,
    ask: Sequence[str] = ("header", "cfg2"),
) -> list[dict[str, Any]]:
    """What pyc37 receives as a PDC, one dict a message: the answers to ``ask``, then ``frames`` data frames.

    Types are ``header cfg1 cfg2 data undecoded error``. Stations of a data frame have ``idcode stat phasors``
    (magnitude in V or A, angle in rad) ``frequency`` (Hz) ``freq dfreq`` (as sent) ``analogs digitals``. Raises
    TimeoutExpired if all this takes more than ``timeout_s``.
    """
    job = {"host": host, "port": port, "idcode": idcode, "frames": frames, "ask": list(ask)}
    popen = _start("pyc37_pdc.py", job | {"timeout_s": timeout_s, "limit_s": timeout_s + 5})
    with Process(popen):
        out, _ = popen.communicate(timeout=timeout_s)
    return [json.loads(line) for line in out.splitlines()]


def pyc37_stream(rng: random.Random, *, stations: int = 1, frames: int = 10) -> Described:
    """A random stream of which pyc37 can carry every value: see :data:`PYC37_LIMITS`."""
    formats = [rng.choice((0, 2, 3, 4, 6, 7)) for _ in range(stations)]
    stream = random_stream(rng, formats=formats, frames=frames, absent=0, time_base=1_000_000, data_rate=30)
    spec = replace(
        stream.spec,
        stations=tuple(
            replace(
                station,
                analogs=tuple(replace(analog, anunit=analog.anunit & 0x01FF_FFFF) for analog in station.analogs),
                words=tuple(replace(word, normal=0) for word in station.words),
            )
            for station in stream.spec.stations
        ),
    )
    return replace(
        stream,
        spec=spec,
        stamp=_plain(stream.stamp),
        stamps=tuple(map(_plain, stream.stamps)),
        blocks=tuple(tuple(block._replace(stat=block.stat & 0x3E07) for block in frame) for frame in stream.blocks),
    )


def _plain(stamp: Stamp) -> Stamp:
    return Stamp(stamp.soc or 1, stamp.time_quality & 0x7B, stamp.fracsec)


def _start(runner: str, job: dict[str, Any]) -> subprocess.Popen[str]:
    requires_module("pyc37")
    command = [sys.executable, str(_RUNNERS / runner), json.dumps(job)]
    return subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
