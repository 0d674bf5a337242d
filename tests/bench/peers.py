"""The same work done by others: pypmu, pyc37 and tshark. Each function takes frames and gives values to compare."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path
from types import ModuleType

from bench.frames import Layout
from support.pypmu_shim import pypmu_frame
from support.requires import requires_module

from pmutools.c37118.config import encode_config

TSHARK_FIELDS = (
    "synphasor.soc",
    "synphasor.fracsec_raw",
    "synphasor.data.status",
    "synphasor.phasor",
    "synphasor.actual_frequency_value",
    "synphasor.rate_change_frequency",
    "synphasor.analog_value",
)


def peer_modules() -> dict[str, ModuleType]:
    """The frame modules of the Python peers, by name."""
    return {"pypmu": pypmu_frame(), "pyc37": requires_module("pyc37.frame")}


def decoder(module: ModuleType, layout: Layout) -> object:
    """``decode(frame)`` of a peer: a frame object under the layout's configuration."""
    config = module.ConfigFrame2.convert2frame(encode_config(layout.config))
    return lambda frame: module.CommonFrame.convert2frame(frame, config)


def children_cpu_s() -> float:
    """Processor time of all processes that this one has waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def tshark_fields(path: Path) -> tuple[float, bytes]:
    """Dissect a capture into fields; processor seconds and what was printed."""
    before = children_cpu_s()
    fields = [word for field in TSHARK_FIELDS for word in ("-e", field)]
    out = subprocess.run(["tshark", "-n", "-r", str(path), "-T", "fields", *fields], capture_output=True, check=True)
    return children_cpu_s() - before, out.stdout


def python_cpu_s(*arguments: str) -> float:
    """Processor seconds of a Python process."""
    before = children_cpu_s()
    subprocess.run([sys.executable, *arguments], check=True, capture_output=True)
    return children_cpu_s() - before
