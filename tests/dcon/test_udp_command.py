"""The command datagram, and the driver that sends it whatever the network does."""

from __future__ import annotations

import socket
import struct
import zlib
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcon.drivers.driver import Driver
from dcon.drivers.udp_command import UdpCommandDriver
from dcon.limiter import MW_PER_V
from dcon.link.command import SIZE, CommandOut, decode, encode
from dcon.places import IioPlace
from pmutools.errors import SettingsError
from pmutools.net.endpoint import parse_endpoint

LAYOUT = ">4sIqddI"
commands = st.builds(
    CommandOut,
    st.integers(0, 2**32 - 1),
    st.integers(-(2**63), 2**63 - 1),
    st.floats(allow_nan=False),
    st.floats(allow_nan=False),
    st.integers(0, 2**32 - 1),
)


def test_the_bytes_are_those_that_are_documented() -> None:
    body = struct.pack(LAYOUT, b"DCN1", 7, 1_704_067_200_000_000_000, 62.5, 5.0, 3)
    expected = body + struct.pack(">I", zlib.crc32(body))
    assert encode(CommandOut(7, 1_704_067_200_000_000_000, 62.5, 5.0, 3)) == expected
    assert len(expected) == SIZE == 40


@given(commands)
def test_what_is_encoded_is_decoded(command: CommandOut) -> None:
    assert decode(encode(command)) == command


@given(commands, st.integers(0, 8 * SIZE - 1))
def test_no_flipped_bit_is_a_command(command: CommandOut, bit: int) -> None:
    datagram = bytearray(encode(command))
    datagram[bit // 8] ^= 1 << bit % 8
    assert decode(bytes(datagram)) is None


@given(st.binary(max_size=64))
def test_no_other_bytes_are_a_command(data: bytes) -> None:
    assert decode(data) is None
    assert decode(b"DCN1" + data) is None


def test_sequence_and_flags_wrap() -> None:
    assert decode(encode(CommandOut(2**32 + 5, 0, 0.0, 0.0, 2**40 + 1))) == CommandOut(5, 0, 0.0, 0.0, 1)


@pytest.fixture
def receiver() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        sock.settimeout(5)
        yield sock


def driver_to(port: int) -> UdpCommandDriver:
    return UdpCommandDriver(parse_endpoint(f"udp://127.0.0.1:{port}"))


@pytest.mark.realtime
def test_commands_leave_in_sequence(receiver: socket.socket) -> None:
    driver = driver_to(receiver.getsockname()[1])
    for k in range(5):
        driver.send(k, -k / 2)
    driver.close()
    got = [decode(receiver.recv(100)) for _ in range(5)]
    assert got == [CommandOut(k, k, -k / 2 * MW_PER_V, -k / 2) for k in range(5)]
    assert driver.failed == 0


@pytest.mark.realtime
@pytest.mark.parametrize("unheard", [9, 10])
def test_a_receiver_that_comes_late_misses_no_more_than_its_absence(unheard: int) -> None:
    """An ICMP error to one command must not swallow the next: the last may be the 0 V that ends a session."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        port = sock.getsockname()[1]
    driver = driver_to(port)
    for k in range(unheard):
        driver.send(k, 1.0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", port))
        sock.settimeout(5)
        driver.send(unheard, 0.0)
        assert decode(sock.recv(100)) == CommandOut(unheard, unheard, 0.0, 0.0)
    driver.close()
    driver.send(11, 0.0)  # even on a closed socket nothing is raised
    assert driver.failed >= 1


@pytest.mark.realtime
def test_it_is_a_driver_that_reads_nothing_back_and_leaves_0_v(receiver: socket.socket) -> None:
    driver: Driver = driver_to(receiver.getsockname()[1])
    driver.drive(1, 4.0)
    driver.drive(2, -4.0, 3)
    driver.close()
    got = [decode(receiver.recv(100)) for _ in range(3)]
    assert [(command.sequence, command.output_v, command.flags) for command in got if command] == [
        *((0, 4.0, 0), (1, -4.0, 3), (2, 0.0, 0))
    ]
    assert driver.readback() is None and not driver.reads_back and driver.trouble == ""
    assert driver.driven >= 2


def test_what_needs_a_process_of_its_own_is_not_driven_from_the_loop() -> None:
    with pytest.raises(SettingsError, match=r"^\[output\] iio:///x\?\S+: driven by a process of its own, dcon output"):
        UdpCommandDriver(IioPlace("/x"))
