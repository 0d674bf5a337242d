"""A folder like that of an IIO device, with a DAC and an ADC that sees its output."""

from __future__ import annotations

from pathlib import Path

SCALE_MV = 20_000 / 65536
"""16 bits over ±10 V."""


def iio_device(folder: Path, **files: str) -> Path:
    """``iio:device0`` whose input channel 0 is its output channel 0; ``files`` are changed, or left out where ""."""
    device = folder / "iio:device0"
    device.mkdir(parents=True)
    contents = {
        "name": "dac",
        "out_voltage0_raw": "0",
        "out_voltage0_raw_available": "[0 1 65535]",
        "out_voltage_scale": f"{SCALE_MV:.9f}",
        "out_voltage_offset": "-32768",
        "in_voltage_scale": f"{SCALE_MV:.9f}",
        "in_voltage_offset": "-32768",
    }
    for name, content in (contents | files).items():
        if content:
            (device / name).write_text(content + "\n")
    if "in_voltage0_raw" not in files:
        (device / "in_voltage0_raw").symlink_to("out_voltage0_raw")
    return device


def counts(device: Path, channel: int = 0) -> int:
    """What has been written to the DAC; the fake is a plain file, read again where a write to it is seen half done."""
    while not (text := (device / f"out_voltage{channel}_raw").read_text()).strip():
        pass
    return int(text)


def volts(device: Path, channel: int = 0) -> float:
    """What the DAC drives."""
    return (counts(device, channel) - 32768) * SCALE_MV / 1000
