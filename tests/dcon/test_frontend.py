"""Which channels of which stream become V1, and what is said of a stream that does not fit."""

from __future__ import annotations

import cmath
import math
import struct
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.swing import START_NS, some

from dcon.frontend import bind
from dcon.replay.difference import identical
from pmutools.c37118 import Frame, PhasorChannel, StreamConfig
from pmutools.c37118.checksum import sealed
from pmutools.errors import SettingsError
from pmutools.flow import StampSource
from pmutools.grid.emulate import EmulatedStream
from pmutools.grid.pmu_model import Measurement, measure
from pmutools.grid.signals import Bus

PHASES = ("VA", "VB", "VC")
PMUS = some(("N1", "N2", "S1"))
BUSES = {"north": Bus(0.3, 0.01, 0.0), "south": Bus(-0.2, -0.02, 0.0, voltage_pu=0.97)}
CONCENTRATOR = EmulatedStream(PMUS, 60, idcode=7)


def reports() -> list[Measurement]:
    return [measure(pmu, BUSES, START_NS, 0) for pmu in PMUS]


def frame(stream: EmulatedStream, arrival_ns: int | None = START_NS + 60_000_000) -> Frame:
    data = stream.data_frame([measure(pmu, BUSES, START_NS, 0) for pmu in stream.pmus])
    return Frame(data, arrival_ns, StampSource.KERNEL, 0)


@pytest.mark.parametrize("voltage", [PHASES, ("V1",)])
@pytest.mark.parametrize("station", [0, 1, 2])
def test_one_station_of_a_concentrator(station: int, voltage: tuple[str, ...]) -> None:
    name = PMUS[station].name
    binding = bind("X", CONCENTRATOR.config, rate_hz=60, voltage=voltage, station=name)
    read = binding.read(frame(CONCENTRATOR))
    assert read is not None
    sample, logged = read.sample, read.entry()
    expected = reports()[station]
    assert sample.v1 == pytest.approx(expected.v1, rel=1e-6)
    assert (sample.time_ns, sample.arrival_ns, sample.stat) == (START_NS, START_NS + 60_000_000, 0)
    assert sample.frequency_hz == pytest.approx(expected.frequency_hz, rel=1e-6)
    assert (logged.name, logged.v1, logged.wire) == ("X", sample.v1, frame(CONCENTRATOR).data)
    assert len(logged.phasors) == 15 and logged.station_stat == (0, 0, 0)
    assert logged.frequency_hz == sample.frequency_hz == logged.station_frequency_hz[station]


def test_v1_of_phases_is_free_of_negative_and_zero_sequence() -> None:
    """A negative- and a zero-sequence part on top of 1∠20° leave V1 as it is."""
    a = cmath.rect(1, 2 * math.pi / 3)
    v1, v2, v0 = cmath.rect(300e3, math.radians(20)), cmath.rect(9e3, 1.0), cmath.rect(5e3, -2.0)
    phases = (v1 + v2 + v0, a**2 * v1 + a * v2 + v0, a * v1 + a**2 * v2 + v0)
    stream = EmulatedStream(PMUS[:1], 60)
    report = reports()[0]._replace(va=phases[0], vb=phases[1], vc=phases[2])
    read = bind("N1", stream.config, rate_hz=60, voltage=PHASES).read(
        Frame(stream.data_frame([report]), None, StampSource.KERNEL, 0)
    )
    assert read is not None
    assert read.sample.v1 == pytest.approx(v1, rel=1e-6)
    assert read.sample.arrival_ns == START_NS  # nobody took the arrival
    assert read.entry().arrival_ns is None


def test_a_frame_of_another_size_is_not_read() -> None:
    binding = bind("N1", EmulatedStream(PMUS[:1], 60).config, rate_hz=60, voltage=PHASES)
    assert binding.read(frame(CONCENTRATOR)) is None


def changed(config: StreamConfig, **station: object) -> StreamConfig:
    first, *others = config.stations
    return replace(config, stations=(replace(first, **station), *others))  # type: ignore[arg-type]


SINGLE = EmulatedStream(PMUS[:1], 60).config
MANY = replace(SINGLE, stations=tuple(replace(SINGLE.stations[0], name=f"S{k}") for k in range(2000)))


@pytest.mark.parametrize(
    ("config", "wanted", "message"),
    [
        (
            EmulatedStream(PMUS[:1], 50).config,
            {},
            "PMU N1: its stream 101 sends 50 frames/s, the controller runs at 60; set rate = 50 for all PMUs, or the "
            "PMU to 60 frames/s",
        ),
        (replace(SINGLE, data_rate=-2), {}, "sends 0.5 frames/s"),
        (replace(SINGLE, data_rate=0), {}, "sends 0 frames/s"),
        (changed(SINGLE, fnom=1), {}, "PMU N1: station N1 measures a 50 Hz grid, not 60 Hz"),
        (CONCENTRATOR.config, {}, "PMU N1: its stream 7 carries 3 stations; pick one with station = N1 | N2 | S1"),
        (CONCENTRATOR.config, {"station": "N9"}, "PMU N1: stream 7 has no station 'N9'; it has N1, N2, S1"),
        (replace(SINGLE, stations=()), {}, "carries 0 stations"),
        (
            MANY,
            {},
            "carries 2000 stations; pick one with station = S0 | S1 | S2 | S3 | S4 | S5 | S6 | S7 and 1992 more",
        ),
        (MANY, {"station": "N9"}, "no station 'N9'; it has S0, S1, S2, S3, S4, S5, S6, S7 and 1992 more"),
        (
            changed(SINGLE, phasors=tuple(PhasorChannel(f"V{k}", 1) for k in range(900))),
            {},
            "has no channel 'VA'; it has V0, V1, V2, V3, V4, V5, V6, V7 and 892 more",
        ),
        (SINGLE, {"voltage": ("VX",)}, "PMU N1: station N1 has no channel 'VX'; it has VA, VB, VC, V1"),
        (SINGLE, {"voltage": ("I1",)}, "PMU N1: channel 'I1' of station N1 is a current"),
        (changed(SINGLE, phasors=()), {}, "has no channel 'VA'; it has no voltage phasors"),
    ],
)
def test_a_stream_that_does_not_fit_is_one_line(config: StreamConfig, wanted: dict[str, object], message: str) -> None:
    given: dict[str, object] = {"rate_hz": 60, "voltage": PHASES, **wanted}
    with pytest.raises(SettingsError) as caught:
        bind("N1", config, **given)  # type: ignore[arg-type]
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_bindings_that_read_alike() -> None:
    def binding(config: StreamConfig, voltage: tuple[str, ...] = PHASES, station: str | None = None) -> object:
        return bind("N1", config, rate_hz=60, voltage=voltage, station=station)

    one = bind("N1", SINGLE, rate_hz=60, voltage=PHASES)
    renamed = changed(SINGLE, name="OTHER", cfgcnt=7)
    assert one.reads_like(bind("N1", renamed, rate_hz=60, voltage=PHASES))
    scaled = changed(SINGLE, phasors=(PhasorChannel("VA", 1), *SINGLE.stations[0].phasors[1:]))
    for other in (
        bind("N1", changed(SINGLE, phasors=SINGLE.stations[0].phasors[::-1]), rate_hz=60, voltage=PHASES),
        bind("N1", SINGLE, rate_hz=60, voltage=("V1",)),
        bind("N1", CONCENTRATOR.config, rate_hz=60, voltage=PHASES, station="N1"),
        bind("N1", replace(SINGLE, time_base=1000), rate_hz=60, voltage=PHASES),
    ):
        assert not one.reads_like(other)
    assert one.reads_like(bind("N1", scaled, rate_hz=60, voltage=PHASES))  # floats have no PHUNIT to scale by


NUMBERS = st.one_of(st.floats(width=32), st.sampled_from((0.0, -0.0, math.inf, -math.inf, math.nan, 3.4e38)))


@settings(max_examples=150, deadline=None)
@given(st.lists(NUMBERS, min_size=12, max_size=12), st.integers(0, 0xFFFF), st.integers(0, 0xFF))
def test_the_short_way_of_reading_is_the_decoders(numbers: list[float], stat: int, quality: int) -> None:
    """Any values that float phasors can have, NaN and infinity too: to the last bit."""
    stream = EmulatedStream(PMUS[:1], 60)
    prefix = (0xAA01, stream.config.frame_size, stream.config.idcode, START_NS // 10**9, quality << 24)
    head = struct.pack(">HHHII", *prefix)
    data = sealed(head + struct.pack(">H12f", stat, *numbers))
    binding = bind("N1", stream.config, rate_hz=60, voltage=PHASES)
    assert len(binding.places) == 3
    plain = replace(binding, places=())
    frame_ = Frame(data, START_NS + 60_000_000, StampSource.KERNEL, 0)
    short, long = binding.read(frame_), plain.read(frame_)
    assert short is not None and long is not None
    assert identical(short.sample, long.sample)


def test_negative_sequence_comes_with_three_phases_alone() -> None:
    stream = EmulatedStream(PMUS[:1], 60)
    v1, v2 = 288e3 + 0j, 3e3 + 4e3j
    a = complex(-0.5, math.sqrt(3) / 2)
    report = Measurement(START_NS, v1 + v2, v1 / a + v2 * a, v1 * a + v2 / a, v1, 0j, 60.0, 0.0)
    sent = Frame(stream.data_frame([report]), None, StampSource.KERNEL, 0)
    three, one = (bind("N1", stream.config, rate_hz=60, voltage=v).read(sent) for v in (PHASES, ("V1",)))
    assert three is not None and one is not None
    assert three.sample.v1 == pytest.approx(v1, rel=1e-6) and three.sample.v2 == pytest.approx(v2, rel=1e-4)
    assert one.sample.v1 == pytest.approx(v1, rel=1e-6) and math.isnan(one.sample.v2.real)
