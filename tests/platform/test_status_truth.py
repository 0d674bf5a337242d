"""What ``dcon ctl status`` says while a process of a running ``dcon run`` stands still, or is gone."""

from __future__ import annotations

import random
import signal
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from support.running import Running, flood, frames_now

from dcon.cli import dcon
from pmutools.cli.shell import run

pytestmark = [
    pytest.mark.alone,
    pytest.mark.slow,
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform != "linux", reason="dcon run is Linux's"),
]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    site = Running(tmp_path_factory.mktemp("truth"))
    try:
        site.start()
        yield site
    finally:
        site.close()


def shown(site: Running, capsys: pytest.CaptureFixture[str]) -> list[str]:
    capsys.readouterr()
    assert run(dcon(), ["ctl", "status", "--to", f"127.0.0.1:{site.server_port}"]) == 0
    return capsys.readouterr().out.splitlines()


def test_what_a_flood_brings_that_is_no_frame_is_counted_and_shown(
    site: Running, capsys: pytest.CaptureFixture[str]
) -> None:
    """From the permitted address, and from a sender that never sends a frame."""
    site.in_state("STANDBY")
    rng = random.Random(1)
    (frame,) = frames_now("N1", 1)
    before = site.until(lambda now: now["counts"] and not now["counts"]["held"], "its configurations")["counts"]
    with flood(site.ports[0], [rng.randbytes(60), b"", frame[:-1], frame[:20] + b"?" + frame[21:]], 0.5):
        pass
    with flood(site.ports[0], [frame, rng.randbytes(60)], 0.1, source="127.0.0.2"):
        pass

    def counted(status: dict[str, Any]) -> bool:
        more = {name: value - before[name] for name, value in status["counts"].items() if value != before[name]}
        more.pop("repeated", None)  # the player repeats its configurations
        return more.pop("own_drops", 0) + sum(more.values()) == 6000 and set(more) <= {"undecodable", "foreign"}

    status = site.until(counted, "each datagram counted")
    counts = status["counts"]
    (line,) = [line for line in shown(site, capsys) if line.startswith("not taken: ")]
    assert f"foreign {counts['foreign']}, undecodable {counts['undecodable']}" in line


def test_a_controller_that_stands_still(site: Running, capsys: pytest.CaptureFixture[str]) -> None:
    site.activate()
    lines = shown(site, capsys)
    assert lines[0].startswith("ACTIVE, closed_loop") and any(line.startswith("relays closed") for line in lines)
    (line,) = [line for line in lines if line.startswith("line ")]
    assert "2000.0 MW scheduled, in service, accepts the command; 0." in line
    site.kill("platform", signal.SIGSTOP)
    try:
        status = site.until(lambda now: now["tick_age_ms"] > 1000, "an old tick")
        assert status["controller_connected"] is False and status["state"] == "ACTIVE"
        watchdog = status["watchdog"]
        assert watchdog["source"] == "watchdog" and watchdog["age_ms"] < 100
        assert watchdog["latched"] and watchdog["relays_closed"] is False and "control" in watchdog["causes"]
        lines = shown(site, capsys)
        assert lines[0].startswith("OLD, by ") and ", and the watchdog has TRIPPED: " in lines[0]
        assert lines[1].startswith("last known: ACTIVE")
        assert any(line.startswith("relays open; tripped; causes: ") for line in lines)
        assert not any("relays closed" in line for line in lines)
    finally:
        site.kill("platform", signal.SIGCONT)
    site.in_state("FAULT")


def test_a_controller_that_is_gone(site: Running, capsys: pytest.CaptureFixture[str]) -> None:
    site.activate()
    restarts = site.restarts()
    site.kill("platform")
    status = site.until(lambda now: not now["controller_connected"], "its death")
    assert status["state"] in ("ACTIVE", None)
    status = site.until(lambda now: (now["watchdog"] or {}).get("latched"), "the watchdog's word")
    assert status["watchdog"]["relays_closed"] is False
    site.until(lambda now: site.restarts() > restarts and now["controller_connected"], "another")
    assert not shown(site, capsys)[0].startswith("OLD")


def test_a_watchdog_that_stands_still(site: Running, capsys: pytest.CaptureFixture[str]) -> None:
    site.activate()
    site.kill("watchdog", signal.SIGSTOP)
    try:
        status = site.until(lambda now: now["watchdog"]["silent"], "its silence")
        assert status["watchdog"]["relays_closed"] is None and status["watchdog"]["causes"] is None
        assert status["watchdog"]["last_said"]["relays_closed"] is True
        (line,) = [line for line in shown(site, capsys) if "relays" in line and "watchdog" in line]
        assert line.startswith("relays NOT KNOWN: the watchdog is silent; ")
    finally:
        site.kill("watchdog", signal.SIGCONT)
    site.until(lambda now: not now["watchdog"]["silent"], "its word")


def test_a_server_that_was_away_says_nothing_old_as_new(site: Running) -> None:
    """What was kept for it comes late: it is not present because it has just come."""
    site.activate()
    restarts = site.restarts()
    site.kill("server")
    fresh = site.until(lambda now: site.restarts() > restarts and now["controller_connected"], "caught up")
    assert fresh["time_ns"] - fresh["tick_ns"] < 500_000_000 and fresh["tick_age_ms"] < 500
    assert fresh["state"] == "ACTIVE" and fresh["watchdog"]["source"] == "watchdog"
    assert fresh["watchdog"]["relays_closed"] is True
