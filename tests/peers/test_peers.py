"""The independent peers work, with each other and within their time; so that interoperation proves something."""

from __future__ import annotations

import cmath
import os
import random
import socket
import threading
import time
from collections.abc import Iterator

import pytest
from support.frames import Described, command_frame, header_frame
from support.peers import Process, free_port, pyc37_stream, run_pyc37_pdc, start_pyc37_pmu
from support.pypmu_shim import pypmu_frame

pytestmark = [pytest.mark.peer, pytest.mark.realtime]


@pytest.fixture
def stream(request: pytest.FixtureRequest) -> Described:
    return pyc37_stream(random.Random(11), stations=request.param, frames=5)


@pytest.fixture
def pmu(stream: Described) -> Iterator[tuple[Process, int]]:
    port = free_port()
    with start_pyc37_pmu(port, stream.config(), stream.data) as process:
        yield process, port


def received(connection: socket.socket, size: int) -> bytes:
    octets = b""
    while len(octets) < size and (more := connection.recv(size - len(octets))):
        octets += more
    return octets


@pytest.mark.parametrize("stream", [1, 3], indirect=True)
def test_pdc_reads_what_the_pmu_serves(stream: Described, pmu: tuple[Process, int]) -> None:
    answers = run_pyc37_pdc("127.0.0.1", pmu[1], stream.spec.idcode, len(stream.data), ask=("header", "cfg1", "cfg2"))
    assert [answer["type"] for answer in answers] == ["header", "cfg1", "cfg2"] + ["data"] * len(stream.data)
    assert {answer["idcode"] for answer in answers} == {stream.spec.idcode}
    assert answers[0]["text"] == "b'pyc37'"
    for config in answers[1:3]:
        assert (config["time_base"], config["data_rate"]) == (stream.spec.time_base, stream.spec.data_rate)
        for told, station in zip(config["stations"], stream.expected_config()["stations"], strict=True):
            assert {told[key] == station[key] for key in ("name", "idcode", "format", "fnom_hz", "cfgcnt")} == {True}
            labels = [label for word in station["digitals"] for label in word]
            assert told["channels"] == [channel["name"] for channel in station["phasors"]] + station["analogs"] + labels
    for answer, expected in zip(answers[3:], stream.expected_data(), strict=True):
        assert (answer["soc"], answer["fracsec"]) == (expected["soc"], expected["fracsec"])
        for told, station in zip(answer["stations"], expected["stations"], strict=True):
            assert {told[key] == station[key] for key in ("idcode", "stat", "digitals")} == {True}
            assert told["frequency"] == pytest.approx(station["frequency"])
            assert told["dfreq"] / 100 == pytest.approx(station["rocof"])
            assert told["analogs"] == pytest.approx(station["analogs"])
            for polar, phasor in zip(told["phasors"], station["phasors"], strict=True):
                assert cmath.rect(*polar) == pytest.approx(complex(phasor["re"], phasor["im"]), abs=1e-6)


@pytest.mark.parametrize("stream", [2], indirect=True)
def test_pmu_sends_the_bytes_it_was_given(stream: Described, pmu: tuple[Process, int]) -> None:
    expected = b"".join((stream.config(), *stream.data))
    with socket.create_connection(("127.0.0.1", pmu[1]), timeout=5) as connection:
        connection.sendall(command_frame(stream.spec.idcode, 5))
        octets = received(connection, len(stream.config()))
        connection.sendall(command_frame(stream.spec.idcode, 2))
        octets += received(connection, len(expected) - len(octets))
    assert octets == expected


def test_pmu_stamps_with_the_present_if_told_so() -> None:
    stream, port = pyc37_stream(random.Random(1), frames=1), free_port()
    with start_pyc37_pmu(port, stream.config(), stream.data, stamp_now=True):
        *_, data = run_pyc37_pdc("127.0.0.1", port, stream.spec.idcode, 1)
    assert abs(time.time() - data["soc"]) < 5


@pytest.mark.parametrize("stream", [1], indirect=True)
def test_pmu_ends_with_its_clients_when_stopped(stream: Described, pmu: tuple[Process, int]) -> None:
    with socket.create_connection(("127.0.0.1", pmu[1]), timeout=5) as connection:
        connection.sendall(command_frame(stream.spec.idcode, 3))
        assert received(connection, 16 + len("pyc37")) != b""
        pmu[0].stop()
        assert connection.recv(1) == b""
    with pytest.raises(ProcessLookupError):
        os.killpg(pmu[0].popen.pid, 0)


def test_pmu_ends_itself_when_its_time_is_up() -> None:
    stream, port = pyc37_stream(random.Random(1), frames=1), free_port()
    with start_pyc37_pmu(port, stream.config(), stream.data, limit_s=1) as process:
        assert process.popen.wait(timeout=5) != 0


def test_pdc_says_that_nobody_listens() -> None:
    answers = run_pyc37_pdc("127.0.0.1", free_port(), 7, 1, timeout_s=5)
    assert [answer["type"] for answer in answers] == ["error"]


def test_pdc_outlives_a_server_that_hangs_up() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def hang_up() -> None:
            connection, _ = server.accept()
            with connection:
                received(connection, 18)
                connection.sendall(header_frame(7, "one"))
                received(connection, 18)

        thread = threading.Thread(target=hang_up, daemon=True)
        thread.start()
        answers = run_pyc37_pdc("127.0.0.1", server.getsockname()[1], 7, 1, timeout_s=5)
        thread.join(5)
    assert [answer["type"] for answer in answers] == ["header", "error"]


def test_pypmu_decodes_and_encodes() -> None:
    stream = pyc37_stream(random.Random(3), stations=2, frames=3)
    codec = pypmu_frame().CommonFrame
    config = codec.convert2frame(stream.config())
    assert config.convert2bytes() == stream.config()
    for frame, expected in zip(stream.data, stream.expected_data(), strict=True):
        data = codec.convert2frame(frame, config)
        data.set_stat([station["stat"] for station in expected["stations"]])  # it inverts bit 13
        assert data.convert2bytes() == frame
        told = data.get_measurements()["measurements"]
        frequencies = [station["frequency"] for station in expected["stations"]]
        assert [station["frequency"] for station in told] == pytest.approx(frequencies)
