"""pyc37 as a PDC: ``python pyc37_pdc.py '{"host": ..., "port": ..., "idcode": ..., "frames": N, ...}'``.

Asks for what ``ask`` names, sends start, takes ``frames`` data frames, sends stop. Prints one JSON object for each
message: what pyc37 makes of it, or ``{"type": "undecoded"}``. Ends itself after ``limit_s`` seconds.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import socket
import sys
from typing import Any


class Stream:
    """A socket whose end raises: pyc37 would read an ended connection for ever."""

    def __init__(self, stream: socket.socket) -> None:
        self.sendall, self.close, self._recv = stream.sendall, stream.close, stream.recv

    def recv(self, size: int) -> bytes:
        if not (data := self._recv(size)):
            raise ConnectionError("the PMU closed the connection")
        return data


def main() -> None:
    job = json.loads(sys.argv[1])
    signal.signal(signal.SIGALRM, lambda *_: os.killpg(0, signal.SIGKILL))
    signal.setitimer(signal.ITIMER_REAL, job["limit_s"])
    logging.disable(logging.CRITICAL)
    from pyc37.frame import CommandFrame, ConfigFrame1, ConfigFrame2, DataFrame
    from pyc37.pdc import Pdc

    pdc = Pdc(job["idcode"], job["host"], job["port"])
    pdc.run()
    pdc.pmu_socket.settimeout(job["timeout_s"])
    pdc.pmu_socket = Stream(pdc.pmu_socket)
    received = 0
    try:
        for wanted in job["ask"]:
            pdc.pmu_socket.sendall(CommandFrame(job["idcode"], wanted).convert2bytes())
            message = pdc.get()
            if type(message) is ConfigFrame2:
                pdc.pmu_cfg2 = message
            say(message)
        pdc.start()
        while received < job["frames"]:
            message = pdc.get()
            if message is not None and not isinstance(message, DataFrame | ConfigFrame1):
                continue
            received += not isinstance(message, ConfigFrame1)
            say(message)
        pdc.stop()
    except OSError as error:
        sys.stdout.write(json.dumps({"type": "error", "error": str(error)}) + "\n")
    pdc.quit()


def say(message: Any) -> None:
    sys.stdout.write(json.dumps(described(message)) + "\n")
    sys.stdout.flush()


def described(message: Any) -> dict[str, Any]:
    from pyc37.frame import ConfigFrame1, DataFrame, HeaderFrame

    if message is None:
        return {"type": "undecoded"}
    fracsec, _, _, _, quality = message.get_frasec()
    head = {
        "type": message.get_frame_type(),
        "idcode": message.get_id_code(),
        "soc": message.get_soc(),
        "fracsec": fracsec,
        "msg_tq": quality,
    }
    if isinstance(message, HeaderFrame):
        return head | {"text": message.get_header()}
    if isinstance(message, ConfigFrame1):
        return head | described_config(message)
    if isinstance(message, DataFrame):
        return head | {"stations": described_stations(message)}
    return head


def described_config(config: Any) -> dict[str, Any]:
    several = config.is_multistreaming()
    keys = {
        "name": config.get_station_name(),
        "idcode": config.get_stream_id_code(),
        "format": config._data_format,
        "channels": config.get_channel_names(),
        "fnom_hz": config.get_fnom(),
        "cfgcnt": config.get_cfg_count(),
    }
    columns = {key: value if several else [value] for key, value in keys.items()}
    stations = [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]
    for station in stations:
        station["name"] = station["name"].rstrip()
        station["channels"] = [name.rstrip() for name in station["channels"]]
    return {"time_base": config.get_time_base(), "data_rate": config.get_data_rate(), "stations": stations}


def described_stations(data: Any) -> list[dict[str, Any]]:
    """What a data frame says; pyc37 takes the bit "not in sync" for its opposite, which is undone here."""
    several = data.cfg.is_multistreaming()

    def each(value: Any) -> list[Any]:
        return value if several else [value]

    return [
        {"idcode": one["stream_id"], "stat": stat ^ 0x2000, "phasors": one["phasors"], "frequency": one["frequency"]}
        | {"freq": freq, "dfreq": one["rocof"], "analogs": one["analog"], "digitals": one["digital"]}
        for one, stat, freq in zip(
            data.get_measurements()["measurements"], each(data._stat), each(data.get_freq()), strict=True
        )
    ]


if __name__ == "__main__":
    main()
