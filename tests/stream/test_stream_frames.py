"""``pmutools.open_stream`` without an event loop: frames and batches of recordings and of live endpoints."""

from __future__ import annotations

import math
import random
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.frames import random_stream
from support.live import data_frame, free_udp_port
from support.playing import START_NS, number, recording, stream
from support.recordings import messages_of, write
from support.serving import Device

import pmutools
from pmutools.c37118 import Format, PhasorChannel, Stat, Station, StreamConfig, encode_config
from pmutools.c37118.constants import DataError
from pmutools.c37118.session import Outcome
from pmutools.clock import VirtualClock
from pmutools.errors import SettingsError, SourceError, StreamTimeout
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.net.endpoint import parse_endpoint
from pmutools.net.sockets import resolve
from pmutools.sites import load_sites
from pmutools.stream import Stream, StreamBatch, StreamFrame, open_stream
from pmutools.timebase import NS

ROOT = Path(__file__).parents[2]
EIGHT, PDC = ROOT / "captures" / "cjb-8pmu.pcap", ROOT / "captures" / "cjb-pdc-30fps.pcapng"


# --- frames


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 3))
def test_frames_say_what_was_sent(tmp_path_factory: pytest.TempPathFactory, seed: int, stations: int) -> None:
    """Judged by an oracle that builds frames from meanings."""
    described = random_stream(random.Random(seed), stations=stations, frames=3)
    path = tmp_path_factory.mktemp("frames") / "x.mcap"
    write(path, messages_of(described))
    with open_stream(path) as opened:
        frames = list(opened)
    for frame, expected in zip(frames, described.expected_data(), strict=True):
        assert (frame.idcode, frame.time_ns) == (described.spec.idcode, expected["time_ns"])
        assert frame.time_quality == expected["time_quality"]
        assert [frame.arrival_ns, frame.delay_ns] == [frame.arrival_ns, frame.arrival_ns - frame.time_ns]
        for values, told in zip(frame.stations.values(), expected["stations"], strict=True):
            assert (values.stat, values.valid) == (told["stat"], told["valid"])
            numbers = [values.freq_hz, values.rocof_hz_s, *values.analogs.values()]
            assert all(map(same, numbers, [told["frequency"], told["rocof"], *told["analogs"]]))
            for phasor, part in zip(values.phasors.values(), told["phasors"], strict=True):
                assert same(phasor.real, part["re"]) and same(phasor.imag, part["im"])
            assert list(values.digitals.values()) == told["digitals"]


def same(value: float, told: float | None) -> bool:
    if told is None:
        return not math.isfinite(value)
    return math.isclose(value, told, rel_tol=1e-6, abs_tol=1e-6)


def test_names_are_those_of_tables() -> None:
    channels = tuple(PhasorChannel(name, 100) for name in ("VA", "VA", "", " VB "))
    config = StreamConfig(7, tuple(Station(name, 7, Format(0), channels) for name in ("A", "A", "")), 50)
    data = b"\xaa\x01" + config.frame_size.to_bytes(2, "big") + bytes(config.frame_size - 4)
    (message,) = recording(stream(), 1, announced=False)
    frame = StreamFrame(
        message._replace(config=config, frame=message.frame._replace(data=data[:4] + b"\0\7" + data[6:]))
    )
    assert list(frame.stations) == ["A", "A#2", "PMU7"]
    assert list(frame["A#2"].phasors) == ["VA", "VA#2", "PH3", "VB"]
    with pytest.raises(KeyError, match="B: no such station; known: A, A#2, PMU7"):
        frame["B"]
    with pytest.raises(LookupError, match="stream 7 has 3 stations: name one of A, A#2, PMU7"):
        _ = frame.freq_hz


def test_one_station_needs_no_name(tmp_path: Path) -> None:
    write(tmp_path / "x.c37118", recording(stream(7, name="ALPHA"), 3))
    with open_stream(tmp_path / "x.c37118") as opened:
        first, *_ = opened
    assert (first.freq_hz, first.rocof_hz_s, first.valid, first.stat) == (60.0, 0.0, True, 0)
    assert first.phasors == {"V1": 1000 * 100e-5 * (1 - 1j)}
    assert (first.analogs, first.digitals) == ({}, {})
    assert (first.arrival_ns, first.delay_ns) == (None, None)
    assert first.time.isoformat() == "2016-09-08T17:05:11+00:00"
    assert repr(first) == "<frame of 7 at 2016-09-08T17:05:11.000000Z: ALPHA>"
    assert repr(first.station) == "<ALPHA stat=0x0000 60.0000 Hz V1=1.41421<-45.000>"


def test_flags() -> None:
    stat = Stat.DATA_ERROR_HIGH | Stat.NOT_SYNCHRONISED | Stat.TRIGGER
    (message,) = recording(stream(), 1, announced=False)
    flagged = message._replace(frame=message.frame._replace(data=data_frame(stream(), START_NS, stat=stat)))
    for one, flags in ((message, (True, DataError.GOOD, True, False)), (flagged, (False, DataError(2), False, True))):
        values = StreamFrame(one).station
        assert (values.valid, values.data_error, values.synchronised, values.triggered) == flags


# --- recordings


def test_several_recordings_are_one_stream(tmp_path: Path) -> None:
    for idcode in (1, 2):
        write(tmp_path / f"{idcode}.pcap", recording(stream(idcode), 20, latency_ns=idcode))
    with open_stream(tmp_path / "1.pcap", str(tmp_path / "2.pcap")) as opened:
        assert [frame.idcode for frame in opened] == [1, 2] * 20
    assert opened.losses == {}
    with open_stream([tmp_path / "1.pcap", tmp_path / "2.pcap"], idcodes=[2], duration_s=0.2) as opened:
        assert [frame.idcode for frame in opened] == [2] * 10
        assert opened.configs.keys() == {2}


def test_batches_are_the_frames() -> None:
    columns: dict[int, list[StreamBatch]] = {}
    with open_stream(EIGHT, duration_s=2.5) as opened:
        for batch in opened.batches(seconds=1):
            columns.setdefault(batch.idcode, []).append(batch)
    assert {tuple(map(len, found)) for found in columns.values()} == {(60, 60, 30)}
    with open_stream(EIGHT, duration_s=2.5) as opened:
        frames = [frame for frame in opened if frame.idcode == 201]
    for name, value in (("S1.freq_hz", "freq_hz"), ("S1.rocof_hz_s", "rocof_hz_s"), ("S1.stat", "stat")):
        found = np.concatenate([batch.column(name) for batch in columns[201]])
        assert found.tolist() == [getattr(frame, value) for frame in frames]
    phasors = np.concatenate([batch.column("S1.VA") for batch in columns[201]])
    np.testing.assert_allclose(phasors, [frame.phasors["VA"] for frame in frames], rtol=1e-12)
    assert [t for batch in columns[201] for t in batch.time_ns.tolist()] == [frame.time_ns for frame in frames]
    assert [t for batch in columns[201] for t in batch.arrival_ns.tolist()] == [frame.arrival_ns for frame in frames]


def test_a_batch_as_a_table() -> None:
    with open_stream(PDC, duration_s=1) as opened:
        (batch,) = opened.batches(seconds=100)
    assert len(batch.names) == 8 * 8
    assert batch.names[:4] == ["N1.stat", "N1.freq_hz", "N1.rocof_hz_s", "N1.VA"]
    table = batch.to_arrow("rect")
    assert table.num_rows == len(batch) == 30
    assert table["N1.VA.re"].to_pylist() == batch.column("N1.VA").real.tolist()
    assert "N1.VA.deg" in batch.to_arrow().schema.names
    with pytest.raises(KeyError, match=r"N1.VX: no such column; did you mean 'N1.V"):
        batch.column("N1.VX")
    assert len(list(batch.frames())) == 30


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".mcap", ".c37118", ".pcapng.gz"])
def test_any_format(suffix: str, tmp_path: Path) -> None:
    write(tmp_path / f"x{suffix}", recording(stream(rate=50), 120))
    with open_stream(tmp_path / f"x{suffix}") as opened:
        frames = list(opened)
    with open_stream(tmp_path / f"x{suffix}") as opened:
        batches = list(opened.batches(seconds=1))
    assert len(frames) == sum(map(len, batches)) == 120
    assert len(batches) == 3
    assert {round(abs(frame.station.phasors["V1"]), 4) for frame in frames} == {1.4142}


def test_iterating_again_goes_on_where_it_was_left(tmp_path: Path) -> None:
    write(tmp_path / "x.c37118", recording(stream(), 50))
    with open_stream(tmp_path / "x.c37118") as opened:
        first = [number(frame.wire) for frame in islice(opened, 20)]
        rest = [number(frame.wire) for frame in opened]
        assert list(opened) == []
    assert first + rest == list(range(50))


def test_damage_is_counted(tmp_path: Path) -> None:
    write(tmp_path / "x.c37118", recording(stream(), 50))
    data = bytearray((tmp_path / "x.c37118").read_bytes())
    data[300] ^= 1
    (tmp_path / "x.c37118").write_bytes(data)
    with open_stream(tmp_path / "x.c37118") as opened:
        assert len(list(opened)) == 49
    assert list(opened.losses) == ["bytes skipped, bad-chk"]


# --- live


def test_live_frames_have_kernel_stamps_and_a_delay() -> None:
    news: list[LinkEvent] = []
    port = free_udp_port()
    with (
        open_stream(f"udp://127.0.0.1:{port}", on_event=news.append, timeout_s=10) as opened,
        Device([stream(7), stream(8)], to=f"udp://127.0.0.1:{port}"),
    ):
        frames = []
        for frame in opened:
            frames.append(frame)
            if set(opened.configs) == {7, 8} and LinkKind.STREAMING in {event.kind for event in news}:
                break
    assert all(frame.delay_ns is not None and 0 < frame.delay_ns < NS for frame in frames)
    assert {event.kind for event in news} >= {LinkKind.BOUND, LinkKind.CONFIGURED, LinkKind.STREAMING}
    assert list(opened.events) == news
    assert opened.overflow == 0


def test_closing_tells_the_server_to_stop_and_frees_the_port() -> None:
    with Device([stream(7)]) as device:
        with open_stream(f"tcp://127.0.0.1:{device.port}?idcode=7", timeout_s=10) as opened:
            assert next(iter(opened)).idcode == 7
        deadline = time.monotonic() + 5
        while Outcome.STOPPED not in {event.kind for event in device.events}:
            assert time.monotonic() < deadline, device.events
            time.sleep(0.01)
    port = free_udp_port()
    opened = open_stream(f"udp://127.0.0.1:{port}")
    with pytest.raises(SourceError, match="already in use"):
        open_stream(f"udp://127.0.0.1:{port}")
    opened.close()
    opened.close()
    with open_stream(f"udp://127.0.0.1:{port}") as opened:
        iter(opened)
    with open_stream(f"udp://127.0.0.1:{port}") as opened:
        opened.batches()
    open_stream(f"udp://127.0.0.1:{port}").close()


def test_batches_come_as_time_passes() -> None:
    port = free_udp_port()
    with (
        open_stream(f"udp://127.0.0.1:{port}", timeout_s=5) as opened,
        Device([stream(7), stream(8)], to=f"udp://127.0.0.1:{port}"),
    ):
        batches = list[StreamBatch]()
        for batch in opened.batches(seconds=0.1):
            batches.append(batch)
            if len(batches) >= 12 and {batch.idcode for batch in batches} == {7, 8}:
                break
    ordered = [[int(t) for b in batches if b.idcode == idcode for t in b.time_ns] for idcode in (7, 8)]
    assert ordered == list(map(sorted, ordered))


def test_nothing_for_too_long_is_an_error_that_says_why() -> None:
    """In virtual time."""
    clock = VirtualClock()
    url = f"udp://127.0.0.1:{free_udp_port()}"
    with open_stream(url, timeout_s=3, clock=clock) as opened, pytest.raises(TimeoutError) as error:
        list(opened)
    assert isinstance(error.value, StreamTimeout)
    assert str(error.value).startswith(f"no data for 3 s; {url}: nothing came; is the sender on")
    assert clock.monotonic_ns() == pytest.approx(3 * NS, abs=NS / 5)


def test_a_stream_that_falls_silent_runs_into_the_timeout_too() -> None:
    clock, port = VirtualClock(), free_udp_port()
    with (
        open_stream(f"udp://127.0.0.1:{port}", timeout_s=3, clock=clock) as opened,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        sender.connect(("127.0.0.1", port))
        clock.advance(2 * NS)
        for message in recording(stream(), 5):
            sender.send(message.frame.data)
        frames = opened.batches(seconds=0.5)
        assert len(next(iter(frames))) == 5
        with pytest.raises(StreamTimeout, match="no data for 3 s"):
            list(frames)


def test_a_duration_ends_it() -> None:
    clock = VirtualClock()
    with open_stream(f"udp://127.0.0.1:{free_udp_port()}", duration_s=10, clock=clock) as opened:
        assert list(opened) == []
    assert clock.monotonic_ns() == 10 * NS


def test_another_thread_stops_it() -> None:
    with open_stream(f"udp://127.0.0.1:{free_udp_port()}") as opened:
        threading.Timer(0.05, opened.stop).start()
        began = time.monotonic()
        assert list(opened) == []
    assert time.monotonic() - began < 3


def test_a_concentrators_pmus_by_the_names_of_the_file(tmp_path: Path) -> None:
    """One connection for all of them; and a configuration that is kept beside the file."""
    stations = tuple(Station(name, 7, Format(0), (PhasorChannel("V1", 100),)) for name in ("NORTH", "SOUTH"))
    config = StreamConfig(300, stations, 50)
    (tmp_path / "300.c37118").write_bytes(encode_config(config))

    def make(config: StreamConfig, time_ns: int) -> bytes:
        from pmutools.c37118 import FrameType, Prefix, encode_data
        from pmutools.c37118.frames import wire_values
        from pmutools.timebase import from_ns

        soc, fracsec = from_ns(time_ns, config.time_base)
        prefix = Prefix(FrameType.DATA.sync, config.frame_size, config.idcode, soc, 0, fracsec)
        return encode_data(wire_values(config, prefix, [[0, 1000, 0, 10, 0], [0, 2000, 0, -10, 0]]))

    with Device([config], make=make) as device:
        (tmp_path / "f.ini").write_text(
            f"[DEFAULT]\nurl = tcp://127.0.0.1:{device.port}\nidcode = 300\nconfig = 300.c37118\n"
            "[pmu S1]\nstation = SOUTH\n[pmu N1]\nstation = NORTH\n[pmu X]\nstation = ELSEWHERE\n"
        )
        for target in (tmp_path / "f.ini", load_sites(tmp_path / "f.ini")):
            with open_stream(target, timeout_s=10) as opened:
                frame = next(iter(opened))
            assert {name: values.phasors["V1"] for name, values in frame.pmus.items()} == {"S1": 2.0, "N1": 1.0}
            assert {name: values.name for name, values in frame.pmus.items()} == {"S1": "SOUTH", "N1": "NORTH"}
            assert len([event for event in opened.events if event.kind is LinkKind.CONNECTED]) == 1


def test_without_a_file_the_pmus_are_the_stations() -> None:
    with open_stream(PDC) as opened:
        frame = next(iter(opened))
    assert list(frame.pmus) == list(frame.stations) == [f"{side}{k}" for side in "NS" for k in range(1, 5)]


# --- mistakes


def test_what_cannot_be_opened(tmp_path: Path) -> None:
    url = "udp://127.0.0.1:0"
    for targets, message in (
        ((), "nothing to open; give URLs, or paths of recordings"),
        (([],), "nothing to open"),
        ((url, EIGHT), "cjb-8pmu.pcap is a recording, udp://127.0.0.1:0 is not; open one or the other"),
        (("udp://127.0.0.1",), "no port"),
    ):
        with pytest.raises(SettingsError, match=message):
            open_stream(*targets)
    with pytest.raises(SourceError, match="no-such-file"):
        open_stream(tmp_path / "no-such-file.pcap")
    open_stream(parse_endpoint(url)).close()
    assert resolve("127.0.0.1", 1, datagram=True).port == 1


def test_a_stream_is_read_in_one_way() -> None:
    with open_stream(EIGHT) as opened:
        next(iter(opened))
        with pytest.raises(RuntimeError, match="read as frames"):
            opened.batches()
    with open_stream(EIGHT) as opened:
        with pytest.raises(ValueError, match="batches of 0 s; give more than 0"):
            opened.batches(0)
        assert opened.batches(1) is opened.batches(1)
        for otherwise in (lambda: opened.batches(2), lambda: iter(opened), lambda: aiter(opened)):
            with pytest.raises(RuntimeError, match="as batches"):
                otherwise()
        next(iter(opened.batches(1)))
        with pytest.raises(RuntimeError, match="read without an event loop"):
            aiter(opened.batches(1))


# --- the package


def test_the_package_offers_it_and_imports_it_when_asked() -> None:
    assert pmutools.open_stream is open_stream
    assert pmutools.Stream is Stream
    for name in pmutools.__all__:
        assert getattr(pmutools, name) is not None
    assert set(pmutools.__all__) <= set(dir(pmutools))
    with pytest.raises(AttributeError, match="no attribute 'no_such'"):
        _ = pmutools.no_such  # type: ignore[attr-defined]
    code = (
        "import sys, pmutools; assert 'numpy' not in sys.modules; pmutools.open_stream; assert 'numpy' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    yield
    deadline = time.monotonic() + 5
    while any(thread.name == "pmutools-stream" for thread in threading.enumerate()):
        assert time.monotonic() < deadline
        time.sleep(0.01)
