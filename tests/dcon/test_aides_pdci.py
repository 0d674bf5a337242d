"""The loop that hears of the line: datagrams, a device on Modbus, a flood, and whoever should not be heard."""

from __future__ import annotations

import itertools
import math
import socket
import time
from pathlib import Path

import pytest
from support.live import free_udp_port
from support.modbus_device import modbus_device, wait_for
from support.run_folder import in_thread, listening

from dcon.aides.line import PdciAide
from dcon.core.values import Pdci
from dcon.drivers.line_status import encode
from dcon.drivers.modbus import to_registers
from dcon.link.paths import CONTROL, WATCHDOG, prepare
from dcon.places import line_source
from pmutools.errors import SourceError

pytestmark = pytest.mark.realtime


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return prepare(tmp_path / "run")


def line(power_mw: float, **other: object) -> Pdci:
    return Pdci(time.time_ns(), power_mw)._replace(**other)


def test_a_status_is_passed_on_as_it_is(folder: Path) -> None:
    port = free_udp_port()
    with listening(folder, CONTROL) as (control,), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as plant:
        aide = PdciAide(line_source(f"udp://127.0.0.1:{port}"), folder)
        with in_thread(aide.run, aide.stop):
            sent = line(2000.5, in_service=True, dcon_enabled=False, scheduled_mw=1990.0)
            plant.sendto(encode(1, sent), ("127.0.0.1", port))
            wait_for(lambda: control.said("pdci"))
            assert control.said("pdci") == [{"kind": "pdci", **sent._asdict()}]
            plant.sendto(encode(2, line(-5.0)), ("127.0.0.1", port))
            wait_for(lambda: len(control.said("pdci")) == 2)
            assert control.said("pdci")[-1]["scheduled_mw"] is None
            for nonsense in (b"", b"DCP1", encode(3, line(math.nan)), encode(1, sent)):
                plant.sendto(nonsense, ("127.0.0.1", port))
            wait_for(lambda: sum(aide.inbox.refused.values()) == 4)
            assert len(control.said("pdci")) == 2


def test_only_the_configured_source_is_heard(folder: Path) -> None:
    port = free_udp_port()
    with listening(folder, CONTROL) as (control,), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        aide = PdciAide(line_source(f"udp://127.0.0.1:{port}?source=127.0.0.2"), folder)
        with in_thread(aide.run, aide.stop):
            stranger.sendto(encode(9, line(1.0)), ("127.0.0.1", port))
            wait_for(lambda: aide.foreign == 1)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as plant:
                plant.bind(("127.0.0.2", 0))
                plant.sendto(encode(1, line(2.0)), ("127.0.0.1", port))
            wait_for(lambda: control.said("pdci"))
            assert [news["power_mw"] for news in control.said("pdci")] == [2.0]


def test_a_flood_delays_no_beat_and_fills_no_queue(folder: Path) -> None:
    port = free_udp_port()
    with (
        listening(folder, WATCHDOG, CONTROL) as (watchdog, control),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as plant,
    ):
        aide = PdciAide(line_source(f"udp://127.0.0.1:{port}"), folder)
        with in_thread(aide.run, aide.stop):
            end = time.monotonic() + 1.0
            number = 0
            while time.monotonic() < end:
                for _ in range(100):
                    number += 1
                    plant.sendto(encode(number, line(float(number))), ("127.0.0.1", port))
                time.sleep(0.01)  # 10,000 a second
            number += 1
            last = number
            while not any(news["power_mw"] == last for news in control.said("pdci")):
                plant.sendto(encode(number, line(float(last))), ("127.0.0.1", port))
                number += 1
                assert time.monotonic() < end + 10
                time.sleep(0.02)
        beats = watchdog.beats("pdci")
        assert len(beats) >= 8 and len(control.said("pdci")) <= 60 + number - last
        gaps = sorted(later[0] - earlier[0] for earlier, later in itertools.pairwise(beats))
        assert gaps[len(gaps) // 2] < 200_000_000


def test_a_device_on_modbus_that_goes(folder: Path) -> None:
    with modbus_device() as device, listening(folder, WATCHDOG, CONTROL) as (watchdog, control):
        device.registers[0:2] = to_registers("float32", -2000.5)
        device.registers[4] = 3
        url = f"modbus://127.0.0.1:{device.port}?period_ms=20&timeout_ms=500"
        aide = PdciAide(line_source(url), folder)
        with in_thread(aide.run, aide.stop):
            wait_for(lambda: len(control.said("pdci")) > 2)
            news = control.said("pdci")[-1]
            assert (news["power_mw"], news["in_service"], news["dcon_enabled"]) == (-2000.5, True, True)
            assert news["scheduled_mw"] is None
            assert abs(news["time_ns"] - time.time_ns()) < 10e9
            device.slow_s = 2.0
            time.sleep(0.2)  # what was asked before it hung has come
            told, beats = len(control.said("pdci")), len(watchdog.beats("pdci"))
            wait_for(lambda: len(watchdog.beats("pdci")) > beats + 8)
            assert len(control.said("pdci")) == told, "old news is not told as new"
            device.slow_s = 0.0
            wait_for(lambda: len(control.said("pdci")) > told)


def test_without_a_source_the_loop_beats_all_the_same(folder: Path) -> None:
    with listening(folder, WATCHDOG, CONTROL) as (watchdog, control):
        aide = PdciAide(None, folder)
        with in_thread(aide.run, aide.stop):
            wait_for(lambda: len(watchdog.beats("pdci")) > 3)
        assert control.heard == []


def test_a_port_that_is_taken_is_one_line(folder: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        url = f"udp://127.0.0.1:{other.getsockname()[1]}"
        with pytest.raises(SourceError, match=rf"^\[pdci\] {url}: already in use"):
            PdciAide(line_source(url), folder)
