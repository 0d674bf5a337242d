"""Status of the line: the datagram, who may tell, and a device on Modbus."""

from __future__ import annotations

import math
import struct
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.modbus_device import modbus_device, wait_for

from dcon.core.values import Pdci
from dcon.drivers.line_status import SILENCE_NS, SIZE, LineOnModbus, StatusInbox, decode, encode
from dcon.drivers.modbus import BusError, to_registers
from dcon.places import ModbusLine, StatusRegisters

UTC_NS = 1_704_067_200_000_000_000
LINE = Pdci(UTC_NS, 2000.5, True, False, 1990.0)
lines = st.builds(
    Pdci,
    st.integers(0, 2**63 - 1),
    st.floats(allow_nan=False),
    st.booleans(),
    st.booleans(),
    st.floats(allow_nan=False),
)


def test_the_bytes_are_those_that_are_documented() -> None:
    body = struct.pack(">4sIqdddI", b"DCP1", 9, UTC_NS, 2000.5, 1990.0, 0.0, 1)
    assert encode(9, LINE) == body + struct.pack(">I", zlib.crc32(body))
    assert len(encode(9, LINE)) == SIZE == 48
    both = struct.pack(">4sIqdddI", b"DCP1", 0, 5, -1.0, math.nan, 0.0, 3)
    status = decode(both + struct.pack(">I", zlib.crc32(both)))
    assert status is not None and status.line[:4] == (5, -1.0, True, True) and math.isnan(status.line.scheduled_mw)


@given(lines, st.integers(0, 2**32 - 1))
def test_what_is_encoded_is_decoded(line: Pdci, sequence: int) -> None:
    assert decode(encode(sequence, line)) == (sequence, line)


@given(lines, st.integers(0, 8 * SIZE - 1))
def test_no_flipped_bit_is_a_status(line: Pdci, bit: int) -> None:
    datagram = bytearray(encode(1, line))
    datagram[bit // 8] ^= 1 << bit % 8
    assert decode(bytes(datagram)) is None


@given(st.binary(max_size=100))
def test_no_other_bytes_are_a_status(data: bytes) -> None:
    assert decode(data) is None


def test_the_newest_that_is_believable_counts() -> None:
    inbox = StatusInbox()
    nonsense = [
        b"",
        b"x" * SIZE,
        encode(6, LINE._replace(power_mw=math.nan)),
        encode(6, LINE._replace(scheduled_mw=math.inf)),
        encode(7, LINE._replace(time_ns=UTC_NS + 2_000_000_000)),
    ]
    assert inbox.take([encode(4, LINE), encode(5, LINE._replace(power_mw=1.0))], 0, UTC_NS) == LINE._replace(
        power_mw=1.0
    )
    assert inbox.take([*nonsense, encode(5, LINE), encode(3, LINE)], 1, UTC_NS) is None
    assert inbox.refused == {"malformed": 2, "not a number": 2, "from the future": 1, "old": 2}
    assert inbox.taken == 2


def test_after_a_silence_who_tells_begins_anew() -> None:
    inbox = StatusInbox()
    assert inbox.take([encode(1000, LINE)], 0, UTC_NS) == LINE
    assert inbox.take([encode(0, LINE)], SILENCE_NS, UTC_NS) is None
    assert inbox.take([encode(0, LINE)], SILENCE_NS + 1, UTC_NS) == LINE


def test_an_old_status_is_passed_on_as_what_it_is() -> None:
    """How old a status may be is for the controller to judge, by its time."""
    old = LINE._replace(time_ns=UTC_NS - 60_000_000_000)
    assert StatusInbox().take([encode(1, old)], 0, UTC_NS) == old


@pytest.mark.realtime
@pytest.mark.parametrize(("kind", "scale"), [("float32", 1.0), ("int16", 10.0)])
def test_a_device_is_asked(kind: str, scale: float) -> None:
    with modbus_device() as device:
        for at, value in ((0, -2000.5), (2, -1990.0)):
            words = to_registers(kind, value * scale)
            device.registers[at : at + len(words)] = words
        device.registers[4] = 0xFFFC | 1
        keys = StatusRegisters(scheduled=2, type=kind, scale=scale, period_ms=20.0, timeout_ms=200.0)
        line = LineOnModbus(ModbusLine("127.0.0.1", device.port, keys))
        try:
            wait_for(lambda: line.newest)
            assert line.newest is not None and line.newest[1:] == (-2000.5, True, False, -1990.0)
            device.registers[4] = 2
            wait_for(lambda: line.newest is not None and line.newest[2:4] == (False, True))
            device.stop()
            wait_for(lambda: line.failed)
            last = line.newest.time_ns
            wait_for(lambda: line.failed > 2)
            assert line.newest.time_ns == last, "it grows old"
            assert "no connection" in line.trouble or "closed" in line.trouble
        finally:
            line.close()


@pytest.mark.realtime
def test_a_device_whose_counter_stands_still_tells_nothing_new() -> None:
    with modbus_device() as device:
        keys = StatusRegisters(counter=6, period_ms=10_000.0, timeout_ms=200.0)
        line = LineOnModbus(ModbusLine("127.0.0.1", device.port, keys))
        try:
            wait_for(lambda: line.newest)
            assert line.ask(1) is None
            device.registers[6] += 1
            found = line.ask(2)
            assert found is not None and found.time_ns == 2 and math.isnan(found.scheduled_mw)
            device.registers[6] += 1
            device.registers[0:2] = [0x7FC0, 0]
            with pytest.raises(BusError, match="register 0: nan MW is not a number"):
                line.ask(3)
        finally:
            line.close()
