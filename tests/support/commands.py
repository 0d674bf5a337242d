"""The commands as a user runs them: in this process for speed, or as processes of their own."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from pmutools.cli import pmu as pmu_group
from pmutools.cli.shell import run

LIMIT_S = 60


class Result(NamedTuple):
    """How a command ended, and what it wrote."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """Standard output, which must be one JSON document."""
        return json.loads(self.out)

    @property
    def lines(self) -> list[Any]:
        """Standard output, one JSON document a line."""
        return [json.loads(line) for line in self.out.splitlines()]

    @property
    def complaint(self) -> str:
        """Standard error, which must be one line."""
        assert self.err.endswith("\n")
        assert self.err.count("\n") == 1, self.err
        return self.err[:-1]


class Pmu:
    """``pmu`` in this process."""

    def __init__(self, capture: pytest.CaptureFixture[str]) -> None:
        self._capture = capture

    def __call__(self, *arguments: object) -> Result:
        self._capture.readouterr()
        terminated, interrupted = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
        try:
            code = run(pmu_group(), [str(argument) for argument in arguments])
        finally:
            signal.signal(signal.SIGTERM, terminated)
            signal.signal(signal.SIGINT, interrupted)
        out, err = self._capture.readouterr()
        return Result(code, out, err)


def run_here(*arguments: object) -> Result:
    """``pmu`` in this process, without a fixture: for many runs in one test. Standard output is text only."""
    out, err = io.StringIO(), io.StringIO()
    handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        with redirect_stdout(out), redirect_stderr(err):
            code = run(pmu_group(), [str(argument) for argument in arguments])
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return Result(code, out.getvalue(), err.getvalue())


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "pmutools.cli", *map(str, arguments)]


def run_pmu(*arguments: object, **options: Any) -> Result:
    """``pmu`` in a process of its own, ended after a minute."""
    environment = os.environ | {"PYTHONUNBUFFERED": ""} | options.pop("env", {})
    done = subprocess.run(
        command(*arguments), capture_output=True, text=True, timeout=LIMIT_S, env=environment, check=False, **options
    )
    return Result(done.returncode, done.stdout, done.stderr)


@contextmanager
def started(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    """``pmu`` running; ended, by its id, when left."""
    popen = subprocess.Popen(command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        yield popen
    finally:
        if popen.poll() is None:
            popen.kill()
        popen.communicate(timeout=LIMIT_S)


def ended(popen: subprocess.Popen[str]) -> Result:
    """Wait for the end of a running command."""
    out, err = popen.communicate(timeout=LIMIT_S)
    return Result(popen.returncode, out, err)


def wait_for_udp(port: int, popen: subprocess.Popen[str]) -> float:
    """Seconds until a process has bound a UDP port of this machine."""
    return _wait_for("udp", port, popen)


def wait_for_tcp(port: int, popen: subprocess.Popen[str]) -> float:
    """Seconds until a process listens on a TCP port of this machine."""
    return _wait_for("tcp", port, popen)


def _wait_for(protocol: str, port: int, popen: subprocess.Popen[str]) -> float:
    began = time.monotonic()
    table, wanted = Path(f"/proc/net/{protocol}"), f":{port:04X}"
    if not table.exists():
        pytest.skip("needs /proc/net to see when a port is bound")
    while time.monotonic() - began < LIMIT_S / 4 and popen.poll() is None:
        if any(line.split()[1].endswith(wanted) for line in table.read_text().splitlines()[1:]):
            return time.monotonic() - began
        time.sleep(0.002)
    pytest.fail(f"{protocol} port {port} was never bound; the process ended with {popen.poll()}")
