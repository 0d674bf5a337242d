"""The codec against the standard's examples and an independent oracle, through all three ways in."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.frames import ALL_FORMATS, Described, command_frame, header_frame, random_stream, streams

from pmutools import timebase
from pmutools.c37118 import (
    Demux,
    FrameType,
    Message,
    as_kind,
    decode_command,
    decode_config,
    decode_data,
    decode_header,
    encode_config,
    encode_data,
    encode_message,
    restamp,
)
from pmutools.c37118.batch import decode_batch, encode_batch
from pmutools.c37118.checksum import _plain_chk, chk
from pmutools.c37118.config import (
    AnalogChannel,
    AnalogScale,
    PhasorChannel,
    PhasorScale,
    Station,
    StationDetails,
    StreamConfig,
)
from pmutools.c37118.constants import Format
from pmutools.c37118.demux import Bounds
from pmutools.c37118.framer import Frame, SkipReason
from pmutools.c37118.frames import wire_values
from pmutools.c37118.layout import layout_of
from pmutools.c37118.prefix import Prefix
from pmutools.errors import ChecksumError, ConfigError, EncodeError, LengthError, WireError
from pmutools.flow import Chunk, Flow, StampSource
from pmutools.formats.describe import describe

FLOW = Flow("file", "test")
ANNEX_D_DATA = bytes.fromhex(
    "aa0100341e3644853600000041b10000392b0000e36ace7ce36a31830444000009c4000042c80000447a0000461c40003c12d43f"
)


def annex_d_config() -> bytes:
    names = ["VA", "VB", "VC", "I1", "ANALOG1", "ANALOG2", "ANALOG3"]
    names += [f"BREAKER {character} STATUS" for character in "123456789ABCDEFG"]
    body = bytes.fromhex("aa3101c61e36448527f056071098000f42400001")
    body += b"Station A".ljust(16) + bytes.fromhex("1e360004000400030001")
    body += b"".join(name.encode().ljust(16) for name in names)
    body += bytes.fromhex(
        "000df847000df847000df8470100b2d0000000010100000102000001" + "0000ffff" + "0000" + "0016" + "001e"
    )
    return body + bytes.fromhex("d5d1")


def close(actual: Any, expected: Any, rel: float = 1e-12) -> bool:
    """Equal objects, floats to rounding; every key of ``expected`` is there."""
    if isinstance(expected, dict):
        return all(key in actual and close(actual[key], value, rel) for key, value in expected.items())
    if isinstance(expected, list):
        return len(actual) == len(expected) and all(close(a, e, rel) for a, e in zip(actual, expected, strict=True))
    if isinstance(expected, float) and isinstance(actual, float):
        return math.isclose(actual, expected, rel_tol=rel, abs_tol=1e-9) or actual == expected
    return bool(actual == expected)


def objects(stream: Described, kind: str) -> list[dict[str, Any]]:
    demux = Demux()
    pieces = [stream.config(kind), *stream.data]
    items = [item for piece in pieces for item in demux.feed(Chunk(piece, None, FLOW))] + demux.close()
    return [describe(item) for item in items]


# --- the standard's own examples --------------------------------------------------------------------------------


def test_annex_d_configuration() -> None:
    frame = annex_d_config()
    assert len(frame) == 454
    prefix, config = decode_config(frame)
    assert encode_config(config, soc=prefix.soc, fracsec=prefix.fracsec, time_quality=prefix.time_quality) == frame
    (station,) = config.stations
    assert (station.name, station.idcode, station.cfgcnt, station.fnom_hz) == ("Station A", 7734, 22, 60.0)
    assert [channel.name for channel in station.phasors] == ["VA", "VB", "VC", "I1"]
    assert [channel.kind for channel in station.phasors] == ["V", "V", "V", "I"]
    assert station.digitals[0].labels[15] == "BREAKER G STATUS"
    assert (config.data_rate, config.time_base, prefix.msg_tq, int(prefix.leap)) == (30, 1_000_000, 6, 0x50)


def test_annex_d_data() -> None:
    config = decode_config(annex_d_config())[1]
    data = decode_data(ANNEX_D_DATA, config)
    station = data.station()
    assert data.time_ns == 1149580800_016817000
    assert station.phasors[0] == pytest.approx(14635 * 9.15527)
    assert station.phasors[1] == pytest.approx((-7318 - 12676j) * 9.15527)
    assert station.phasors[3] == pytest.approx(1092 * 0.45776)
    assert (station.frequency, station.rocof) == (62.5, 0.0)
    assert station.analogs == (100.0, 1000.0, 10000.0)
    assert station.digitals == (0x3C12,)
    assert encode_data(data) == ANNEX_D_DATA


def test_annex_d_command() -> None:
    frame = bytes.fromhex("aa4100121e36448560300f0bbfd00002ce00")
    command = decode_command(frame)
    assert (command.prefix.idcode, command.name, command.extended) == (7734, "start_data", b"")
    assert encode_message(command) == frame


@pytest.mark.parametrize(
    ("text", "value"), [(b"ABCD", 0xBFFA), (b"123456", 0x2EF4), (b"abc", 0x514A), (b"123456789", 0x29B1)]
)
def test_chk_vectors(text: bytes, value: int) -> None:
    assert chk(text) == _plain_chk(text) == value


# --- the independent oracle -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["cfg1", "cfg2", "cfg3"])
@pytest.mark.parametrize("fmt", ALL_FORMATS)
def test_every_format_under_every_configuration(fmt: int, kind: str) -> None:
    rng = random.Random(fmt)
    for _ in range(10):
        stream = random_stream(rng, formats=[fmt] * rng.randint(1, 3), frames=6)
        described = objects(stream, kind)
        assert close(described[0], stream.expected_config(kind))
        if kind == "cfg1":  # says what could be sent: data waits for CFG-2 or CFG-3
            assert [d["type"] for d in described[1:]] == ["skipped"] * 6
        else:
            assert close(described[1:], list(stream.expected_data(kind)), 1e-9)


@given(streams())
@settings(max_examples=60, deadline=None)
def test_bytes_survive_decoding_and_encoding(stream: Described) -> None:
    for kind in ("cfg1", "cfg2", "cfg3"):
        frame = stream.config(kind)
        prefix, config = decode_config(frame)
        assert encode_config(config, soc=prefix.soc, fracsec=prefix.fracsec, time_quality=prefix.time_quality) == frame
        assert decode_config(encode_config(config))[1] == config
    for frame in stream.data:
        assert encode_data(decode_data(frame, config)) == frame


@given(streams(frames=7), st.sampled_from(["cfg2", "cfg3"]))
@settings(max_examples=60, deadline=None)
def test_batch_and_single_frame_agree(stream: Described, kind: str) -> None:
    config = decode_config(stream.config(kind))[1]
    batch = decode_batch(b"".join(stream.data), config)
    assert not batch.wire.flags.writeable  # type: ignore[union-attr]
    for row, frame in enumerate(stream.data):
        data = decode_data(frame, config)
        assert batch.time_ns[row] == data.time_ns
        assert batch.time_quality[row] == data.time_quality
        values = data.stations
        np.testing.assert_array_equal(batch.stat[row], [v.stat for v in values])
        np.testing.assert_array_equal(batch.valid[row], [v.valid for v in values])
        np.testing.assert_array_equal(batch.frequency[row], [v.frequency for v in values])
        np.testing.assert_array_equal(batch.rocof[row], [v.rocof for v in values])
        np.testing.assert_allclose(batch.analogs[row], [a for v in values for a in v.analogs], rtol=1e-15)
        np.testing.assert_array_equal(batch.digitals[row], [d for v in values for d in v.digitals])
        np.testing.assert_allclose(
            batch.phasors[row], [p for v in values for p in v.phasors], rtol=1e-13, atol=1e-9, equal_nan=True
        )


@given(streams(frames=5, absent=0.2), st.sampled_from(["cfg2", "cfg3"]))
@settings(max_examples=60, deadline=None)
def test_columns_survive_encoding(stream: Described, kind: str) -> None:
    """Engineering units -> frames -> engineering units moves no value by more than its field's resolution."""
    config = decode_config(stream.config(kind))[1]
    first = decode_batch(b"".join(stream.data), config)
    octets, clipped = encode_batch(first)
    assert clipped == 0
    again = decode_batch(octets.tobytes(), config)
    np.testing.assert_array_equal(again.time_ns, first.time_ns)
    np.testing.assert_array_equal(again.stat, first.stat)
    np.testing.assert_allclose(again.frequency, first.frequency, rtol=1e-12)
    np.testing.assert_allclose(again.phasors, first.phasors, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(again.analogs, first.analogs, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(again.digitals, first.digitals)


def test_encoding_clips_and_says_so() -> None:
    config = decode_config(annex_d_config())[1]
    batch = decode_batch(ANNEX_D_DATA, config)
    batch.frequency[0, 0] = 120.0
    octets, clipped = encode_batch(batch)
    assert clipped == 1
    assert decode_data(octets.tobytes(), config).frequency() == pytest.approx(92.767)


@given(streams(frames=3))
@settings(max_examples=40, deadline=None)
def test_cfg2_becomes_cfg3_with_the_same_values(stream: Described) -> None:
    second = decode_config(stream.config("cfg2"))[1]
    third = as_kind(second, FrameType.CFG3)
    assert decode_config(encode_config(third))[1] == third
    for frame in stream.data:
        for old, new in zip(decode_data(frame, second).stations, decode_data(frame, third).stations, strict=True):
            np.testing.assert_allclose(new.phasors, old.phasors, rtol=1e-6)
            assert new.stat == old.stat
    back = as_kind(third, FrameType.CFG2)
    assert [s.name for s in back.stations] == [s.name for s in second.stations]


@given(st.integers(0, 0xFFFFFFFF), st.integers(0, 0xFFFF), st.binary(max_size=40))
def test_commands_and_headers_survive(soc: int, code: int, extended: bytes) -> None:
    frame = command_frame(5, code, extended=extended)
    assert encode_message(decode_command(frame)) == frame
    text = header_frame(5, "PMU of station 5")
    assert decode_header(text).text == "PMU of station 5"
    assert encode_message(decode_header(text)) == text


@given(streams(frames=1), st.integers(0, 0xFFFFFFFF), st.integers(0, 0xFFFFFF))
@settings(max_examples=30, deadline=None)
def test_restamp_changes_time_alone(stream: Described, soc: int, fracsec: int) -> None:
    config = decode_config(stream.config())[1]
    (frame,) = stream.data
    moved = restamp(frame, soc, fracsec)
    old, new = decode_data(frame, config), decode_data(moved, config)
    assert (new.prefix.soc, new.prefix.fracsec, new.time_quality) == (soc, fracsec, old.time_quality)
    assert moved[:6] == frame[:6]
    assert moved[14:-2] == frame[14:-2]


# --- what must be refused ---------------------------------------------------------------------------------------


def test_one_shot_decoders_say_what_is_wrong() -> None:
    config = decode_config(annex_d_config())[1]
    with pytest.raises(ChecksumError):
        decode_data(ANNEX_D_DATA[:-1] + b"\0", config)
    with pytest.raises(LengthError):
        decode_data(ANNEX_D_DATA[:-1], config)
    with pytest.raises(ConfigError):
        decode_config(ANNEX_D_DATA)
    with pytest.raises(WireError):
        decode_command(annex_d_config())
    with pytest.raises(EncodeError):
        command_too_long = bytes(70000)
        from pmutools.c37118 import encode_command

        encode_command(1, 8, extended=command_too_long)


@given(streams(frames=1), st.data())
@settings(max_examples=150, deadline=None)
def test_lying_configurations_raise_nothing_but_wire_errors(stream: Described, data: Any) -> None:
    frame = bytearray(stream.config(data.draw(st.sampled_from(["cfg1", "cfg2", "cfg3"]))))
    for _ in range(data.draw(st.integers(1, 4))):
        frame[data.draw(st.integers(14, len(frame) - 3))] = data.draw(st.integers(0, 255))
    sealed = bytes(frame[:-2]) + chk(bytes(frame[:-2])).to_bytes(2, "big")
    try:
        _, config = decode_config(sealed)
    except WireError:
        return
    if "nan" not in repr(config):  # the processor makes a signalling NaN a quiet one
        assert encode_config(config)[14:-2] == sealed[14:-2]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("fmt", range(16))
@pytest.mark.parametrize("odd", [math.inf, -math.inf, math.nan, 3e38, 0.0])
def test_scales_that_are_no_numbers_give_nan_and_no_warning(fmt: int, odd: float) -> None:
    """CFG-3 may say anything: the one way in and the other say the same of it, in silence."""
    phasors = [
        PhasorChannel("A", phscale=scale) for scale in (PhasorScale(0, 0, 0, 1, odd), PhasorScale(0, 0, 0, odd, 1))
    ]
    analogs = [AnalogChannel("X", anscale=scale) for scale in (AnalogScale(odd, 0), AnalogScale(1, odd))]
    station = Station("S", 1, Format(fmt), tuple(phasors), tuple(analogs), details=StationDetails())
    config = StreamConfig(1, (station,), 50, kind=FrameType.CFG3)
    values = [0, *(3, 4, 5, 6), *(0, 0), *(7, 8)]
    frame = encode_data(wire_values(config, (0xAA01, 0, 1, 0, 0, 0), [values]))
    one, many = decode_data(frame, config).station(), decode_batch(frame, config)
    np.testing.assert_allclose(many.phasors[0], one.phasors, rtol=1e-3)  # a turn of 3e38 rad swallows the angle
    np.testing.assert_allclose(many.analogs[0], one.analogs, rtol=1e-12)
    assert encode_batch(many)[0].shape == (1, len(frame))


# --- several flows ----------------------------------------------------------------------------------------------


def feed(demux: Demux, flow: Flow, *frames: bytes) -> list[Any]:
    return [item for frame in frames for item in demux.feed(Chunk(frame, 1, flow, StampSource.CAPTURE))]


def test_data_before_its_configuration_is_held() -> None:
    stream = random_stream(random.Random(1), stations=1)
    demux = Demux()
    assert feed(demux, FLOW, *stream.data) == []
    items = feed(demux, FLOW, stream.config())
    assert [item.frame.data for item in items] == [stream.config(), *stream.data]
    assert demux.tally.fed == demux.tally.framed


def test_data_without_configuration_is_counted_at_the_end() -> None:
    stream = random_stream(random.Random(2), stations=1)
    demux = Demux()
    feed(demux, FLOW, *stream.data)
    assert {loss.skipped.reason for loss in demux.close()} == {"no-config"}
    assert demux.tally.skipped_bytes == demux.tally.fed


def test_configuration_over_tcp_serves_data_over_udp_of_the_same_host() -> None:
    stream = random_stream(random.Random(3), stations=1)
    demux = Demux()
    feed(demux, Flow("tcp", "10.0.0.1:4712", "10.0.0.9:5000"), stream.config())
    items = feed(demux, Flow("udp", "10.0.0.1:4713", "10.0.0.9:4713"), *stream.data)
    assert all(isinstance(item, Message) and item.config is not None for item in items)
    assert len(items) == len(stream.data)


def test_unrelated_flows_are_ignored_not_skipped() -> None:
    demux = Demux()
    feed(demux, Flow("tcp", "a:80", "b:99"), b"HTTP/1.1 200 OK", b"\xaa\x01 and so on")
    assert demux.close() == []
    assert (demux.tally.ignored, demux.tally.ignored_flows, demux.tally.skipped) == (27, 1, {})


def test_flows_that_come_and_go_leave_nothing_behind() -> None:
    streams = [random_stream(random.Random(k), stations=1, idcode=k) for k in range(1, 9)]
    demux = Demux(bounds=Bounds(flows=50))
    for number in range(3000):
        stream, other = streams[number % 8], streams[(number + 1) % 8]
        host = f"10.0.{number >> 8}.{number & 255}"
        feed(demux, Flow("tcp", f"{host}:4712", "b:1"), stream.config(), other.data[0])
        feed(demux, Flow("udp", f"{host}:4713", "b:2"), stream.data[0])  # borrows the other flow's configuration
        tables = (demux._configs, demux._waiting, demux._borrowers)
        assert all(len(table) <= 50 for table in tables)
    demux.close()
    assert tables == ({}, {}, {})
    assert demux.tally.fed == demux.tally.framed + demux.tally.skipped_bytes


def test_all_flows_share_one_budget_of_held_data() -> None:
    stream = random_stream(random.Random(7), stations=1)
    size = len(stream.data[0])
    flows = [Flow("udp", f"10.1.{k >> 8}.{k & 255}:4713", "b:1") for k in range(3000)]
    demux = Demux(bounds=Bounds(all_held_bytes=2000 * size))
    losses: list[Any] = []
    for flow in flows:
        losses += feed(demux, flow, stream.data[0])
        assert demux.pending <= 2000 * size
    assert [loss.flow for loss in losses] == flows[:1000]  # those that had waited longest
    assert {loss.skipped.reason for loss in losses} == {SkipReason.NO_CONFIG}
    items = feed(demux, flows[-1], stream.config())
    assert [item.frame.data for item in items] == [stream.config(), stream.data[0]]
    assert demux.pending == 1999 * size
    assert feed(demux, flows[0], stream.data[1]) == []  # there is room again
    demux.close()
    assert demux.tally.fed == demux.tally.framed + demux.tally.skipped_bytes


def test_changed_configuration_takes_over() -> None:
    rng = random.Random(4)
    first, second = (random_stream(rng, stations=n, idcode=9) for n in (1, 2))
    demux = Demux()
    items = feed(demux, FLOW, first.config(), *first.data, second.config(), *second.data)
    assert all(isinstance(item, Message) for item in items)
    assert demux.close() == []


def test_fragmented_cfg3_is_joined() -> None:
    stream = random_stream(random.Random(5), stations=2)
    whole = stream.config("cfg3")
    body = whole[16:-2]
    demux = Demux()
    thirds = [body[: len(body) // 3], body[len(body) // 3 : -7], body[-7:]]
    for index, part in zip((1, 2, 0xFFFF), thirds, strict=True):
        head = whole[:2] + (18 + len(part)).to_bytes(2, "big") + whole[4:14] + index.to_bytes(2, "big") + part
        items = feed(demux, FLOW, head + chk(head).to_bytes(2, "big"))
    assert items[-1].config == decode_config(whole)[1]
    assert len(feed(demux, FLOW, *stream.data)) == len(stream.data)


def test_frame_types_and_ids_are_read_from_bytes() -> None:
    frame = Frame(ANNEX_D_DATA, None, StampSource.CAPTURE, 0)
    assert (frame.type, frame.idcode) == (FrameType.DATA, 7734)


@given(st.integers(0, 2**40), st.integers(1, 0xFFFFFF))
def test_time_survives_the_wire(ticks: int, time_base: int) -> None:
    soc, fracsec = divmod(ticks, time_base)
    assert timebase.from_ns(timebase.to_ns(soc, fracsec, time_base), time_base) == (soc, fracsec)


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 4), st.binary(max_size=30)), max_size=25))
@settings(max_examples=60, deadline=None)
def test_every_byte_fed_is_accounted_for(pieces: list[tuple[int, int, bytes]]) -> None:
    stream = random_stream(random.Random(6), stations=1)
    known = [stream.config(), *stream.data]
    flows = [Flow("udp", "a:1", "b:2"), Flow("tcp", "a:3", "b:4"), Flow("tcp", "c:5", "b:6")]
    demux = Demux()
    for number, which, junk in pieces:
        demux.feed(Chunk(known[which] + junk, None, flows[number]))
        tally = demux.tally
        assert tally.fed == tally.framed + tally.skipped_bytes + tally.ignored + demux.pending
    demux.close()
    assert demux.tally.fed == demux.tally.framed + demux.tally.skipped_bytes + demux.tally.ignored


def test_a_phasor_beyond_both_ends_of_its_integers_does_not_read_as_absent() -> None:
    station = Station("A", 7, Format(0), (PhasorChannel("V", 100_000),))
    config = StreamConfig(7, (station,), 50)
    prefix = Prefix(FrameType.DATA.sync, config.frame_size, 7, 0, 0, 0)
    frame = encode_data(wire_values(config, prefix, [[0, 1, 1, 0, 0]]))
    batch = decode_batch(frame, config)
    far = replace(batch, phasors=np.full((1, 1), -1e6 - 1e6j), wire=None)
    octets, clipped = encode_batch(far)
    assert clipped == 2
    (back,) = decode_batch(octets.tobytes(), config).phasors[0]
    assert back == -32767 - 32767j


def test_streams_that_are_laid_out_alike_share_their_layout() -> None:
    """So that their frames can be decoded together; whatever bears on decoding tells them apart."""
    one = StreamConfig(1, (Station("A", 1, Format.POLAR, (PhasorChannel("VA", 100),)),), 50)
    station = one.stations[0]
    alike = [
        replace(one, idcode=2, data_rate=25),
        replace(one, stations=(replace(station, name="B", idcode=9, cfgcnt=4),)),
        replace(one, stations=(replace(station, phasors=(PhasorChannel("IA", 100 | 1 << 24),)),)),
    ]
    apart = [
        replace(one, time_base=1000),
        replace(one, stations=(replace(station, fnom=1),)),
        replace(one, stations=(replace(station, format=Format(0)),)),
        replace(one, stations=(replace(station, phasors=(PhasorChannel("VA", 101),)),)),
        replace(one, stations=(station, station)),
    ]
    assert {layout_of(config) for config in (one, *alike)} == {layout_of(one)}
    assert len({layout_of(config) for config in (one, *apart)}) == 1 + len(apart)
