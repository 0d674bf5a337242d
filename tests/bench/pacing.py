"""How far from its schedule the player sends, beside tcpreplay on the same capture; and whether its memory is flat.

A third program looks on: tcpdump stamps what passes on loopback, so both are judged by the same kernel clock. The most
punctual frame of a run defines zero, for both alike. The destination is a socket that nobody reads, as a receiver on
another machine would cost the sender nothing either.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from bench.host import rss_kib, steal_s
from bench.layouts import RATE, A
from bench.table import Budget, Row

from pmutools.c37118 import encode_config
from pmutools.c37118.frames import restamp
from pmutools.flow import Chunk, Flow
from pmutools.formats import open_source
from pmutools.formats.capture import CaptureWriter
from pmutools.formats.source import Block
from pmutools.timebase import NS, from_ns, slot_time_ns

PORT = 54_713
FIRST_NS = 1_704_067_200 * NS
LATENCY_NS = 40_000_000
STEAL_S = 0.05
"""A round in which the host took more processor time than this is run again."""
I64 = npt.NDArray[np.int64]
_PLAY = (sys.executable, "-c", "from pmutools.cli import main; main()", "play")


@dataclass(frozen=True)
class Sizes:
    pmus: int
    seconds: int
    rounds: int


FULL = Sizes(pmus=2000, seconds=4, rounds=3)
QUICK = Sizes(pmus=20, seconds=1, rounds=1)


class Errors(NamedTuple):
    """Distances from the schedule in µs; ``drift`` is the median of the last tenth less that of the first."""

    frames: int
    missing: int
    p50: float
    p99: float
    drift: float


def rows(sizes: Sizes) -> Iterator[Row]:
    """The table's rows; none where the programs beside are not there."""
    if not all(map(shutil.which, ("tcpreplay", "tcpdump"))) or os.geteuid():
        return
    with tempfile.TemporaryDirectory() as folder:
        source = write(Path(folder) / "source.pcap", sizes)
        seen, ours, theirs = Path(folder) / "seen.pcap", list[Errors](), list[Errors]()
        for _ in range(2 * sizes.rounds):
            before_s = steal_s()
            ours.append(errors(source, _watched(seen, _player(source)), sizes))
            if steal_s() - before_s > STEAL_S and len(ours) < sizes.rounds:
                ours.pop()  # the host took the processor away: that is no player's error
                continue
            theirs.append(errors(source, _watched(seen, _tcpreplay(source)), sizes))
            if len(theirs) == sizes.rounds:
                break
    what = f"{sizes.pmus:,} PMUs x {RATE}/s from one process"
    middle, peer = _middle(ours), _middle(theirs)
    mine, other = _told(middle), f"tcpreplay: {_told(peer)}"
    closer = statistics.median(b.p99 / a.p99 for a, b in zip(ours, theirs, strict=False))
    drifts = f"{middle.drift:.0f} us", f"tcpreplay: {peer.drift:.0f} us"
    yield Row("player", f"{what}: late, p50", mine, other, middle.p50, " us", Budget("at most", 20))
    yield Row("player", f"{what}: late, p99", mine, other, middle.p99, " us", Budget("at most", 1000))
    yield Row("player", f"{what}: closer to schedule", mine, other, closer, "x", Budget("at least", 100))
    yield Row(
        "player", f"{what}: drift in {sizes.seconds} s", *drifts, abs(middle.drift), " us", Budget("at most", 100)
    )


def write(path: Path, sizes: Sizes) -> Path:
    """A capture of PMUs whose phases are spread evenly over the reporting interval, each a flow of its own."""
    frame = A.frames(1).singles[0]
    flows = [Flow("udp", f"127.0.0.1:{10_000 + pmu}", f"127.0.0.1:{PORT}") for pmu in range(sizes.pmus)]
    with CaptureWriter(path) as writer:
        for pmu, flow in enumerate(flows):
            config = replace(A.config, idcode=pmu + 1)
            writer.write(Chunk(encode_config(config, soc=FIRST_NS // NS), FIRST_NS, flow))
        for slot in range(sizes.seconds * RATE):
            stamp_ns = slot_time_ns(slot, A.config.rate) + FIRST_NS
            soc, fracsec = from_ns(stamp_ns, A.config.time_base)
            for pmu, flow in enumerate(flows):
                arrival_ns = stamp_ns + LATENCY_NS + pmu * NS // RATE // sizes.pmus
                writer.write(Chunk(restamp(frame, soc, fracsec, idcode=pmu + 1), arrival_ns, flow))
    return path


def _player(source: Path) -> list[str]:
    return [*_PLAY, str(source), "--to", f"udp://127.0.0.1:{PORT}", "--cfg-period", "0", "--quiet"]


def _tcpreplay(source: Path) -> list[str]:
    return ["tcpreplay", "-q", "-i", "lo", str(source)]


def _watched(seen: Path, command: Sequence[str]) -> Path:
    """What passes while a command runs."""
    with sink(), watching(seen):
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, timeout=120)
    return seen


@contextmanager
def sink() -> Iterator[None]:
    """A port that is open, so that nothing is sent back, and that nobody reads."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        sock.bind(("127.0.0.1", PORT))
        yield


@contextmanager
def watching(seen: Path) -> Iterator[None]:
    """tcpdump on loopback, from when it is ready to when all has passed."""
    command = ["tcpdump", "-i", "lo", "-w", str(seen), "--time-stamp-precision=nano", "-B", "131072", "-Z", "root"]
    with subprocess.Popen([*command, f"udp and dst port {PORT}"], stderr=subprocess.PIPE) as process:
        assert process.stderr is not None
        process.stderr.readline()  # "listening on lo"
        yield
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)


def errors(source: Path, seen: Path, sizes: Sizes) -> Errors:
    """How far from the source's schedule the frames of a run passed."""
    due, came = _times(source, sizes), _times(seen, sizes)
    known = (due > 0) & (came > 0)
    late = (came[known] - due[known]).astype(np.float64)
    order = np.argsort(due[known], kind="stable")
    late = (late[order] - late.min()) / 1000
    tenth = max(1, len(late) // 10)
    p50, p99 = np.percentile(late, (50, 99))
    drift = float(np.median(late[-tenth:]) - np.median(late[:tenth]))
    return Errors(len(late), int((due > 0).sum()) - len(late), float(p50), float(p99), drift)


def _times(path: Path, sizes: Sizes) -> I64:
    """Arrival (ns) of each frame, by PMU and slot; 0 for those that are not there."""
    times = np.zeros((sizes.pmus, sizes.seconds * RATE), np.int64)
    blocks = [item for item in open_source(path).blocks() if isinstance(item, Block)]
    first_ns = min(int(block.batch.time_ns.min()) for block in blocks)
    for block in blocks:
        slots = (block.batch.time_ns - first_ns + NS // RATE // 2) * RATE // NS
        times[block.batch.config.idcode - 1, slots] = block.batch.arrival_ns
    return times


def _middle(runs: Sequence[Errors]) -> Errors:
    return sorted(runs, key=lambda run: run.p99)[len(runs) // 2]


def _told(run: Errors) -> str:
    return f"p50 {run.p50:.0f} us, p99 {run.p99:.0f} us"


# --- long runs ------------------------------------------------------------------------------------------------------


def soak(seconds: int, pmus: int = 2000) -> int:
    """``make soak``: so many PMUs for so long; memory, pace and completeness as it goes. 1 if one is not right."""
    capture = Path(__file__).resolve().parents[2] / "captures" / "cjb-8pmu.pcap"
    command = [*_PLAY, str(capture)]
    options = ["--to", f"udp://127.0.0.1:{PORT}", "--emulate", str(pmus), "--loop", "0", "--duration", str(seconds)]
    steal, began = steal_s(), time.monotonic()
    memory: list[int] = []
    with sink(), subprocess.Popen([*command, *options, "--quiet", "--json"], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        while process.poll() is None and time.monotonic() - began < seconds + 60:
            time.sleep(min(10.0, max(1.0, seconds / 20)))
            memory.append(rss_kib(process.pid))
            print(f"{time.monotonic() - began:6.0f} s  {memory[-1] / 1024:7.1f} MiB", flush=True)
            if memory[-1] == 0 or time.monotonic() - began > seconds:
                break
        streams = json.loads(process.stdout.read())["streams"]
    sent = sum(stream["fates"].get("sent", 0) for stream in streams)
    late = [stream["late_us"] for stream in streams]
    p50, p99 = (statistics.median(stream[name] for stream in late) for name in ("p50", "p99"))
    steady = [kib for kib in memory[len(memory) // 4 :] if kib]
    growth = (steady[-1] - steady[0]) / 1024 if len(steady) > 1 else 0.0
    most, stolen_s = max(stream["max"] for stream in late), steal_s() - steal
    print(f"{sent} frames of {pmus} PMUs in {seconds} s; late p50 {p50:.0f} us, p99 {p99:.0f} us, max {most:.0f} us")
    print(f"memory grew by {growth:.1f} MiB; the host took {stolen_s:.2f} s of processor time")
    due = pmus * RATE * (seconds - 1.2)
    return int(not (sent >= due and growth < 4 and p50 <= 20 and p99 <= 1000))


if __name__ == "__main__":
    sys.exit(soak(int(sys.argv[1]) if len(sys.argv) > 1 else 600))
