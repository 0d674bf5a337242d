"""The codec, the random frames and tshark read the same; and the harness that says so would notice if not."""

from __future__ import annotations

import binascii
import json
import random
from collections import Counter
from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pytest
from support.captures import PDC, REAL_CAPTURES, Endpoint, capture_path, tcp_packets, udp_packet, write_pcap
from support.frames import ALL_FORMATS, Described, Object, command_frame, header_frame, random_stream
from support.meaning import expected_command, expected_header
from support.tshark import Masked, differences, dissect, masked
from support.wire import (
    EPOCH,
    AnalogSpec,
    Block,
    Name,
    PhasorSpec,
    Stamp,
    StationSpec,
    StreamSpec,
    WordSpec,
)

from pmutools.c37118.demux import Demux
from pmutools.cli import pmu
from pmutools.cli.shell import run
from pmutools.flow import Chunk, Flow
from pmutools.formats.describe import describe

pytestmark = pytest.mark.peer
FIRST_PORT = 20000
DECODE_AS = (f"udp.port=={FIRST_PORT}-29999", f"tcp.port=={FIRST_PORT}-29999")


class Generated(NamedTuple):
    """Frames of random streams in a capture file, what they say, and what tshark says of them."""

    pcap: Path
    frames: list[bytes]
    expected: list[Object]
    oracle: list[Object]


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Generated:
    rng = random.Random(37118)
    frames, expected, packets = [], [], []
    for index in range(256):
        formats = [index % 16, *rng.choices(ALL_FORMATS, k=rng.randint(0, 3))]
        stream = random_stream(rng, formats=formats, frames=3, idcode=FIRST_PORT + index)
        kind = rng.choice(("cfg2", "cfg3"))
        mine = [stream.config("cfg1"), stream.config(kind), *stream.data]
        expected += [stream.expected_config("cfg1"), stream.expected_config(kind), *stream.expected_data(kind)]
        packets += [udp_packet(frame, Endpoint("192.0.2.1", FIRST_PORT + index)) for frame in mine]
        frames += mine
    pcap = write_pcap(tmp_path_factory.mktemp("oracle") / "generated.pcap", packets)
    return Generated(pcap, frames, expected, dissect(pcap, decode_as=DECODE_AS))


@cache
def real(name: str) -> list[Object]:
    """tshark's reading of a real capture."""
    return dissect(capture_path(name))


def dumped(pcap: Path, capsys: pytest.CaptureFixture[str]) -> list[Object]:
    """What ``pmu dump --json`` prints."""
    assert run(pmu(), ["dump", str(pcap), "--json"]) == 0
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_random_frames_say_what_tshark_reads(generated: Generated) -> None:
    assert len(generated.frames) > 1000
    assert differences(generated.expected, generated.oracle, ignore=["arrival_ns"]) == []
    assert set(masked(generated.oracle)) == {"freq-filler", "rocof-filler", "cfg3-float-scaling"}


def test_dump_prints_what_tshark_reads_of_random_frames(
    generated: Generated, capsys: pytest.CaptureFixture[str]
) -> None:
    assert differences(dumped(generated.pcap, capsys), generated.oracle) == []


@pytest.mark.parametrize("name", REAL_CAPTURES)
def test_dump_prints_what_tshark_reads_of_real_captures(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert differences(dumped(capture_path(name), capsys), real(name)) == []


def test_codec_reads_what_tshark_reads(generated: Generated) -> None:
    demux = Demux()
    items = [
        item
        for index, frame in enumerate(generated.frames)
        for item in demux.feed(Chunk(frame, None, Flow("udp", f"192.0.2.1:{index // 5}", "192.0.2.2:4713")))
    ]
    assert differences(map(describe, items), generated.oracle, ignore=["arrival_ns"]) == []


def test_commands_and_headers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    codes = (0, 1, 2, 3, 4, 5, 6, 7, 8, 0x00FF, 0x0100, 0x0FFF, 0x1000, 0xFFFF)
    frames = [command_frame(241, code) for code in codes]
    frames += [command_frame(241, 8, extended=b"\x01\x02\xff\x00"), header_frame(241, "A PMU, 50 frames/s")]
    expected = [expected_command(241, code, EPOCH, 1) for code in codes]
    expected.append(expected_command(241, 8, EPOCH, 1, b"\x01\x02\xff\x00"))
    expected.append(expected_header(241, "A PMU, 50 frames/s", EPOCH, 1))
    oracle = dissect(write_pcap(tmp_path / "commands.pcap", [udp_packet(frame) for frame in frames]))
    assert differences(expected, oracle, ignore=["arrival_ns"]) == []
    assert set(masked(oracle)) == {"command-time"}
    assert differences(dumped(tmp_path / "commands.pcap", capsys), oracle) == []


@pytest.mark.parametrize("name", REAL_CAPTURES)
def test_counts_of_real_captures(name: str) -> None:
    """Against the numbers in the recordings' own README."""
    oracle, known = real(name), REAL_CAPTURES[name]
    counts = Counter(frame["type"] for frame in oracle)
    assert counts == {"cfg2": known.config, "data": known.data, "command": known.command}
    assert {frame["idcode"] for frame in oracle} == {known.idcode}
    assert all(frame["chk_ok"] for frame in oracle)
    assert set(masked(oracle)) == {"command-time"}
    assert all(not isinstance(frame["stations"], Masked) for frame in oracle if frame["type"] == "data")


def test_segments_split_and_coalesced_at_random(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = random.Random(2)
    stream = random_stream(rng, formats=[6, 15], frames=40)
    octets = b"".join((stream.config(), *stream.data))
    cuts = [0, *sorted(rng.sample(range(1, len(octets)), 60)), len(octets)]
    segments = [octets[start:end] for start, end in pairwise(cuts)]
    packets = tcp_packets(segments, Endpoint("192.0.2.1", 4712), PDC)
    oracle = dissect(write_pcap(tmp_path / "segments.pcap", packets))
    expected = [stream.expected_config(), *stream.expected_data()]
    assert differences(expected, oracle, ignore=["arrival_ns"]) == []
    assert differences(dumped(tmp_path / "segments.pcap", capsys), oracle) == []


def test_data_without_configuration_is_not_compared(tmp_path: Path) -> None:
    stream = random_stream(random.Random(3), formats=[0])
    oracle = dissect(write_pcap(tmp_path / "late.pcap", [udp_packet(frame) for frame in stream.data]))
    assert all(frame["stations"] == Masked("no-config") for frame in oracle)
    assert differences(stream.expected_data(), oracle, ignore=["arrival_ns"]) == []


# --- the harness itself -----------------------------------------------------------------------------------------


def _flipped(frame: bytes, bit: int) -> bytes:
    """``frame`` with one bit changed and CHK made right again."""
    octets = bytearray(frame[:-2])
    octets[bit // 8] ^= 0x80 >> bit % 8
    return bytes(octets) + binascii.crc_hqx(bytes(octets), 0xFFFF).to_bytes(2, "big")


def _differ(expected: Object, oracle: Object) -> list[str]:
    return differences([expected], [oracle], ignore=["arrival_ns"])


def _small_stream() -> Described:
    """A stream none of whose values hides a changed bit: no factor and no magnitude is zero."""
    labels = tuple(Name(f"L{bit}", f"L{bit}") for bit in range(16))

    def station(fmt: int) -> StationSpec:
        phasor, analog = PhasorSpec(Name("VA", "VA"), False, 915527), AnalogSpec(Name("P", "P"))
        return StationSpec(Name("A", "A"), 1, fmt, (phasor,), (analog,), (WordSpec(labels),))

    blocks = (
        Block(0, ((100.5, -20.25),), 60.125, -0.5, (77,), (0x3C12,)),
        Block(0x0800, ((14635, 4321),), -250, 12, (1e3,), (0x00FF,)),
    )
    spec = StreamSpec(7734, (station(0b1010), station(0b0101)), 30, 1_000_000)
    return Described(spec, EPOCH, (Stamp(1149580800, 0, 16817),), (blocks,))


def _dissected(frames: Sequence[bytes], path: Path) -> list[Object]:
    """Each frame in a conversation of its own, which the stream's true configuration opens."""
    packets = []
    for index, frame in enumerate(frames):
        source = Endpoint("192.0.2.1", FIRST_PORT + index)
        packets += [udp_packet(_small_stream().config(), source), udp_packet(frame, source)]
    return dissect(write_pcap(path, packets), decode_as=DECODE_AS)[1::2]


def test_harness_notices_every_flipped_bit_of_a_data_frame(tmp_path: Path) -> None:
    (frame,), (expected,) = _small_stream().data, _small_stream().expected_data()
    bits = range(4 * 8, (len(frame) - 2) * 8)  # SYNC and FRAMESIZE would make it another frame
    oracle = _dissected([_flipped(frame, bit) for bit in bits], tmp_path / "bits.pcap")
    assert len(oracle) == len(bits)
    unnoticed = [bit for bit, one in zip(bits, oracle, strict=True) if not _differ(expected, one)]
    assert unnoticed == []
    (true,) = _dissected([frame], tmp_path / "true.pcap")
    assert not _differ(expected, true)


def test_harness_notices_flipped_bits_of_a_configuration(tmp_path: Path) -> None:
    stream = random_stream(random.Random(8), formats=[0b1010], frames=1, long_names=False)
    frame, expected = stream.config("cfg3"), stream.expected_config("cfg3")
    tail = range((len(frame) - 8) * 8, (len(frame) - 2) * 8)  # FNOM, CFGCNT, DATA_RATE; counts would break the layout
    reserved = range(tail.start, tail.start + 15)
    frames = [_flipped(frame, bit) for bit in tail if bit not in reserved]
    oracle = dissect(write_pcap(tmp_path / "bits.pcap", [udp_packet(one) for one in frames]))
    assert all(_differ(expected, one) for one in oracle)


def test_harness_reports_a_wrong_chk(tmp_path: Path) -> None:
    stream = _small_stream()
    damaged = stream.data[0][:-1] + bytes((stream.data[0][-1] ^ 1,))
    (one,) = _dissected([damaged], tmp_path / "chk.pcap")
    assert one["chk_ok"] is False


@pytest.mark.parametrize(
    ("mine", "found"),
    [
        ({"type": "data", "a": 1}, 1),
        ({"type": "data"}, 1),
        ({"type": "data", "a": 2, "b": 0}, 1),
        ({"type": "data", "a": 2}, 0),
    ],
)
def test_differences_counts_each_key(mine: Object, found: int) -> None:
    assert len(differences([mine], [{"type": "data", "a": 2}])) == found


def test_differences_judges_a_phasor_by_its_magnitude() -> None:
    oracle = {"type": "data", "re": 1e5, "im": 1e-9}
    assert differences([{"type": "data", "re": 1e5, "im": 0.0}], [oracle]) == []
    assert len(differences([{"type": "data", "re": 1e5, "im": 1e-3}], [oracle])) == 1
    assert len(differences([{"type": "data", "re": None, "im": None}], [oracle])) == 2
