"""What ``dcon run`` says at its end of a log that the disk did not take."""

from __future__ import annotations

import resource
import sys
from pathlib import Path

import pytest
from support.running import Running

from dcon.session.reader import SessionReader

pytestmark = [
    pytest.mark.alone,
    pytest.mark.slow,
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform != "linux", reason="dcon run is Linux's"),
]


def test_ticks_that_are_missing_are_in_the_summary_and_the_exit_code(tmp_path: Path) -> None:
    """A disk without room, here a limit on the server's files; the server starts again meanwhile, and remembers."""
    site = Running(tmp_path)
    try:
        (tmp_path / "session.mcap").write_bytes(b"of an earlier run")
        site.start("--json", "--duration", "9")
        status = site.until(lambda now: now["log"]["file"] and now["log"]["lag_s"] < 1, "a log")
        assert status["log"]["file"].endswith("session-2.mcap")
        log = Path(status["log"]["file"])
        resource.prlimit(site.pid("server"), resource.RLIMIT_FSIZE, (log.stat().st_size, resource.RLIM_INFINITY))
        before = site.until(lambda now: now["log"]["unlogged_ticks"] > 60, "a full disk")["log"]["unlogged_ticks"]
        site.kill("server")
        site.until(lambda now: now["controller_connected"] and now["log"]["unlogged_ticks"] >= before, "its memory")
        assert site.run is not None and site.run.wait(30) == 3, site.said()
    finally:
        site.close()
    summary, reader = site.summary(), SessionReader(log)
    ticks = list(reader.ticks())
    events = [event for tick in ticks for event in tick.record.events if event.name == "log_gap"]
    assert summary["unlogged_ticks"] == summary["ticks"] - len(ticks) > 60
    assert summary["unlogged_ticks"] == sum(int(event.detail.split()[0]) for event in events)
    assert summary["log_parts"] == [str(part.log.path) for part in reader.parts]
    assert summary["restarts"] == {"server": 1}
    assert f"{summary['unlogged_ticks']} ticks are missing in the session log" in site.said()
    assert f"session log: {log}" in site.said()
