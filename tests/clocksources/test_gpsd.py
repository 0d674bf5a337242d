"""gpsd: its reports, as text and from a real gpsd that its own gpsfake feeds."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.clock_programs import gpsd_of, receiver, until
from support.live import free_ports

from pmutools.clocksources.asking import NoAnswer, Patience
from pmutools.clocksources.gpsd import LINE_BYTES, Gpsd, GpsReports, ask_gpsd
from pmutools.timebase import NS

# gpsd 3.22 (Debian 12), as it wrote them
VERSION = '{"class":"VERSION","release":"3.22","rev":"3.22","proto_major":3,"proto_minor":14}'
DEVICES = (
    '{"class":"DEVICES","devices":[{"class":"DEVICE","path":"/dev/ttyS0","driver":"NMEA0183",'
    '"activated":"2026-11-28T03:27:36.083Z","flags":1}]}'
)
SKY = (
    '{"class":"SKY","device":"/dev/ttyS0","xdop":0.79,"nSat":1,"uSat":1,"satellites":[{"PRN":4,"el":77.0,"used":true}]}'
)
TPV = (
    '{"class":"TPV","device":"/dev/ttyS0","mode":3,"time":"2026-11-28T03:27:40.000Z","ept":0.005,'
    '"lat":48.117300000,"lon":11.516666667,"altHAE":592.3000}'
)
TOFF = (
    '{"class":"TOFF","device":"/dev/ttyS0","real_sec":1795836461, "real_nsec":0,"clock_sec":1795836461,'
    '"clock_nsec":335109048}'
)
# as its documentation has it
PPS = (
    '{"class":"PPS","device":"/dev/ttyS0","real_sec":1795836461,"real_nsec":0,"clock_sec":1795836460,'
    '"clock_nsec":999999300,"precision":-20,"shm":"NTP2"}'
)
OLD_PPS = '{"class":"PPS","device":"/dev/ttyS0","real_sec":100,"real_musec":0,"clock_sec":100,"clock_musec":25}'


def heard(*lines: str) -> GpsReports:
    reports = GpsReports()
    reports.feed(("\r\n".join(lines) + "\r\n").encode())
    return reports


def test_what_it_says() -> None:
    reports = heard(VERSION, DEVICES, SKY, TPV, TOFF)
    clock = reports.clock()
    assert (clock.mode, clock.fix, clock.time_error_s, clock.pps) == (3, True, 0.005, False)
    assert clock.serial_offset_ns == 335_109_048
    assert clock.bound_ns is None, "without a pulse nobody has compared the clock with the receiver's time"
    assert (reports.release, reports.devices, reports.unreadable, reports.complete) == ("3.22", 1, 0, False)
    assert heard(VERSION, TPV, TPV).complete, "a second has gone by without a pulse"
    assert clock.satellites == 1
    assert heard(VERSION, SKY.replace('"uSat":1,', ""), TPV).clock().satellites == 1
    assert heard(VERSION, '{"class":"SKY","hdop":1.0}', TPV).clock().satellites is None


def test_a_pulse_is_a_bound() -> None:
    reports = heard(VERSION, DEVICES, PPS, TPV)
    clock = reports.clock()
    assert reports.complete
    assert (clock.clock_offset_ns, clock.precision_ns, clock.bound_ns) == (-700, 954, 1654)
    assert heard(VERSION, OLD_PPS, TPV).clock().clock_offset_ns == 25_000
    assert heard(VERSION, PPS, TPV.replace('"mode":3', '"mode":1')).clock().bound_ns is None, "no fix: any second"


def test_of_several_receivers_the_one_with_a_fix() -> None:
    other = TPV.replace("ttyS0", "ttyS1").replace('"mode":3', '"mode":1').replace("0.005", "9.0")
    assert heard(VERSION, TPV, other).clock().time_error_s == 0.005
    many = [TPV.replace("ttyS0", f"tty{number}") for number in range(1000)]
    assert len(heard(VERSION, *many)._fixes) == 16


@pytest.mark.parametrize(
    "line",
    [
        "",
        "{",
        "null",
        "[1,2]",
        '"TPV"',
        '{"class":"TPV","mode":"x"}',
        '{"class":"TPV","mode":1e999}',
        '{"class":"TPV","mode":3,"ept":"bad"}',
        '{"class":"PPS"}',
        '{"class":"PPS","real_sec":null,"clock_sec":1}',
        '{"class":"PPS","real_sec":1,"real_nsec":0,"clock_sec":1,"clock_nsec":0,"precision":99999}',
        '{"class":"DEVICES","devices":3}',
        '{"class":"SKY","satellites":[1,2]}',
        '{"class":"SKY","uSat":"many"}',
        '{"class":["TPV"]}',
        "[" * 10_000,
        "<html>",
        "\ud7ff\0",
    ],
)
def test_nonsense_is_counted(line: str) -> None:
    reports = heard(VERSION, line, TPV)
    assert reports.unreadable <= 1
    assert reports.clock().mode == 3


@given(st.lists(st.binary(max_size=40), max_size=30))
def test_any_bytes_in_any_pieces(pieces: list[bytes]) -> None:
    reports = GpsReports()
    for piece in pieces:
        reports.feed(piece)
    assert len(reports._rest) <= LINE_BYTES


def test_byte_by_byte_is_the_same_as_whole() -> None:
    text = "\n".join((VERSION, DEVICES, SKY, TPV, TOFF, PPS, "")).encode()
    reports, whole = GpsReports(), GpsReports()
    for octet in text:
        reports.feed(bytes([octet]))
    whole.feed(text)
    assert reports.clock() == whole.clock()


def test_a_line_without_end_is_not_kept() -> None:
    reports = GpsReports()
    for _ in range(100):
        reports.feed(b"x" * 10_000)
    assert len(reports._rest) <= LINE_BYTES
    reports.feed(b"\n" + VERSION.encode() + b"\n" + TPV.encode() + b"\n")
    assert reports.clock().mode == 3


@contextmanager
def serving(answer: bytes, *, close: bool = False) -> Iterator[Gpsd]:
    """Someone who says ``answer`` to whom connects."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        done = threading.Event()

        def serve() -> None:
            connection, _ = server.accept()
            with connection:
                connection.sendall(answer)
                if not close:
                    done.wait(10)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        try:
            yield Gpsd("127.0.0.1", server.getsockname()[1])
        finally:
            done.set()
            thread.join(5)


def test_who_is_not_gpsd() -> None:
    for answer in (b"220 mail.example.org ESMTP\r\n", b"\0" * 1000):
        with serving(answer, close=True) as place, pytest.raises(NoAnswer, match="is not gpsd"):
            ask_gpsd(place, Patience(2))
    with serving(b"", close=True) as place, pytest.raises(NoAnswer, match="says nothing"):
        ask_gpsd(place, Patience(2))
    with pytest.raises(NoAnswer, match=r"no gpsd at 127.0.0.1:.*nobody listens"):
        ask_gpsd(Gpsd(port=free_ports(1)[0]), Patience(2))


@pytest.mark.realtime
def test_who_says_nothing_costs_no_more_than_the_time_given() -> None:
    with serving(b"") as place:
        began = time.monotonic()
        with pytest.raises(NoAnswer, match=r"^gpsd says nothing; does it hang\?$"):
            ask_gpsd(place, Patience(0.3))
        assert time.monotonic() - began < 2


def test_a_gpsd_without_a_receiver_is_known_at_once() -> None:
    answer = f'{VERSION}\r\n{{"class":"DEVICES","devices":[]}}\r\n'.encode()
    with serving(answer) as place, pytest.raises(NoAnswer, match="gpsd has no receiver"):
        ask_gpsd(place, Patience(60))


def test_a_receiver_that_sleeps_has_no_fix() -> None:
    with serving(f"{VERSION}\r\n{DEVICES}\r\n".encode(), close=True) as place:
        assert ask_gpsd(place, Patience(2)).mode == 0


def test_a_pulse_by_the_wire() -> None:
    with serving(f"{VERSION}\r\n{DEVICES}\r\n{TPV}\r\n{PPS}\r\n".encode()) as place:
        assert ask_gpsd(place, Patience(60)).bound_ns == 1654


@pytest.mark.peer
@pytest.mark.realtime
def test_a_real_gpsd(tmp_path: Path) -> None:
    """A receiver whose time is an hour old, as that of a recording is."""
    with gpsd_of(receiver(time.time() - 3600, 40), tmp_path) as port:
        place = Gpsd(port=port)
        clock = until(
            lambda patience: ask_gpsd(place, patience), lambda clock: clock.mode == 3 and clock.time_error_s is not None
        )
        assert clock.time_error_s == pytest.approx(0.005)
        clock = until(lambda patience: ask_gpsd(place, patience), lambda clock: clock.serial_offset_ns is not None)
        assert clock.serial_offset_ns == pytest.approx(3600 * NS, abs=60 * NS)
        assert (clock.pps, clock.bound_ns) == (False, None)


@pytest.mark.peer
@pytest.mark.realtime
def test_a_real_gpsd_whose_receiver_sees_no_sky(tmp_path: Path) -> None:
    with gpsd_of(receiver(time.time(), 40, fix=False), tmp_path) as port:
        clock = until(lambda patience: ask_gpsd(Gpsd(port=port), patience.at_most(1)), lambda clock: clock.mode == 1)
    assert not clock.fix


def test_the_texts_are_json() -> None:
    for line in (VERSION, DEVICES, SKY, TPV, TOFF, PPS, OLD_PPS):
        json.loads(line)
