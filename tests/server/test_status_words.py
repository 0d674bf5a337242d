"""What a status says, and shows: in virtual time, from ticks as the controller ships them."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from support.sessions import HEAD, INSTANCES, T0, random_ticks

from dcon.cli import status_text
from dcon.core.rows import CORE
from dcon.core.values import Flag, Pdci, Surroundings, SystemState
from dcon.link.bundle import Bundle, Kind
from dcon.link.counts import COUNTS
from dcon.server.newest import Newest
from dcon.server.status import LineExpected, to_json, watchdog_of
from dcon.session.encode import tick_entries
from pmutools.timebase import NS

HERE = LineExpected(True, 2.0)
LINE = Pdci(T0 - NS // 10, 2012.25, True, True, 2000.0)
SAID = {"power_mw": 2012.25, "scheduled_mw": 2000.0, "in_service": True, "dcon_enabled": True}
LOG: dict[str, Any] = {"file": "/a/s.mcap", "lag_s": 0.3, "unlogged_ticks": 0, "disk_free_percent": 41.2}
LOG |= {"hangs": False, "refused": False}


def status(
    told: Surroundings = Surroundings(),  # noqa: B008  # a tuple
    *flags: Flag,
    source: LineExpected = HERE,
    after_ns: int = 0,
    counts: dict[str, int] | None = None,
    watchdog: dict[str, Any] | None = None,
    log: dict[str, Any] | None = None,
    **record: Any,
) -> dict[str, Any]:
    """As an operator gets it ``after_ns`` after the controller's last tick; ``record`` are fields of that."""
    newest = Newest(HEAD, source)
    tick = random_ticks(1)[0].record._replace(
        tick_ns=T0, state=SystemState.ACTIVE, flags=0, flag_changes=flags, events=(), **record
    )
    entries = tick_entries(INSTANCES, tick, counts=counts, surroundings=told)
    newest.take(Bundle(Kind.TICK, 0, 1, T0, tuple(entries)))
    connected = after_ns < NS // 2
    said = newest.status(T0 + after_ns, not connected)
    whole = {"controller_connected": connected, "tick_age_ms": after_ns / 1e6, **said, "log": LOG | (log or {})}
    answer: dict[str, Any] = json.loads(to_json({**whole, "watchdog": watchdog}))
    return answer


def up(name: str, value: float = 0.0) -> Flag:
    return Flag(name, "system", True, T0, T0, 1, value, 1.0, False, "")


def lines(*given: Any, **named: Any) -> list[str]:
    return status_text.text(status(*given, **named)).splitlines()


def one(beginning: str, text: list[str]) -> str:
    (found,) = [line for line in text if line.strip().startswith(beginning)]
    return found


# --- the line ------------------------------------------------------------------------------------------------------


def test_a_line_that_is_known_is_said_with_its_age() -> None:
    told = status(Surroundings(pdci=LINE))["line"]
    assert told == {"known": True, "age_s": 0.1, "time_ns": LINE.time_ns, **SAID, "last_said": SAID}
    words = "line 2012.2 MW, 2000.0 MW scheduled, in service, accepts the command; 0.1 s old"
    assert one("line ", lines(Surroundings(pdci=LINE))) == words


def test_a_line_that_is_out_of_service_is_not_one_that_nobody_knows_of() -> None:
    out = Surroundings(pdci=LINE._replace(in_service=False))
    assert "OUT OF SERVICE" in one("line ", lines(out, up("line_out")))
    assert one("up", lines(out, up("line_out"))).endswith("line_out system: the line is out of service")
    silent = Surroundings(pdci=LINE._replace(time_ns=T0 - 12 * NS))
    told = status(silent)["line"]
    assert told["known"] is False and told["age_s"] == 12.0 and told["last_said"] == SAID
    assert all(told[name] is None for name in SAID)
    said = lines(silent, up("line_out", math.nan), up("line_refuses", math.nan))
    assert one("line ", said).startswith("line NOT KNOWN: its newest status is 12.0 s old; it said: 2012.2 MW, ")
    assert [line.split(": ")[1] for line in said if "up " in line] == 2 * ["the line's status is not known, for 12.0 s"]


@pytest.mark.parametrize(("age_ns", "known"), [(2 * NS, True), (2 * NS + 1, False)])
def test_a_check_says_what_the_controller_knew_in_its_tick(age_ns: int, known: bool) -> None:
    text = one("up", lines(Surroundings(pdci=LINE._replace(time_ns=T0 - age_ns)), up("line_out"), after_ns=NS // 4))
    assert ("not known" in text) != known


def test_a_line_that_never_told_its_status() -> None:
    told = status()["line"]
    assert told["known"] is False and told["age_s"] is told["power_mw"] is told["last_said"] is None
    assert one("line ", lines()) == "line NOT KNOWN: it has never told its status"
    assert one("up", lines(Surroundings(), up("line_out", math.nan))).endswith("is not known, and never was")
    assert status(source=LineExpected())["line"] is None
    assert not [line for line in lines(source=LineExpected()) if line.startswith("line")]


def test_a_line_that_tells_no_schedule() -> None:
    told = Surroundings(pdci=LINE._replace(scheduled_mw=math.nan))
    assert "2012.2 MW, not known MW scheduled" in one("line ", lines(told))


@pytest.mark.parametrize(
    ("name", "told"), [("gps", {"gps_age_s": 9.0}), ("estop", {"estop_released": False}), ("watchdog", {})]
)
def test_a_check_of_what_nobody_has_told_says_so(name: str, told: dict[str, Any]) -> None:
    untold = one("up", lines(Surroundings(server_age_s=0.0), up(name, math.nan)))
    assert f"{name} system: nobody has told yet whether" in untold
    told = told or {"watchdog_healthy": False}
    plain = next(row.text for row in CORE.rows if row.name == name)
    assert one("up", lines(Surroundings(**told), up(name))).endswith(plain)


# --- the watchdog --------------------------------------------------------------------------------------------------


def watchdog(latched: bool, silent: bool = False, age_ms: float = 20.0) -> dict[str, Any]:
    said = {"relays_closed": not latched, "estop": False, "latched": latched, "causes": ["control"] if latched else []}
    return watchdog_of(silent, **said, age_ms=age_ms, beats_ms={})  # type: ignore[arg-type]


def test_the_first_line_has_a_trip_whatever_the_controller_s_last_word_was() -> None:
    assert lines(watchdog=watchdog(False))[0].startswith("ACTIVE, ")
    assert lines(watchdog=watchdog(True))[0].startswith("the watchdog has TRIPPED; the controller: ACTIVE, ")
    first, second, *_ = lines(watchdog=watchdog(True), after_ns=6 * NS)
    assert first.startswith("OLD, by 6.0 s, and the watchdog has TRIPPED: ") and second.startswith("last known: ACTIVE")
    silent = lines(watchdog=watchdog(True, silent=True))
    assert silent[0].startswith("the watchdog had TRIPPED when it was last heard; the controller: ACTIVE, ")
    assert status_text.line(status(watchdog=watchdog(True))).startswith("the watchdog has TRIPPED; ACTIVE ")
    both = status_text.line(status(watchdog=watchdog(True), after_ns=6 * NS))
    assert both.startswith("OLD, by 6.0 s; the watchdog has TRIPPED; last known: ACTIVE ")


def test_a_trip_before_any_controller_was_heard() -> None:
    newest = Newest(HEAD, HERE).status(T0, True)
    whole = {"controller_connected": False, "tick_age_ms": None, **newest, "watchdog": watchdog(True), "log": LOG}
    assert status_text.text(whole).splitlines()[0] == "the watchdog has TRIPPED; no controller has been heard yet"


# --- the rest ------------------------------------------------------------------------------------------------------


def test_numbers_that_are_not_known_are_said_so() -> None:
    nan = dict.fromkeys(("command_mw", "output_v", "probe_mw", "gain_mw_per_mhz"), math.nan)
    said = lines(**nan)
    assert "gain not known MW/mHz" in said[0]
    assert said[1] == "command not known MW, output not known V, probe not known MW"
    assert "not known MW not known V" in status_text.line(status(**nan))


def test_a_log_that_is_not_there_is_not_behind() -> None:
    assert lines()[-1] == "log /a/s.mcap, 0.3 s behind, 0 ticks missing, disk 41 % free"
    none = {"file": "", "lag_s": None, "unlogged_ticks": 60, "disk_free_percent": None}
    assert lines(log=none)[-1] == "no log, 60 ticks missing"
    assert "  no log" in status_text.line(status(log=none)) and "log 0.3 s behind" in status_text.line(status())
    assert ", the disk hangs, " in lines(log={"hangs": True})[-1]
    full = {"refused": True, "unlogged_ticks": 390, "disk_free_percent": 0.0}
    said = "log NOT WRITTEN: the system takes nothing for /a/s.mcap; is the disk full? 390 ticks missing, disk 0 % free"
    assert lines(log=full)[-1] == said and "  log NOT WRITTEN" in status_text.line(status(log=full))


def test_a_flag_of_which_only_the_name_is_known_has_no_subject() -> None:
    """Of a check that was up before the server was started: its tick says that it is up, and no more."""
    known = status()
    flags = [
        {"name": name, "subject": subject, "text": "why", "up": True} for name, subject in (("disk", ""), ("a", "b"))
    ]
    said = status_text.text({**known, "flags": flags}).splitlines()
    assert "  up       disk: why" in said and "  up       a b: why" in said


def test_counts_are_all_there_and_those_that_tell_something_are_shown() -> None:
    told = status(counts={"foreign": 3, "held": 0, "repeated": 5, "own_drops": 2, "of another version": 9})["counts"]
    assert told == {**dict.fromkeys(COUNTS, 0), "foreign": 3, "repeated": 5, "own_drops": 2}
    assert one("not taken", lines(counts=told)) == "not taken: foreign 3, own_drops 2"
    assert not [line for line in lines(counts={"repeated": 5}) if line.startswith("not taken")]
    assert status()["counts"] is None and lines()[-1].startswith("log ")
