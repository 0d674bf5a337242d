"""chrony: what ``chronyc -c tracking`` says, as text and from a real chronyd that may not touch the clock."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.clock_programs import chronyd, running, settled, until
from support.live import free_ports
from support.requires import requires

from pmutools.clocksources.asking import NoAnswer, Patience
from pmutools.clocksources.chrony import Chronyd, ask_chrony, parse_tracking

# chrony 4.3 (Debian 12), as it wrote them
FOLLOWING = (
    "7F000001,127.0.0.1,2,1795836300.652615076,-0.000001025,0.000000006,0.000000019,-0.035,-0.000,0.075,"
    "0.000004946,0.000000767,0.1,Normal"
)
LOCAL = (
    "7F7F0101,,1,1795836293.945904220,0.000000000,0.000000000,0.000000000,0.000,0.000,0.000,0.000000000,"
    "0.000000000,0.0,Normal"
)
ALONE = (
    "00000000,,0,0.000000000,0.000000000,0.000000000,0.000000000,0.000,0.000,0.000,1.000000000,1.000000000,"
    "0.0,Not synchronised"
)
# as the same fields look over the internet
DISTANT = (
    "CB00710F,203.0.113.15,3,1517221478.987654321,0.000123456,-0.000012345,0.000234567,-7.123,0.001,0.054,"
    "0.012345678,0.001234567,1032.2,{leap}"
)


def test_what_it_says() -> None:
    clock = parse_tracking(FOLLOWING + "\n")
    assert (clock.reference, clock.name, clock.stratum) == ("7F000001", "127.0.0.1", 2)
    assert (clock.correction_s, clock.frequency_ppm, clock.skew_ppm) == (-1.025e-6, -0.035, 0.075)
    assert clock.reference_time_s == pytest.approx(1795836300.652615)
    assert clock.bound_ns == round(1025 + 4946 / 2 + 767)
    assert parse_tracking(DISTANT.format(leap="Normal")).bound_ns == 123_456 + 6_172_839 + 1_234_567


def test_who_follows_nobody_promises_nothing() -> None:
    assert parse_tracking(ALONE).bound_ns is None
    assert not parse_tracking(ALONE).local
    local = parse_tracking(LOCAL)
    assert local.leap_status == "Normal", "it says that all is well, with an error of 0"
    assert local.local
    assert local.bound_ns is None


@pytest.mark.parametrize(
    ("address", "smeared"),
    [
        ("216.239.35.8", True),
        ("2001:4860:4806:c::", True),
        ("169.254.169.123", True),
        ("129.134.28.123", True),
        ("203.0.113.15", False),
        ("time.example.org", False),
        ("", False),
        ("PPS", False),
    ],
)
def test_who_smears_leap_seconds(address: str, smeared: bool) -> None:
    assert parse_tracking(FOLLOWING.replace("127.0.0.1", address)).smeared is smeared


@pytest.mark.parametrize(
    "text",
    [
        FOLLOWING + ",one more field of a later version",
        "warning: something\n" + FOLLOWING,
        FOLLOWING + "\r\n\r\n",
        "  " + FOLLOWING.lower().replace("normal", "Normal"),
    ],
)
def test_what_is_read_all_the_same(text: str) -> None:
    assert parse_tracking(text).stratum == 2


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "no tracking report: nothing"),
        ("506 Cannot talk to daemon", "no tracking report: 506 Cannot talk"),
        ("chronyc: invalid option -- 'c'\nUsage: chronyc [-h HOST]", "no tracking report: chronyc: invalid option"),
        ("Reference ID    : 7F000001 (localhost)\nStratum         : 2", "no tracking report: Reference ID"),
        (FOLLOWING.rpartition(",")[0], "no tracking report"),
        (FOLLOWING[:60], "no tracking report"),
        (FOLLOWING.replace("-0.035", "-0,035"), "leap status '0.1' is none of"),
        (FOLLOWING.replace("Normal", "Normal?"), "leap status 'Normal?' is none of"),
        (FOLLOWING.replace("0.000004946", "nan"), "root delay 'nan' is no number"),
        (FOLLOWING.replace("0.000000767", ""), "root dispersion '' is no number"),
        (FOLLOWING.replace(",2,", ",inf,"), "stratum 'inf' is no number"),
        ("\0" * 100_000, "no tracking report"),
    ],
)
def test_what_is_no_report(text: str, complaint: str) -> None:
    with pytest.raises(ValueError, match="chronyc") as caught:
        parse_tracking(text)
    assert complaint in str(caught.value)
    assert len(str(caught.value)) < 200


@pytest.mark.peer
@pytest.mark.realtime
def test_a_real_chronyd(tmp_path: Path) -> None:
    chronyc = str(requires("chronyc"))
    (ntp,) = free_ports(1)
    serving = ("local stratum 1", "allow 127.0.0.1", "bindaddress 127.0.0.1")
    following = f"server 127.0.0.1 port {ntp} iburst minpoll -4 maxpoll -4"
    with chronyd(tmp_path, *serving, ntp_port=ntp) as first, chronyd(tmp_path, following) as second:
        local = until(lambda patience: ask_chrony(chronyc, Chronyd(port=first), patience), lambda clock: True)
        assert local.local
        assert local.bound_ns is None
        clock = until(lambda patience: ask_chrony(chronyc, Chronyd(port=second), patience), settled)
    assert (clock.name, clock.stratum) == ("127.0.0.1", 2)
    assert clock.bound_ns
    with pytest.raises(NoAnswer, match="does not run"):
        ask_chrony(chronyc, Chronyd(port=second), Patience(5))


@pytest.mark.peer
@pytest.mark.realtime
def test_a_chronyd_that_has_no_source(tmp_path: Path) -> None:
    with chronyd(tmp_path) as port:
        chronyc = str(requires("chronyc"))
        clock = until(lambda patience: ask_chrony(chronyc, Chronyd(port=port), patience), lambda clock: True)
    assert clock.leap_status == "Not synchronised"
    assert clock.bound_ns is None


@pytest.mark.peer
@pytest.mark.realtime
def test_a_daemon_that_does_not_answer(tmp_path: Path) -> None:
    """Something holds the port and says nothing: chronyc itself gives up after some seconds, we do before."""
    (port,) = free_ports(1)
    script = (
        f"import socket, time; s = socket.socket(type=socket.SOCK_DGRAM); s.bind(('127.0.0.1', {port})); time.sleep(60)"
    )
    with (
        running(["python3", "-c", script], tmp_path / "log"),
        pytest.raises(NoAnswer, match=r"does not answer in time|does not run"),
    ):
        ask_chrony(str(requires("chronyc")), Chronyd(port=port), Patience(0.5))
