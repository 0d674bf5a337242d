"""The IIO driver on folders like the kernel's: units, ranges, and whatever may go wrong with the files."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.iio import SCALE_MV, counts, iio_device

from dcon.drivers.iio import Channel, IioDriver
from dcon.places import IioKeys, IioPlace
from pmutools.errors import PmuError, SettingsError, SourceError

BUS_ERROR = Path("/proc/self/mem")
"""Reading or writing its beginning is EIO, whoever does it; /dev/full is ENOSPC."""


def driver(device: Path, **keys: object) -> IioDriver:
    return IioDriver(IioPlace(str(device), IioKeys(**{"readback": 0, **keys})))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("output_v", "expected"),
    [
        (0.0, 32768),
        (5.0, 49152),
        (-10.0, 0),
        (10.0, 65535),
        (9.9999, 65535),
        (11.0, 65535),
        (-1e300, 0),
        (math.nan, 32768),
        (math.inf, 32768),
        (SCALE_MV / 1e3, 32769),
    ],
)
def test_volts_become_counts_within_the_range(output_v: float, expected: int, tmp_path: Path) -> None:
    device = iio_device(tmp_path)
    output = driver(device)
    output.drive(1, output_v)
    assert counts(device) == expected
    assert (output.failed, output.trouble) == (0, "")


def test_what_is_read_back_is_volts(tmp_path: Path) -> None:
    output = driver(iio_device(tmp_path))
    assert output.reads_back and output.readback() is None, "nothing has been driven"
    for number, volts in enumerate((0.0, 7.25, -9.5), 1):
        output.drive(number, volts)
        found = output.readback()
        assert found is not None and found.number == number
        assert found.output_v == pytest.approx(volts, abs=SCALE_MV / 1e3)


def test_an_adc_of_its_own_with_other_units(tmp_path: Path) -> None:
    """12 bits over ±12 V; the scale and offset of the channel go before those of all channels."""
    device = iio_device(tmp_path)
    adc = tmp_path / "iio:device1"
    adc.mkdir()
    for name, content in {
        "in_voltage5_raw": "3072",
        "in_voltage5_scale": "5.859375",
        "in_voltage_scale": "1",
        "in_voltage5_offset": "-2048.0",
    }.items():
        (adc / name).write_text(content)
    output = driver(device, readback=5, adc=str(adc))
    output.drive(1, 6.0)
    found = output.readback()
    assert found is not None and found.output_v == pytest.approx(6.0)


def test_without_an_adc_nothing_is_read_back(tmp_path: Path) -> None:
    output = driver(iio_device(tmp_path, in_voltage_scale="", in_voltage0_raw=""), readback=None)
    output.drive(1, 1.0)
    assert not output.reads_back and output.readback() is None


@given(st.floats(1e-3, 10), st.integers(-70000, 70000), st.integers(-70000, 70000))
def test_counts_and_volts_are_inverse(scale_mv: float, offset: int, raw: int) -> None:
    dac = Channel(scale_mv, offset)
    assert dac.counts(dac.volts(raw)) == raw


@pytest.mark.parametrize(
    ("files", "keys", "expected"),
    [
        ({"out_voltage0_raw_available": ""}, {"bits": 16}, 65535),
        ({"out_voltage0_raw_available": "", "out_voltage_raw_available": "[0 1 65535]"}, {}, 65535),
        ({"out_voltage0_raw_available": " ".join(map(str, range(0, 65536, 13107)))}, {}, 65535),
        ({"out_voltage0_raw_available": "[-32768 1 32767]", "out_voltage_offset": ""}, {}, 32767),
        ({"out_voltage0_raw_available": "[0 1 65535]", "out_voltage0_powerdown": "0"}, {}, 65535),
    ],
)
def test_where_the_range_of_counts_comes_from(
    files: dict[str, str], keys: dict[str, object], expected: int, tmp_path: Path
) -> None:
    device = iio_device(tmp_path, **files)
    driver(device, **keys).drive(1, 10.0)
    assert counts(device) == expected


@pytest.mark.parametrize(
    ("files", "keys", "error", "message"),
    [
        (
            {"out_voltage_scale": f"{SCALE_MV / 1e3}"},
            {},
            SourceError,
            r"reaches -0.01 to 0.00999969 V; ±10 V are needed",
        ),
        ({"out_voltage_scale": f"{SCALE_MV / 2}"}, {}, SourceError, r"reaches -5 to 4.99985 V"),
        ({"out_voltage_offset": "0"}, {}, SourceError, r"reaches 0 to 19.9997 V; ±10 V are needed"),
        ({"out_voltage_scale": f"{SCALE_MV * 1000}"}, {}, SourceError, "its scale must be in mV a count"),
        ({"out_voltage_scale": "-0.3"}, {}, SourceError, "-0.3 mV a count is no scale"),
        ({"out_voltage_scale": "0"}, {}, SourceError, "0 mV a count is no scale"),
        ({"out_voltage_scale": "nan"}, {}, SourceError, "'nan' is no number"),
        ({"out_voltage_scale": "a lot"}, {}, SourceError, "'a lot' is no number"),
        ({"out_voltage_scale": ""}, {}, SourceError, r"tells no scale \(no out_voltage0_scale\)"),
        ({"out_voltage_offset": "x"}, {}, SourceError, "out_voltage_offset: 'x' is no number"),
        ({"out_voltage0_raw_available": ""}, {}, SettingsError, r"add bits= \(16 of most\)"),
        ({"out_voltage0_raw_available": ""}, {"bits": 12}, SourceError, "reaches -10 to -8.75031 V"),
        ({"out_voltage0_raw_available": "[0 1]"}, {}, SourceError, "is no range of counts"),
        ({"out_voltage0_raw_available": "0 to 9"}, {}, SourceError, "is no range of counts"),
        ({"out_voltage0_powerdown": "1"}, {}, SourceError, "powered down; write 0 to out_voltage0_powerdown first"),
        ({"in_voltage0_raw": ""}, {}, SourceError, "in_voltage0_raw: no such channel; there are none"),
        ({}, {"channel": 3}, SourceError, "out_voltage3_raw: no such channel; there are out_voltage0_raw"),
        ({}, {"adc": "/nowhere/adc"}, SourceError, "/nowhere/adc: no such device; see ls"),
    ],
)
def test_what_cannot_be_an_output_is_refused_at_once(
    files: dict[str, str], keys: dict[str, object], error: type[PmuError], message: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=message) as caught:
        driver(iio_device(tmp_path, **files), **keys)
    assert "\n" not in str(caught.value)


def test_a_device_that_is_not_there() -> None:
    with pytest.raises(SourceError, match="no such device; see ls -d /sys/bus/iio/devices"):
        driver(Path("/sys/bus/iio/devices/iio:device99"))


@pytest.mark.parametrize(
    ("becomes", "reason"),
    [
        (None, "No such file or directory"),
        (BUS_ERROR, "Input/output error"),
        (Path("/dev/full"), "No space left on device"),
        (Path("/"), "Is a directory"),
    ],
)
def test_a_write_that_fails_is_counted_and_told_and_may_work_again(
    becomes: Path | None, reason: str, tmp_path: Path
) -> None:
    device = iio_device(tmp_path)
    output = driver(device, readback=None)
    output.drive(1, 1.0)
    raw = device / "out_voltage0_raw"
    raw.unlink()
    if becomes is not None:
        raw.symlink_to(becomes)
    for k in range(3):
        output.drive(2 + k, 2.0)
    assert (output.driven, output.failed) == (4, 3)
    assert output.trouble == f"{raw}: {reason}"
    raw.unlink(missing_ok=True)
    raw.write_text("0")
    output.drive(9, 2.0)
    assert output.trouble == "" and counts(device) == 39322


@pytest.mark.parametrize(
    ("becomes", "reason"), [(None, "No such file"), (BUS_ERROR, "Input/output error"), ("text", "'text' is no number")]
)
def test_a_readback_that_fails_is_none(becomes: Path | str | None, reason: str, tmp_path: Path) -> None:
    device = iio_device(tmp_path)
    output = driver(device)
    output.drive(1, 1.0)
    raw = device / "in_voltage0_raw"
    raw.unlink()
    if isinstance(becomes, Path):
        raw.symlink_to(becomes)
    elif becomes is not None:
        raw.write_text(becomes)
    assert output.readback() is None
    assert output.failed == 1 and reason in output.trouble
    raw.unlink(missing_ok=True)
    raw.write_text("32768")
    found = output.readback()
    assert found is not None and found.output_v == 0.0 and output.trouble == ""


def test_a_dac_that_does_not_follow_reads_back_otherwise(tmp_path: Path) -> None:
    """A write that fails does not hide what is really put out."""
    device = iio_device(tmp_path)
    output = driver(device)
    output.drive(1, 5.0)
    (device / "in_voltage0_raw").unlink()
    (device / "in_voltage0_raw").write_text("49152")
    (device / "out_voltage0_raw").unlink()
    output.drive(2, -5.0)
    found = output.readback()
    assert found is not None and (found.number, found.output_v) == (2, pytest.approx(5.0, abs=1e-3))
    assert "out_voltage0_raw" in output.trouble


def test_closing_leaves_0_v(tmp_path: Path) -> None:
    device = iio_device(tmp_path)
    output = driver(device)
    output.drive(1, 8.0)
    output.close()
    assert counts(device) == 32768
