"""A capture file to decoded columns, beside ``tshark -T fields``."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench.layouts import FIRST_NS, RATE, B, C, Frames, Layout
from bench.stopwatch import measure
from bench.table import Row, faster

from pmutools.c37118 import encode_config
from pmutools.c37118.batch import Batch
from pmutools.flow import Chunk, Flow
from pmutools.formats import open_source
from pmutools.formats.capture import CaptureWriter
from pmutools.formats.source import Block
from pmutools.timebase import NS

FIELDS = (
    "frame.time_epoch",
    "synphasor.idcode_stream_source",
    "synphasor.soc",
    "synphasor.fracsec_raw",
    "synphasor.data.status",
    "synphasor.phasor",
    "synphasor.actual_frequency_value",
    "synphasor.frequency_deviation_from_nominal",
    "synphasor.rate_change_frequency",
    "synphasor.analog_value",
    "synphasor.digital_status_word",
)
"""Of phasors and analogs tshark gives the names only; their values are in no field of their own."""
_FLOW = Flow("udp", "192.0.2.1:4713", "192.0.2.2:54713")


@dataclass(frozen=True)
class Sizes:
    frames: int
    rounds: int


FULL = Sizes(frames=40_000, rounds=5)
QUICK = Sizes(frames=400, rounds=1)


def write(path: Path, frames: Frames) -> Path:
    """A .pcap of the layout's configuration and data frames, a UDP datagram each."""
    with CaptureWriter(path) as writer:
        writer.write(Chunk(encode_config(frames.layout.config), FIRST_NS, _FLOW))
        for number, frame in enumerate(frames.singles, start=1):
            writer.write(Chunk(frame, FIRST_NS + number * NS // RATE, _FLOW))
    return path


def decoded(path: Path) -> list[Batch]:
    return [item.batch for item in open_source(path).blocks() if isinstance(item, Block)]


def command(path: Path) -> list[str]:
    """tshark's command line."""
    return ["tshark", "-n", "-r", str(path), "-T", "fields", *(word for field in FIELDS for word in ("-e", field))]


def check(path: Path) -> None:
    """Hold columns to what tshark prints, where it prints a value; raises AssertionError."""
    printed = subprocess.run(command(path), capture_output=True, text=True, timeout=60, check=True).stdout
    lines = [line.split("\t") for line in printed.splitlines()][1:]  # the first is the configuration frame
    batches = decoded(path)
    assert sum(map(len, batches)) == len(lines)
    batch = batches[0]
    config = batch.config
    for row, line in enumerate(lines[: len(batch)]):
        cells = dict(zip(FIELDS, line, strict=True))
        arrival_s, fraction = cells["frame.time_epoch"].split(".")
        assert int(arrival_s) * NS + int(fraction) == batch.arrival_ns[row]
        assert int(cells["synphasor.idcode_stream_source"]) == config.idcode
        fracsec = int(cells["synphasor.fracsec_raw"])
        assert (fracsec * NS + config.time_base // 2) // config.time_base == batch.time_ns[row] % NS
        if frequency := cells["synphasor.actual_frequency_value"]:
            np.testing.assert_allclose(batch.frequency[row], [float(cell) for cell in frequency.split(",")], rtol=1e-5)
        if deviation := cells["synphasor.frequency_deviation_from_nominal"]:
            np.testing.assert_allclose(
                batch.frequency[row], [60 + int(cell) / 1000 for cell in deviation.split(",")], rtol=1e-12
            )
        if words := cells["synphasor.digital_status_word"]:
            assert batch.digitals[row].tolist() == [int(word, 16) for word in words.split(",")]


def rows(sizes: Sizes) -> Iterator[Row]:
    """The table's rows; none where tshark is not installed."""
    if shutil.which("tshark") is None:
        return
    with tempfile.TemporaryDirectory() as folder:
        for layout in (B, C):
            yield _compared(layout, sizes, Path(folder))


def _compared(layout: Layout, sizes: Sizes, folder: Path) -> Row:
    check(write(folder / "check.pcap", layout.frames(100)))
    path = write(folder / "bench.pcap", layout.frames(sizes.frames))

    def ours() -> int:
        return sum(map(len, decoded(path)))

    def tshark() -> int:
        subprocess.run(command(path), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, timeout=120, check=True)
        return sizes.frames

    rate = measure({"ours": ours, "tshark": tshark}, sizes.rounds)
    what = f"{layout.name}: .pcap of UDP datagrams to columns"
    return faster("capture", what, rate["ours"], "tshark -T fields", rate["tshark"], 25)
