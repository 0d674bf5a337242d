"""PTP: what ``pmc`` says, as text and from a real pair of ptp4l that may not touch the clock."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest
from support.clock_programs import ptp4l_pair, until
from support.requires import requires

from pmutools.clocksources.asking import NoAnswer, Patience
from pmutools.clocksources.ptp import ask_ptp, clock_offset_ns, parse_pmc, ptp_clock, system_offset_ns

# linuxptp 3.1.1 (Debian 12), as it wrote it, but for the port's state, the timescale and the stamping
ANSWER = """sending: GET TIME_STATUS_NP
sending: GET CURRENT_DATA_SET
\t7a51f5.fffe.6f03f8-0 seq 0 RESPONSE MANAGEMENT TIME_STATUS_NP\x20
\t\tmaster_offset              -247
\t\tingress_time               1795836426146197463
\t\tcumulativeScaledRateOffset +0.000000000
\t\tscaledLastGmPhaseChange    0
\t\tgmTimeBaseIndicator        0
\t\tlastGmPhaseChange          0x0000'0000000000000000.0000
\t\tgmPresent                  true
\t\tgmIdentity                 9e5a6b.fffe.6193ab
sending: GET PARENT_DATA_SET
\t7a51f5.fffe.6f03f8-0 seq 1 RESPONSE MANAGEMENT CURRENT_DATA_SET\x20
\t\tstepsRemoved     1
\t\toffsetFromMaster -247.0
\t\tmeanPathDelay    1736.0
sending: GET TIME_PROPERTIES_DATA_SET
\t7a51f5.fffe.6f03f8-0 seq 2 RESPONSE MANAGEMENT PARENT_DATA_SET\x20
\t\tparentPortIdentity                    9e5a6b.fffe.6193ab-1
\t\tparentStats                           0
\t\tobservedParentOffsetScaledLogVariance 0xffff
\t\tobservedParentClockPhaseChangeRate    0x7fffffff
\t\tgrandmasterPriority1                  128
\t\tgm.ClockClass                         6
\t\tgm.ClockAccuracy                      0x21
\t\tgm.OffsetScaledLogVariance            0xffff
\t\tgrandmasterPriority2                  128
\t\tgrandmasterIdentity                   9e5a6b.fffe.6193ab
sending: GET PORT_PROPERTIES_NP
\t7a51f5.fffe.6f03f8-0 seq 3 RESPONSE MANAGEMENT TIME_PROPERTIES_DATA_SET\x20
\t\tcurrentUtcOffset      37
\t\tleap61                0
\t\tleap59                0
\t\tcurrentUtcOffsetValid 1
\t\tptpTimescale          1
\t\ttimeTraceable         1
\t\tfrequencyTraceable    1
\t\ttimeSource            0x20
sending: GET PORT_DATA_SET
\t7a51f5.fffe.6f03f8-1 seq 4 RESPONSE MANAGEMENT PORT_PROPERTIES_NP\x20
\t\tportIdentity            7a51f5.fffe.6f03f8-1
\t\tportState               SLAVE
\t\ttimestamping            HARDWARE
\t\tinterface               eth1
\t7a51f5.fffe.6f03f8-1 seq 5 RESPONSE MANAGEMENT PORT_DATA_SET\x20
\t\tportIdentity            7a51f5.fffe.6f03f8-1
\t\tportState               SLAVE
\t\tlogMinDelayReqInterval  -4
\t\tpeerMeanPathDelay       0
\t\tversionNumber           2
"""
CARD_NS = 40
BOUND_NS = 247 + CARD_NS + 1736 + 100


def card(interface: str, utc_offset_s: int) -> int | None:
    return CARD_NS if (interface, utc_offset_s) == ("eth1", 37) else None


def changed(old: str, new: str) -> str:
    assert old in ANSWER
    return ANSWER.replace(old, new)


def test_what_it_says() -> None:
    clock = ptp_clock(parse_pmc(ANSWER), card)
    assert (clock.grandmaster, clock.clock_class, clock.accuracy_ns) == ("9e5a6b.fffe.6193ab", 6, 100)
    assert (clock.master_offset_ns, clock.mean_path_delay_ns, clock.utc_offset_s) == (-247, 1736, 37)
    assert (clock.system_offset_ns, clock.state, clock.leap, clock.why_not) == (CARD_NS, "SLAVE", 0, "")
    assert clock.bound_ns == BOUND_NS


@pytest.mark.parametrize(
    ("text", "bound_ns", "why"),
    [
        (changed("0x21", "0xfe"), BOUND_NS - 100, ""),
        (changed("HARDWARE", "SOFTWARE"), BOUND_NS - CARD_NS, ""),
        (changed("gm.ClockClass                         6", "gm.ClockClass 7"), BOUND_NS, ""),
        (changed("gm.ClockClass                         6", "gm.ClockClass 248"), None, "clock class 248"),
        (changed("gm.ClockClass                         6", "gm.ClockClass 13"), None, "clock class 13"),
        (changed("SLAVE", "LISTENING"), None, "LISTENING"),
        (changed("SLAVE", "UNCALIBRATED"), None, "UNCALIBRATED"),
        (changed("SLAVE", "GRAND_MASTER"), None, "GRAND_MASTER"),
        (changed("gmPresent                  true", "gmPresent false"), None, "without a master"),
        (changed("ptpTimescale          1", "ptpTimescale 0"), None, "timescale of its own"),
        (changed("currentUtcOffsetValid 1", "currentUtcOffsetValid 0"), None, "cannot be read"),
        (changed("interface               eth1", "interface eth2"), None, "cannot be read"),
        (changed("timestamping            HARDWARE\n", ""), BOUND_NS, ""),
        (ANSWER.partition("\t7a51f5.fffe.6f03f8-1 seq 5")[0], BOUND_NS, ""),
    ],
)
def test_what_it_promises(text: str, bound_ns: int | None, why: str) -> None:
    clock = ptp_clock(parse_pmc(text), card)
    assert clock.bound_ns == bound_ns
    assert why in clock.why_not


def test_the_last_word_of_who_lost_its_master_is_old_news() -> None:
    """ptp4l 3.1.1 still says gmPresent true, its last offset and the grandmaster's class when that is gone."""
    text = changed("SLAVE", "LISTENING")
    assert "gmPresent                  true" in text
    assert ptp_clock(parse_pmc(text), card).bound_ns is None


def test_leap_seconds() -> None:
    assert ptp_clock(parse_pmc(changed("leap61                0", "leap61 1")), card).leap == 1
    assert ptp_clock(parse_pmc(changed("leap59                0", "leap59 1")), card).leap == -1


def test_the_port_that_follows_is_the_one_that_counts() -> None:
    """A boundary clock: one port follows, the others serve."""
    at = ANSWER.index("\t7a51f5.fffe.6f03f8-1 seq 4")
    ports = ANSWER[at:]
    others = ports.replace("SLAVE", "MASTER").replace("eth1", "eth9").replace("f03f8-1", "f03f8-2")
    for text in (ANSWER[:at] + others + ports, ANSWER + others):
        clock = ptp_clock(parse_pmc(text), card)
        assert (clock.state, clock.system_offset_ns) == ("SLAVE", CARD_NS)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (ANSWER[:300], "no PARENT_DATA_SET"),
        (changed("\t\tmeanPathDelay    1736.0\n", ""), "no meanPathDelay"),
        (changed("1736.0", "nan"), "meanPathDelay 'nan' is no number"),
        (changed("1736.0", "inf"), "meanPathDelay 'inf' is no number"),
        (changed("-247\n", "-2\xff47\n"), "is no number"),
        (changed("RESPONSE MANAGEMENT CURRENT_DATA_SET", "RESPONSE MANAGEMENT MANAGEMENT_ERROR_STATUS"), "no CURRENT"),
    ],
)
def test_what_makes_no_sense(text: str, complaint: str) -> None:
    with pytest.raises(ValueError, match="no ") as caught:
        ptp_clock(parse_pmc(text), card)
    assert complaint in str(caught.value)


@pytest.mark.parametrize(
    "text", ["", "sending: GET TIME_STATUS_NP\n", "bad command: GET X\n", "\0\n\t\t\n", "\tx\ty\n"]
)
def test_no_answer_is_no_data_set(text: str) -> None:
    assert parse_pmc(text) == []


def test_every_piece_of_an_answer_is_read_or_refused() -> None:
    for end in range(0, len(ANSWER), 7):
        try:
            ptp_clock(parse_pmc(ANSWER[:end]), card)
        except ValueError as error:
            assert str(error).startswith(("no ", "gm.", "master_offset", "meanPathDelay", "currentUtcOffset"))


def test_no_card_no_offset(tmp_path: Path) -> None:
    assert system_offset_ns("lo", 37) is None
    assert system_offset_ns("../../etc", 37) is None
    (tmp_path / "class" / "net" / "eth1" / "device" / "ptp" / "ptp0").mkdir(parents=True)
    assert system_offset_ns("eth1", 37, tmp_path, tmp_path) is None, "there is no such device"
    (tmp_path / "ptp0").touch()
    assert system_offset_ns("eth1", 37, tmp_path, tmp_path) is None, "it is no clock"


@pytest.mark.skipif(not hasattr(time, "CLOCK_TAI"), reason="needs Linux")
def test_two_clocks_side_by_side() -> None:
    assert abs(clock_offset_ns(time.CLOCK_REALTIME, 0)) < 1_000_000
    ahead = round(time.clock_gettime(time.CLOCK_TAI) - time.time())
    assert abs(clock_offset_ns(time.CLOCK_TAI, ahead)) < 1_000_000
    assert clock_offset_ns(time.CLOCK_REALTIME, 37) == pytest.approx(37e9, abs=1e6), (
        "a card that runs on UTC by mistake"
    )


def test_no_daemon(tmp_path: Path) -> None:
    with pytest.raises(NoAnswer, match="no ptp4l at"):
        ask_ptp("/bin/false", str(tmp_path / "none"), Patience(1))
    (tmp_path / "stale").touch()
    with pytest.raises(NoAnswer, match="does not answer"):
        ask_ptp("/bin/echo", str(tmp_path / "stale"), Patience(1))


@pytest.mark.peer
@pytest.mark.realtime
def test_a_real_ptp4l(tmp_path: Path) -> None:
    """Its data sets are read. As it may not steer a clock it never gets beyond UNCALIBRATED, and promises nothing."""
    with ptp4l_pair(tmp_path) as (socket, grandmaster):
        pmc = str(requires("pmc"))
        clock = until(
            lambda patience: ask_ptp(pmc, str(socket), patience),
            lambda clock: clock.state == "UNCALIBRATED" and clock.mean_path_delay_ns > 0,
        )
        assert (clock.clock_class, clock.accuracy_ns, clock.system_offset_ns) == (6, 100, 0)
        assert abs(clock.master_offset_ns) < 10_000_000
        assert clock.bound_ns is None
        os.kill(grandmaster, signal.SIGKILL)
        clock = until(lambda patience: ask_ptp(pmc, str(socket), patience), lambda clock: clock.state == "LISTENING")
        assert clock.bound_ns is None
    with pytest.raises(NoAnswer):
        ask_ptp(pmc, str(socket), Patience(5))
