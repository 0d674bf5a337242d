"""``dcon run`` that drives a DAC: from frames to counts in a fake of an IIO device, and its readback into the log.

``DCON_KILLS=50`` strikes at the output four times; tests/platform/test_kills.py then strikes at all others.
"""

from __future__ import annotations

import os
import random
import signal
import sys
import time
from pathlib import Path

import pytest
from support.iio import counts, iio_device, volts
from support.running import PATIENCE_S, Running

from dcon.replay.replay import replay
from dcon.session.reader import SessionReader

KILLS = int(os.environ.get("DCON_KILLS", "3"))
SEED = int(os.environ.get("DCON_SEED", "1"))
ROUNDS = max(1, KILLS // 25)
pytestmark = [
    pytest.mark.alone,
    pytest.mark.slow,
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform != "linux", reason="dcon run and IIO are Linux's"),
]
ZERO = 32768
OPENS_MS = 220
"""After the last readback: ``readback_timeout_ms``, a round, and waking up."""


def within(seconds: float, site: Running, low_v: float, high_v: float) -> bool:
    """Whether the device's volts, either way, come to be in a range in time."""
    assert site.device is not None
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        if low_v <= abs(volts(site.device)) <= high_v:
            return True
        time.sleep(0.001)
    return False


def strike(site: Running, rng: random.Random, number: signal.Signals) -> None:
    """End the output, or stop it, at a random instant: the relays open in the stated time, and it comes back at 0 V."""
    time.sleep(rng.uniform(0.0, 0.3))
    restarts, events = site.restarts(), len(site.watchdog_events())
    at_ns = site.kill("output", number)
    site.until(lambda now: now["state"] != "ACTIVE", "the controller saw that the output was gone")
    opening = next(event for event in site.watchdog_events()[events:] if event["event"] in ("trip", "open"))
    assert (opening["monotonic_ns"] - at_ns) / 1e6 - max(0.0, opening["late_ms"]) <= OPENS_MS
    if number is signal.SIGSTOP:
        site.kill("output")
    site.until(lambda _: site.restarts() == restarts + 1, "the output started again")
    assert within(PATIENCE_S, site, 0.0, 0.001)  # the more often it has died, the later it is started again
    site.activate()


def test_it_drives_a_dac_sees_it_read_back_and_leaves_it_at_0_v(tmp_path: Path) -> None:
    device = iio_device(tmp_path, out_voltage0_raw="1234")
    site, rng = Running(tmp_path, device=device), random.Random(SEED)
    try:
        site.start("--json")
        site.in_state("STANDBY")
        assert counts(device) == ZERO, "what was there before is taken away at once"
        site.activate()
        assert within(5, site, 0.5, 10.0)
        site.caught_up()
        for number in (signal.SIGKILL, signal.SIGSTOP) * ROUNDS:
            strike(site, rng, number)
            assert within(5, site, 0.5, 10.0)
            site.caught_up()
        assert site.end() == 130
    finally:
        site.close()
    assert counts(device) == ZERO
    assert site.gateway.commands == []
    assert site.summary()["restarts"] == {"output": 2 * ROUNDS}
    told = [tick.surroundings.readback_v for tick in SessionReader(site.log).ticks()]
    driven = [tick.record.output_v for tick in SessionReader(site.log).ticks()]
    pairs = [(was, read) for was, read in zip(driven, told[1:], strict=False) if was and read is not None]
    assert len(pairs) > 50
    close = sum(abs(was - read) < 0.01 for was, read in pairs)
    assert close > 0.9 * len(pairs)  # one that the relays hold at 0 V reads back so
    assert replay(str(site.log)).different == 0
