"""``dcon run`` whose clock's lock is the word of a real gpsd: it is armed by that, and disarmed when gpsd ends."""

from __future__ import annotations

import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
from support.clock_programs import gpsd_of, receiver
from support.running import Running

from dcon.replay.replay import replay
from dcon.session.reader import SessionReader

pytestmark = [
    pytest.mark.alone,
    pytest.mark.peer,
    pytest.mark.slow,
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform != "linux", reason="dcon run is Linux's"),
]


def test_a_gpsd_that_ends_disarms(tmp_path: Path) -> None:
    """The receiver's time goes at the clock's pace, so that its fixes lie within a second of it."""
    with ExitStack() as gpsd:
        port = gpsd.enter_context(gpsd_of(receiver(time.time() + 0.8, 120), tmp_path, cycle_s=0.34))
        site = Running(tmp_path, time_source=f"gpsd\ngpsd = 127.0.0.1:{port}")
        site.around.gps_age_s = None
        try:
            site.start()
            site.activate()
            gpsd.close()
            site.until(lambda now: now["state"] == "STANDBY", "disarmed")
            site.caught_up()
            assert site.end() == 130
        finally:
            site.close()
    ticks = list(SessionReader(site.log).ticks())
    ages = [tick.surroundings.gps_age_s for tick in ticks]
    assert ages[0] is None and 0.0 in ages
    fell = next(k for k, tick in enumerate(ticks) if any(event.name == "rampdown" for event in tick.record.events))
    assert (ages[fell] or 0.0) > 0.5 and {event.name for event in ticks[fell].record.events} >= {"gps", "rampdown"}
    assert replay(str(site.log)).different == 0
