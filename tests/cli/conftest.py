"""Fixtures of the command tests."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.captures import udp_packet, write_pcap
from support.commands import Pmu, run_pmu


@pytest.fixture
def pmu(capfd: pytest.CaptureFixture[str]) -> Pmu:
    """``pmu("info", path)``: runs the command in this process."""
    return Pmu(capfd)


@pytest.fixture(scope="session")
def synthetic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of eight PMUs at 60 frames/s, as a pcap."""
    path = tmp_path_factory.mktemp("synthetic") / "eight.pcap"
    assert run_pmu("synth", path, "--duration", 2, "--quiet").code == 0
    return path


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    """A capture of something else."""
    return write_pcap(tmp_path / "dns.pcap", [udp_packet(b"\x12\x34\x01\x00\x00\x01" + bytes(40))] * 5)
