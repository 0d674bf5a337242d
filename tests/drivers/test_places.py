"""URLs of outputs and of the line's status: what they mean, and every mistake says what to write."""

from __future__ import annotations

import pytest

from dcon.places import IioPlace, ModbusLine, ModbusPlace, destination, line_source


def test_what_urls_mean() -> None:
    iio = destination("iio:///sys/bus/iio/devices/iio:device0?channel=1&readback=3&adc=/sys/x&bits=16&settle_ms=0.5")
    assert isinstance(iio, IioPlace) and iio.folder == "/sys/bus/iio/devices/iio:device0"
    assert (iio.keys.channel, iio.keys.readback, iio.keys.adc, iio.keys.bits) == (1, 3, "/sys/x", 16)
    assert str(iio) == ("iio:///sys/bus/iio/devices/iio:device0?channel=1&readback=3&adc=/sys/x&bits=16&settle_ms=0.5")
    modbus = destination("modbus://192.0.2.7?unit=3&register=9&type=float32&readback=20")
    assert isinstance(modbus, ModbusPlace) and (modbus.host, modbus.port) == ("192.0.2.7", 502)
    assert (modbus.keys.unit, modbus.keys.register, modbus.keys.readback, modbus.keys.counts_per_v) == (3, 9, 20, 1.0)
    assert str(destination("modbus://[::1]:1502")) == (
        "modbus://[::1]:1502?unit=1&register=0&type=int16&timeout_ms=200"
    )
    line = line_source("modbus://192.0.2.7:1502?power=2&scheduled=6&status=8&counter=9")
    assert isinstance(line, ModbusLine) and (line.keys.power, line.keys.scheduled, line.keys.counter) == (2, 6, 9)
    assert (
        str(destination("udp://192.0.2.7:4790")) == str(line_source("udp://192.0.2.7:4790")) == "udp://192.0.2.7:4790"
    )


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("tcp://h:1", "commands leave as udp://HOST:PORT, iio://FOLDER or modbus://HOST:PORT"),
        ("iio://sys/bus", "write three slashes and the device's folder: iio:///sys/bus/iio/devices/iio:device0"),
        ("iio:///x?chanel=1", "iio:///x? has no 'chanel'; did you mean 'channel'?"),
        ("iio:///x?channel=-1", "channel: -1 is out of range"),
        ("iio:///x?channel=1&channel=2", "a key is given twice"),
        ("iio:///x?adc=here", "'here' is no absolute path"),
        ("iio:///x?bits=", "'' is not a whole number"),
        ("modbus://", "only modbus://HOST:PORT?key=value is understood"),
        ("modbus://user@h", "only modbus://HOST:PORT?key=value is understood"),
        ("modbus://plc..local", "'plc..local' can be no host's name"),
        (f"modbus://{64 * 'x'}.local", "can be no host's name"),
        ("modbus://h/1", "only modbus://HOST:PORT?key=value is understood"),
        ("modbus://h:99999", "port out of range"),
        ("modbus://h?type=int32", "'int32' is not one of int16, float32"),
        ("modbus://h?scale=3277", "scale=3277 takes 10 V beyond 32767"),
        ("modbus://h?scale=0", "scale: 0 is out of range"),
        ("modbus://h?timeout_ms=1000", "timeout_ms: 1000 is out of range; it must be 10 to 900"),
        ("modbus://h?power=3", "has no 'power'"),
    ],
)
def test_mistakes_in_an_output(url: str, message: str) -> None:
    with pytest.raises(ValueError, match=r"^[^\n]+$") as caught:
        destination(url)
    assert message in str(caught.value)


@pytest.mark.parametrize("url", ["iio:///x", "tcp://h:1", "udp://h:0", "modbus://h?register=3", "modbus://h:1:2"])
def test_mistakes_in_a_source_of_status(url: str) -> None:
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        line_source(url)
