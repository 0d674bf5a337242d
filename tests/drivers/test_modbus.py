"""The Modbus driver against pymodbus's own server: numbers, a dead bus, a slow one, and answers that are none."""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.live import free_ports
from support.modbus_device import Device, modbus_device, wait_for
from support.requires import requires_module

from dcon.drivers.line_status import LineOnModbus
from dcon.drivers.modbus import Bus, BusError, from_registers, to_registers
from dcon.drivers.modbus_output import ModbusDriver
from dcon.places import ModbusLine, ModbusPlace, OutputRegisters, StatusRegisters
from pmutools.errors import SettingsError

pytestmark = pytest.mark.realtime


@pytest.fixture(autouse=True)
def _pymodbus() -> None:
    requires_module("pymodbus.simulator")


# --- numbers -----------------------------------------------------------------------------------------------------


def test_numbers_in_registers() -> None:
    assert to_registers("int16", -1.4) == [0xFFFF]
    assert to_registers("int16", 10_000.0) == [10_000]
    assert to_registers("float32", -2.5) == [0xC020, 0]
    assert math.isnan(from_registers("float32", [0x7FC0, 0]))


@given(st.integers(-32768, 32767))
def test_whole_numbers_there_and_back(value: int) -> None:
    assert from_registers("int16", to_registers("int16", float(value))) == value


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_floats_there_and_back(value: float) -> None:
    words = to_registers("float32", value)
    assert from_registers("float32", words) == value
    assert struct.pack(">HH", *words) == struct.pack(">f", value)


@pytest.mark.parametrize(
    ("kind", "value"), [("int16", 32768.0), ("int16", math.nan), ("float32", 1e39), ("float32", math.inf)]
)
def test_what_does_not_fit_is_refused(kind: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"is no {kind}"):
        to_registers(kind, value)


# --- one question ------------------------------------------------------------------------------------------------


def test_every_failure_has_a_reason_and_ends_in_time() -> None:
    from pymodbus.constants import ExcCodes

    with modbus_device() as device:
        bus = Bus("127.0.0.1", device.port, 1, 0.2)
        bus.write(3, [1, 2])
        assert bus.words(3, 2) == [1, 2]
        for ask, reason in (
            (lambda: bus.words(99, 2), "register 99: exception 2, illegal data address"),
            (lambda: bus.write(500, [1]), "register 500: exception 2, illegal data address"),
            (lambda: Bus("127.0.0.1", device.port, 9, 0.2).words(3, 1), "exception 4, device failure"),
        ):
            with pytest.raises(BusError, match=reason):
                ask()
        device.refuse = ExcCodes.DEVICE_BUSY
        with pytest.raises(BusError, match="exception 6, device busy"):
            bus.words(3, 1)
        device.refuse, device.slow_s = None, 0.5
        began = time.monotonic()
        with pytest.raises(BusError, match="no answer in time"):
            bus.words(3, 2)
        assert time.monotonic() - began < 0.45
        device.slow_s = 0.0
        assert bus.words(3, 2) == [1, 2], "and not the late answer"
    for reason in ("the device closed the connection", "no connection; is the device on"):
        with pytest.raises(BusError, match=rf"^127.0.0.1:\d+: {reason}"):
            bus.words(3, 1)


@contextlib.contextmanager
def answering(reply: Callable[[bytes], bytes]) -> Iterator[int]:
    """Someone who answers whatever comes with ``reply`` of it; gives the port."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.05)
        done = threading.Event()

        def serve() -> None:
            while not done.is_set():
                with contextlib.suppress(OSError):
                    connection, _ = server.accept()
                    with connection:
                        connection.settimeout(0.05)
                        while not done.is_set():
                            with contextlib.suppress(TimeoutError):
                                if not (asked := connection.recv(1000)):
                                    break
                                connection.sendall(reply(asked))

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        try:
            yield server.getsockname()[1]
        finally:
            done.set()
            thread.join(5)


@pytest.mark.parametrize(
    "reply",
    [
        lambda asked: b"HTTP/1.1 400 Bad Request\r\n\r\n",
        lambda asked: b"\0" * 300,
        lambda asked: asked[:2] + b"\0\0\0\5\1\3\2\0\1",
        lambda asked: b"\x77\x77" + b"\0\0\0\7\1\3\4\0\1\0\2",
        lambda asked: asked[:2] + b"\0\0\0\3\1\3\4",
        lambda asked: asked[:2] + b"\0\0\0\7\2\3\4\0\1\0\2",
        lambda asked: asked[:2] + b"\0\0\0\2\1\x83",
        lambda asked: b"",
    ],
    ids=[
        "http",
        "zeros",
        "too few registers",
        "another's answer",
        "cut off",
        "another unit",
        "half an exception",
        "none",
    ],
)
def test_answers_that_are_none(reply: Callable[[bytes], bytes]) -> None:
    with answering(reply) as port:
        bus = Bus("127.0.0.1", port, 1, 0.1)
        began = time.monotonic()
        with pytest.raises(BusError):
            bus.words(0, 2)
        assert time.monotonic() - began < 1
        bus.close()


def test_without_pymodbus_it_is_one_line_that_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pymodbus.client", None)
    with pytest.raises(
        SettingsError, match=r"^modbus:// needs pymodbus; install it with: pip install '\.\[modbus\]' in a checkout$"
    ):
        ModbusDriver(ModbusPlace("127.0.0.1", 502))


# --- the driver --------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def driving(port: int, **keys: object) -> Iterator[ModbusDriver]:
    driver = ModbusDriver(ModbusPlace("127.0.0.1", port, OutputRegisters(**{"timeout_ms": 100.0, **keys})))  # type: ignore[arg-type]
    try:
        yield driver
    finally:
        driver.close()


def answered(driver: ModbusDriver) -> Callable[[], bool]:
    def done() -> bool:
        found = driver.readback()
        return found is not None and found.number == driver.driven

    return done


@pytest.mark.parametrize(
    ("keys", "at", "registers"),
    [
        ({}, 0, [0xEC78]),
        ({"register": 7, "scale": 3276.0}, 7, [0xC004]),
        ({"register": 4, "type": "float32"}, 4, [0xC0A0, 0]),
        ({"type": "float32", "scale": 12.5}, 0, [0xC27A, 0]),
    ],
)
def test_volts_are_written_and_read_back(keys: dict[str, object], at: int, registers: list[int]) -> None:
    with modbus_device() as device:
        with driving(device.port, **keys) as driver:
            driver.drive(1, -5.0)
            wait_for(answered(driver))
            found = driver.readback()
            assert found is not None and found.output_v == pytest.approx(-5.0, abs=1e-3)
            assert device.registers[at : at + len(registers)] == registers
            assert (driver.failed, driver.trouble) == (0, "")
        assert device.registers[at : at + len(registers)] == [0] * len(registers), "closing leaves 0 V"


def test_what_is_measured_is_in_a_register_of_its_own() -> None:
    with modbus_device() as device, driving(device.port, readback=10) as driver:
        device.registers[10] = 2500
        driver.drive(1, 4.0)
        wait_for(answered(driver))
        found = driver.readback()
        assert found is not None and found.output_v == 2.5 and device.registers[0] == 4000


def test_nothing_leaves_that_is_no_voltage() -> None:
    with modbus_device() as device, driving(device.port) as driver:
        for wanted, register in ((math.nan, 0), (math.inf, 0), (99.0, 10_000), (-99.0, 0xD8F0)):
            driver.drive(1, wanted)
            wait_for(answered(driver))
            assert device.registers[0] == register


def test_driving_never_waits_for_a_slow_device_and_old_commands_are_overtaken() -> None:
    with modbus_device(slow_s=0.03) as device, driving(device.port) as driver:
        began = time.monotonic()
        for k in range(1, 51):
            driver.drive(k, k / 10)
        assert time.monotonic() - began < 0.05
        wait_for(answered(driver))
        assert device.registers[0] == 5000 and len(device.writes) <= 3
        assert driver.overtaken >= 47 and driver.failed == 0


def test_a_device_slower_than_the_time_out_is_a_dead_one() -> None:
    with modbus_device() as device, driving(device.port) as driver:
        driver.drive(1, 1.0)
        wait_for(answered(driver))
        device.slow_s = 0.3
        driver.drive(2, 2.0)
        wait_for(lambda: driver.trouble)
        assert "no answer in time" in driver.trouble and driver.readback() is None
        device.slow_s = 0.0
        driver.drive(3, 3.0)
        wait_for(answered(driver))
        assert driver.trouble == "" and device.registers[0] == 3000


def test_a_device_that_goes_and_comes_back_gets_the_newest_command() -> None:
    with modbus_device() as device, driving(device.port) as driver:
        driver.drive(1, 1.0)
        wait_for(answered(driver))
        device.stop()
        began = time.monotonic()
        driver.drive(2, 2.0)
        assert time.monotonic() - began < 0.05
        wait_for(lambda: driver.failed > 2)
        assert driver.trouble and driver.readback() is None
        driver.drive(3, 3.0)
        again = Device(device.port)
        again.start()
        try:
            wait_for(answered(driver))
            assert again.writes[0] == (0, [3000]) and driver.trouble == ""
        finally:
            again.stop()


def test_an_exception_is_trouble_and_no_readback() -> None:
    from pymodbus.constants import ExcCodes

    with modbus_device() as device, driving(device.port) as driver:
        device.refuse = ExcCodes.DEVICE_FAILURE
        driver.drive(1, 1.0)
        wait_for(lambda: driver.trouble)
        assert "register 0: exception 4, device failure" in driver.trouble and driver.readback() is None


def test_a_readback_register_that_there_is_not() -> None:
    with modbus_device() as device, driving(device.port, readback=200) as driver:
        driver.drive(1, 1.0)
        wait_for(lambda: driver.trouble)
        assert "register 200: exception 2" in driver.trouble
        assert device.registers[0] == 1000, "it was written all the same"
        assert driver.readback() is None


def test_whatever_the_library_raises_is_trouble_and_the_threads_go_on() -> None:
    """A host whose name cannot be one: pymodbus lets the error of its connecting through."""
    with pytest.raises(BusError, match=r"^plc\.\.local:1: "):
        Bus("plc..local", 1, 1, 0.1).words(0, 1)
    driver = ModbusDriver(ModbusPlace("plc..local", 1, OutputRegisters(timeout_ms=50.0)))
    line = LineOnModbus(ModbusLine("plc..local", 1, StatusRegisters(timeout_ms=50.0, period_ms=20.0)))
    driver.drive(1, 1.0)
    wait_for(lambda: driver.failed > 1 and line.failed > 1)
    assert "plc..local:1: " in driver.trouble and "plc..local:1: " in line.trouble
    driver.close()
    line.close()


def test_an_error_in_a_thread_itself_is_trouble_until_it_has_passed() -> None:
    with modbus_device() as device, driving(device.port) as driver:
        right, driver._bus = driver._bus, None  # type: ignore[assignment]
        driver.drive(1, 1.0)
        wait_for(lambda: driver.failed > 1)
        assert "AttributeError" in driver.trouble
        driver._bus = right
        wait_for(answered(driver))
        assert driver.trouble == "" and device.registers[0] == 1000


def test_closing_on_a_dead_bus_ends_soon() -> None:
    driver = ModbusDriver(ModbusPlace("127.0.0.1", free_ports(1)[0], OutputRegisters(timeout_ms=50.0)))
    driver.drive(1, 1.0)
    began = time.monotonic()
    driver.close()
    assert time.monotonic() - began < 2 and driver.trouble
