"""The scapy layer: bytes in, the same bytes out; fields by the stream's configuration; packets, segments, fuzzing."""

from __future__ import annotations

import binascii
import math
import random
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from itertools import count, pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scapy.layers.inet import IP, TCP, UDP
from scapy.packet import Packet, Padding, Raw, fuzz
from scapy.sendrecv import sniff
from scapy.sessions import TCPSession
from support.captures import PDC, REAL_CAPTURES, Endpoint, capture_path, tcp_packets, udp_packet, write_pcap
from support.frames import CONFIG_KINDS, Described, command_frame, header_frame, random_stream, streams
from support.meaning import si_phasor

from pmutools.c37118 import Command, FrameType, decode_command, decode_config, decode_data, decode_header
from pmutools.c37118.constants import TCP_PORT, UDP_PORT
from pmutools.c37118_scapy import (
    C37118,
    MAX_CONFIGS,
    Cfg3Station,
    CfgStation,
    DataBlock,
    PhasorScaling,
    config_of,
    data_blocks,
    forget,
    learn,
)


@pytest.fixture(autouse=True)
def nothing_learned() -> Iterator[None]:
    forget()
    yield
    forget()


def layers(packet: Packet) -> list[C37118]:
    """The frames of a packet, in order."""
    found = []
    layer = packet.getlayer(C37118)
    while layer is not None:
        found.append(layer)
        layer = layer.payload.getlayer(C37118)
    return found


def rebuilt(packet: Packet) -> bytes:
    """The packet's bytes made from its fields, not from those it was dissected from."""
    packet.clear_cache()
    return bytes(packet)


def frames_of(stream: Described, kind: str) -> list[bytes]:
    return [stream.config(kind), *stream.data]


# --- dissect and build ------------------------------------------------------------------------------------------


@given(streams(frames=2), st.sampled_from(CONFIG_KINDS))
def test_build_gives_the_bytes_back(stream: Described, kind: str) -> None:
    forget()
    if kind == "cfg1":
        learn(decode_config(stream.config("cfg2"))[1])
    for frame in frames_of(stream, kind):
        packet = C37118(frame)
        assert packet.undecoded is None
        assert not packet.payload
        assert rebuilt(packet) == frame


@pytest.mark.parametrize("frame", [command_frame(7, 2), command_frame(7, 8, extended=b"ab\0"), header_frame(7, "Hi")])
def test_commands_and_headers_come_back(frame: bytes) -> None:
    assert rebuilt(C37118(frame)) == frame


@given(streams(frames=1), st.sampled_from(("cfg2", "cfg3")))
def test_blocks_say_what_the_codec_says(stream: Described, kind: str) -> None:
    forget()
    config = decode_config(stream.config(kind))[1]
    C37118(stream.config(kind))
    packet = C37118(stream.data[0])
    stations = decode_data(stream.data[0], config).stations
    assert repr([block.measured for block in packet.blocks]) == repr(list(stations))  # in text, NaN equals NaN
    for block, station, sent in zip(packet.blocks, stream.spec.stations, stream.blocks[0], strict=True):
        assert isinstance(block, DataBlock)
        assert block.data_error << 14 | block.trigger_reason == sent.stat & 0xC00F
        for channel, pair, value in zip(station.phasors, sent.phasors, block.measured.phasors, strict=True):
            expected = si_phasor(channel, station.format, kind, *pair)
            assert value == pytest.approx(expected, rel=1e-9, nan_ok=True)


def test_fields_of_a_configuration() -> None:
    stream = random_stream(random.Random(1), formats=[5, 10], time_base=1000, data_rate=-5)
    second, third = C37118(stream.config("cfg2")), C37118(stream.config("cfg3"))
    assert (second.type, second.time_base, second.num_pmu, second.data_rate) == (FrameType.CFG2, 1000, 2, -5)
    assert third.cont_idx == 0 and third.version == 2
    for packet, cls in ((second, CfgStation), (third, Cfg3Station)):
        for block, station in zip(packet.blocks, stream.spec.stations, strict=True):
            assert isinstance(block, cls)
            assert (block.idcode, int(block.format), block.cfgcnt) == (station.idcode, station.format, station.cfgcnt)
            assert (block.phnmr, block.annmr, block.dgnmr) == tuple(
                map(len, (station.phasors, station.analogs, station.words))
            )
    names = [phasor.name.long.encode() for phasor in stream.spec.stations[0].phasors]
    assert third.blocks[0].phasor_names == names
    assert [scale.scale for scale in third.blocks[0].phscale] == [p.scale for p in stream.spec.stations[0].phasors]


def test_without_a_configuration_the_body_stays_raw() -> None:
    frame = random_stream(random.Random(1), formats=[0]).data[0]
    packet = C37118(frame)
    assert packet.undecoded == frame[14:-2]
    assert (packet.framesize, packet.chk) == (len(frame), binascii.crc_hqx(frame[:-2], 0xFFFF))
    assert rebuilt(packet) == frame


@pytest.mark.parametrize(
    "second_byte",
    [0x61, 0x71, 0x83, 0xA3],
    ids=["undefined type", "undefined type 7", "2024 data", "2024 capability"],
)
def test_unknown_types_stay_raw(second_byte: int) -> None:
    frame = bytes((0xAA, second_byte, 0, 20)) + bytes(range(16))
    packet = C37118(frame)
    assert packet.undecoded == frame[14:-2]
    assert rebuilt(packet) == frame


@given(streams(frames=1), st.sampled_from(CONFIG_KINDS), st.data())
def test_a_flipped_bit_is_dissected_and_built_back(stream: Described, kind: str, data: st.DataObject) -> None:
    forget()
    frame = bytearray(data.draw(st.sampled_from(frames_of(stream, kind))))
    bit = data.draw(st.integers(0, 8 * len(frame) - 1))
    frame[bit // 8] ^= 1 << bit % 8
    packet = C37118(bytes(frame))
    assert bytes(packet) == bytes(frame)
    packet.show(dump=True)


@given(st.binary(max_size=200) | st.binary(max_size=60).map(lambda tail: b"\xaa\x31\0\x40" + tail))
def test_any_bytes_are_dissected_and_built_back(octets: bytes) -> None:
    packet = C37118(octets) if octets else Raw()
    assert bytes(packet) == octets


# --- what is learned --------------------------------------------------------------------------------------------


def test_only_good_cfg2_and_cfg3_are_learned() -> None:
    stream = random_stream(random.Random(1))
    idcode = stream.spec.idcode
    C37118(stream.config("cfg1"))
    assert config_of(idcode) is None
    damaged = stream.config("cfg2")[:-1] + bytes((stream.config("cfg2")[-1] ^ 1,))
    C37118(damaged)
    assert config_of(idcode) is None
    C37118(stream.config("cfg2"))
    assert config_of(idcode) == decode_config(stream.config("cfg2"))[1]
    C37118(stream.config("cfg3"))
    assert config_of(idcode) == decode_config(stream.config("cfg3"))[1]
    forget(idcode)
    assert config_of(idcode) is None


def test_configurations_are_bounded() -> None:
    stream = random_stream(random.Random(1), stations=1)
    for idcode in range(1, MAX_CONFIGS + 11):
        C37118(stream.config()[:4] + idcode.to_bytes(2, "big") + stream.config()[6:])  # wrong CHK: not learned
    assert config_of(1) is None
    config = decode_config(stream.config())[1]
    for idcode in range(1, MAX_CONFIGS + 11):
        learn(type(config)(idcode, config.stations, config.data_rate))
    assert config_of(10) is None
    assert config_of(11) is not None
    assert config_of(MAX_CONFIGS + 10) is not None


# --- building by hand -------------------------------------------------------------------------------------------


def test_a_command_by_name() -> None:
    packet = IP(dst="192.0.2.1") / UDP() / C37118(type="command", idcode=7734, cmd="start_data")
    assert packet[UDP].dport == UDP_PORT
    command = decode_command(bytes(packet[C37118]))
    assert (command.prefix.idcode, command.code) == (7734, Command.START_DATA)
    assert (IP() / TCP() / C37118())[TCP].dport == TCP_PORT
    extended = decode_command(bytes(C37118(type="command", cmd="extended", extended=b"\1\2")))
    assert extended.extended == b"\1\2"
    assert decode_header(bytes(C37118(type="header", text="A PMU"))).text == "A PMU"


def test_a_configuration_with_its_counts_computed() -> None:
    second = CfgStation(
        stn="Station A",
        idcode=7734,
        format="analog_float",
        phasor_names=["VA", "I1"],
        analog_names=["ANALOG1"],
        digital_labels=[f"BREAKER {bit}" for bit in range(16)],
        phunit=[915527, 1 << 24 | 45776],
        anunit=[1],
        digunit=[0x0000FFFF],
        fnom="60 Hz",
        cfgcnt=22,
    )
    prefix, config = decode_config(bytes(C37118(type="cfg2", idcode=7734, blocks=[second], data_rate=-2)))
    (station,) = config.stations
    assert (prefix.version, config.data_rate, station.name, station.cfgcnt) == (1, -2, "Station A", 22)
    assert [(channel.name, channel.kind) for channel in station.phasors] == [("VA", "V"), ("I1", "I")]
    assert station.digitals[0].labels[15] == "BREAKER 15"

    third = Cfg3Station(stn="Δ", phasor_names=["VA"], phscale=[PhasorScaling(scale=0.5, component="phase_a")])
    prefix, config = decode_config(bytes(C37118(type="cfg3", blocks=[third])))
    assert (prefix.version, config.stations[0].name, config.stations[0].phasors[0].phscale.scale) == (2, "Δ", 0.5)


def test_a_data_frame_from_blocks() -> None:
    stream = random_stream(random.Random(1), formats=[0b1010], absent=0)
    config = decode_config(stream.config())[1]
    blocks = data_blocks(config)
    blocks[0].freq = 59.5
    blocks[0].trigger = 1
    blocks[0].phasors = [(3.0, 4.0)] * len(config.stations[0].phasors)
    data = decode_data(bytes(C37118(idcode=config.idcode, soc=10, fracsec=3, blocks=blocks)), config)
    assert data.frequency() == 59.5
    assert data.stat() == 0x0800
    assert all(data.phasor(column) == 3 + 4j for column in range(len(config.stations[0].phasors)))
    assert (data.prefix.soc, data.prefix.fracsec) == (10, 3)


def test_a_changed_value_changes_the_frame_and_its_chk() -> None:
    stream = random_stream(random.Random(1), formats=[0], absent=0)
    config = decode_config(stream.config())[1]
    learn(config)
    packet = C37118(stream.data[0])
    packet.blocks[0].freq = 250
    packet.chk = None
    assert decode_data(bytes(packet), config).frequency() == config.stations[0].fnom_hz + 0.25


def test_counts_and_sizes_can_lie() -> None:
    packet = C37118(type="cfg2", framesize=99, num_pmu=3, chk=0x1234)
    octets = bytes(packet)
    assert octets[2:4] == b"\0\x63" and octets[18:20] == b"\0\3" and octets[-2:] == b"\x12\x34"


# --- packets ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("port", [TCP_PORT, UDP_PORT])
@pytest.mark.parametrize("transport", [TCP, UDP])
def test_bound_to_the_ports_both_ways(transport: type[Packet], port: int) -> None:
    for ports in ({"sport": port, "dport": 9}, {"sport": 9, "dport": port}):
        packet = IP(bytes(IP() / transport(**ports) / command_frame(7, 2)))
        assert packet[C37118].cmd == Command.START_DATA


def test_several_frames_in_one_datagram_are_layers() -> None:
    stream = random_stream(random.Random(4), formats=[3], frames=3)
    octets = b"".join(frames_of(stream, "cfg2"))
    packet = C37118(octets + b"\xaa\x01")
    assert [layer.type for layer in layers(packet)] == [FrameType.CFG2, 0, 0, 0]
    assert all(layer.undecoded is None for layer in layers(packet))
    assert packet.lastlayer().load == b"\xaa\x01"
    assert rebuilt(packet) == octets + b"\xaa\x01"


def test_tcp_reassemble() -> None:
    frames = [command_frame(1, 2), header_frame(1, "text")]
    octets = b"".join(frames)
    assert C37118.tcp_reassemble(octets[:3], {}, {}) is None
    assert C37118.tcp_reassemble(octets[:17], {}, {}) is None
    packet = C37118.tcp_reassemble(octets[:20], {}, {})
    assert bytes(packet[C37118]) and packet[Padding].load == octets[18:20]
    assert len(layers(C37118.tcp_reassemble(octets, {}, {}))) == 2
    garbage = C37118.tcp_reassemble(b"garbage" + octets, {}, {})
    assert garbage[Raw].load == b"garbage" and garbage[Padding].load == octets
    assert C37118.tcp_reassemble(b"no frame", {}, {})[Raw].load == b"no frame"
    absurd = C37118.tcp_reassemble(b"\xaa\x01\x00\x03" + octets, {}, {})
    assert absurd[Padding].load == octets


def test_tcp_session_over_random_segments(tmp_path: Path) -> None:
    rng = random.Random(5)
    stream = random_stream(rng, formats=[7, 8], frames=30)
    octets = b"".join(frames_of(stream, "cfg3"))
    cuts = [0, *sorted(rng.sample(range(1, len(octets)), 40)), len(octets)]
    segments = [octets[start:end] for start, end in pairwise(cuts)]
    pcap = write_pcap(tmp_path / "split.pcap", tcp_packets(segments, Endpoint("192.0.2.1", TCP_PORT), PDC))
    found = [layer for packet in sniff(offline=str(pcap), session=TCPSession) for layer in layers(packet)]
    assert [bytes(layer)[: layer.framesize] for layer in found] == frames_of(stream, "cfg3")
    assert all(layer.undecoded is None for layer in found)


@pytest.mark.parametrize("name", REAL_CAPTURES)
def test_real_captures(name: str) -> None:
    known, counts = REAL_CAPTURES[name], Counter[int]()

    def look(packet: Packet) -> None:
        for layer in layers(packet):
            counts[layer.type] += 1
            assert layer.undecoded is None
            frame = bytes(layer)[: layer.framesize]
            layer.remove_payload()
            assert rebuilt(layer) == frame
            assert "###[ IEEE C37.118 ]###" in layer.show(dump=True)

    sniff(offline=str(capture_path(name)), session=TCPSession, prn=look, store=False)
    assert counts == {FrameType.CFG2: known.config, FrameType.DATA: known.data, FrameType.COMMAND: known.command}


def test_shows_values_with_their_names(tmp_path: Path) -> None:
    seeded = (random_stream(random.Random(seed), formats=[0b0111], absent=0, long_names=False) for seed in count())
    stream = next(stream for stream in seeded if stream.spec.stations[0].phasors)
    packets = [udp_packet(frame, Endpoint("192.0.2.1", UDP_PORT)) for frame in frames_of(stream, "cfg2")]
    shown = sniff(offline=str(write_pcap(tmp_path / "one.pcap", packets)))[1].show(dump=True)
    station = stream.spec.stations[0]
    magnitude, angle_rad = stream.blocks[0][0].phasors[0]
    unit = "A" if station.phasors[0].current else "V"
    angle = f"{math.degrees(angle_rad):.3f} deg"
    assert f"{station.phasors[0].name.short}: {magnitude:.6g} {unit} at {angle}" in shown
    assert "PMU STATION 0" in shown and "chk" in shown


# --- fuzzing ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["data", "header", "command", "cfg1", "cfg2", "cfg3"])
def test_fuzzed_frames_are_frames(kind: str) -> None:
    stream = random_stream(random.Random(7), formats=[15, 0])
    blocks = {
        "data": lambda: data_blocks(decode_config(stream.config())[1]),
        "cfg2": lambda: [CfgStation(phasor_names=["VA"], phunit=[1])],
        "cfg3": lambda: [Cfg3Station(phasor_names=["VA"], phscale=[PhasorScaling()])],
    }.get(kind, list)
    seen = set()
    for _ in range(20):
        octets = bytes(fuzz(C37118(type=kind, blocks=blocks())))
        assert octets[0] == 0xAA
        assert int.from_bytes(octets[2:4], "big") == len(octets)
        assert not binascii.crc_hqx(octets, 0xFFFF)
        again = C37118(octets)
        assert bytes(again) == octets
        again.show(dump=True)
        seen.add(octets[14:-2])
    assert len(seen) > 10 or kind == "cfg1"


def test_fuzz_of_the_bare_layer_makes_every_type() -> None:
    types = {bytes(fuzz(C37118()))[1] >> 4 & 7 for _ in range(200)}
    assert types == set(range(8))


# --- cost -------------------------------------------------------------------------------------------------------


def test_imports_single_scapy_modules_only() -> None:
    code = "import sys, pmutools.c37118_scapy as s; assert s.C37118; print('scapy.all' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "False"
