"""A running controller whose watchdog keeps its relays open, and one whose watchdog is started anew after a trip."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.running import Running

from dcon.cli import dcon
from dcon.link import paths
from dcon.session.reader import SessionReader
from dcon.watchdog.codec import encode_status
from dcon.watchdog.latch import NAME
from pmutools.cli.shell import run

pytestmark = [
    pytest.mark.alone,
    pytest.mark.slow,
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform != "linux", reason="dcon run is Linux's"),
]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    site = Running(tmp_path_factory.mktemp("open"))
    try:
        site.start()
        yield site
    finally:
        site.close()


@contextmanager
def well_and_open(run_dir: Path) -> Iterator[None]:
    """What a watchdog says that is well, and whose relays are open."""
    over, control = threading.Event(), paths.Sender(run_dir / paths.CONTROL)

    def speak() -> None:
        while not over.wait(0.01):
            control.send(encode_status(1, time.monotonic_ns(), 0, 7, 0, True, 0))

    speaker = threading.Thread(target=speak)
    speaker.start()
    try:
        yield
    finally:
        over.set()
        speaker.join()
        control.close()


def test_open_relays_disarm_within_a_second(site: Running) -> None:
    site.activate()
    restarts = site.restarts()
    with well_and_open(site.run_dir):
        since_ns = time.time_ns()
        site.kill("watchdog", signal.SIGSTOP)
        site.in_state("STANDBY")
        status = site.until(lambda now: any(flag["name"] == "relays_open" for flag in now["flags"]), "the flag")
        (flag,) = [flag for flag in status["flags"] if flag["name"] == "relays_open"]
        assert flag["latched"] and not flag["up"] and flag["text"] == "the relays are open, and nothing passes"
        assert "what disarmed or tripped last is not acknowledged" in site.order("arm")["refused"]
        site.kill("watchdog")
    site.until(lambda now: site.restarts() > restarts and not now["watchdog"]["silent"], "a new watchdog")
    site.caught_up()
    ticks = [t.record for p in site.folder.glob("session*.mcap") for t in SessionReader(p).ticks()]
    over = [record.tick_ns for record in ticks if record.tick_ns > since_ns and record.state != "ACTIVE"]
    assert 0.4e9 < min(over) - since_ns < 1e9


def shown(site: Running, capsys: pytest.CaptureFixture[str]) -> str:
    """What ``dcon ctl status`` prints."""
    capsys.readouterr()
    assert run(dcon(), ["ctl", "status", "--to", f"127.0.0.1:{site.server_port}"]) == 0
    return capsys.readouterr().out


def test_a_trip_outlives_a_new_watchdog_and_an_operator_ends_it(
    site: Running, capsys: pytest.CaptureFixture[str]
) -> None:
    site.activate()
    site.obeyed("estop")
    site.in_state("ESTOP")
    latch = site.run_dir / NAME
    site.until(lambda _: latch.exists(), "a latch")
    begun = len(site.watchdog_events())
    site.kill("watchdog")
    site.until(lambda _: any(event["event"] == "start" for event in site.watchdog_events()[begun:]), "a new watchdog")
    (start,) = [event for event in site.watchdog_events()[begun:] if event["event"] == "start"]
    assert start["state"] == "TRIPPED" and "estop_software" in start["causes"]
    status = site.until(lambda now: "estop_software" in ((now["watchdog"] or {}).get("causes") or ()), "its cause")
    assert status["watchdog"]["latched"] and not status["watchdog"]["relays_closed"] and status["state"] == "ESTOP"
    assert "relays open; tripped; causes: " in shown(site, capsys) and " estop_software" in shown(site, capsys)
    site.activate()
    assert not latch.exists()
    assert site.status()["watchdog"]["causes"] == [] and "\nrelays closed; beats in ms: control " in shown(site, capsys)
    assert site.end() == 130
