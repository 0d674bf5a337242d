"""What ``dcon run`` says at its end of a log that the disk did not take."""

from __future__ import annotations

import resource
import sys
from pathlib import Path

import pytest
from support.running import Running

from dcon.replay.replay import replay
from dcon.session.reader import SessionReader

pytestmark = [
    pytest.mark.alone,
    pytest.mark.slow,
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform != "linux", reason="dcon run is Linux's"),
]


def test_ticks_that_are_missing_are_in_the_summary_and_the_exit_code(tmp_path: Path) -> None:
    """A disk without room, here a limit on the server's files; the server starts again meanwhile, and remembers.

    So it does when the controller is started again, and with it a session that lacks nothing.
    """
    site = Running(tmp_path)
    try:
        (tmp_path / "session.mcap").write_bytes(b"of an earlier run")
        site.start("--json", "--duration", "11")
        status = site.until(lambda now: now["log"]["file"] and now["log"]["lag_s"] < 1, "a log")
        assert status["log"]["file"].endswith("session-2.mcap")
        log = Path(status["log"]["file"])
        resource.prlimit(site.pid("server"), resource.RLIMIT_FSIZE, (log.stat().st_size, resource.RLIM_INFINITY))
        before = site.until(lambda now: now["log"]["unlogged_ticks"] > 60, "a full disk")["log"]["unlogged_ticks"]
        site.kill("server")
        site.until(lambda now: now["controller_connected"] and now["log"]["unlogged_ticks"] >= before, "its memory")
        site.until(lambda now: now["log"]["parts"] == 2 and now["log"]["lag_s"] < 1, "room")
        site.kill("platform")
        assert site.run is not None and site.run.wait(30) == 3, site.said()
    finally:
        site.close()
    summary, reader, last = site.summary(), SessionReader(log), SessionReader(tmp_path / "session-3.mcap")
    ticks = list(reader.ticks())
    events = [event for tick in ticks for event in tick.record.events if event.name == "log_gap"]
    passed = round((ticks[-1].record.tick_ns - ticks[0].record.tick_ns) * 60 / 1e9) + 1
    assert summary["unlogged_ticks"] == passed - len(ticks) > 60
    assert summary["unlogged_ticks"] == sum(int(event.detail.split()[0]) for event in events)
    assert summary["ticks"] == len(list(last.ticks()))
    assert summary["log_parts"] == [str(part.log.path) for part in last.parts]
    assert summary["restarts"] == {"server": 1, "platform": 1}
    assert f"{summary['unlogged_ticks']} ticks are missing in the session logs" in site.said()
    assert f"session log: {log}" in site.said()
    result = replay(log)
    (gap,) = result.gaps
    assert (result.different, result.ticks + gap.ticks) == (0, len(ticks)), result.first
