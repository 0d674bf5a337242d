"""The engine: bytes in, records out; what it cannot read it counts, and a changed stream it verifies anew."""

from __future__ import annotations

import math
import random
import struct
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.swing import MS, START_NS, SWING_HZ, SWING_MHZ, Streams

from dcon.core.differentiator import PAPER_60, response
from dcon.core.values import DETAIL, InstanceState, Record, SystemState
from dcon.engine import Engine
from pmutools.c37118 import Format, Frame, FrameType, PhasorChannel, PhasorScale, StreamConfig
from pmutools.c37118.checksum import chk
from pmutools.flow import StampSource
from pmutools.grid.emulate import EmulatedStream


class Bench:
    """An engine on a pair of swinging PMUs."""

    def __init__(self, names: tuple[str, ...] = ("N1", "S1"), **given: object) -> None:
        self.streams = Streams(names)
        chosen = self.streams.settings(**given)
        self.engine = Engine(chosen.params, chosen.sites)
        self.slot = 0
        for name, stream in self.streams.streams.items():
            self.engine.configure(name, stream.config)

    def tick(self, frames: dict[str, list[Frame]] | None = None) -> Record:
        frames = self.streams.frames(self.slot) if frames is None else frames
        now_ns = self.streams.stamp_ns(self.slot) + 71 * MS
        self.slot += 1
        return self.engine.tick(frames, (), now_ns).record

    def run(self, ticks: int) -> list[Record]:
        return [self.tick() for _ in range(ticks)]


def names(record: Record) -> list[str]:
    return [f"{event.name} {event.subject}" for event in record.events]


def test_the_swing_that_was_sent_is_the_swing_that_is_seen() -> None:
    """Amplitude and lag are those of the filter at 0.4 Hz, to the rounding of 32-bit floats on the wire."""
    records = Bench().run(300)
    z = complex(math.cos(2 * math.pi * SWING_HZ / 60), math.sin(2 * math.pi * SWING_HZ / 60))
    seen = response(PAPER_60, z) / (1j * SWING_HZ)
    for slot in range(150, 300):
        w_t = 2 * math.pi * SWING_HZ * slot / 60
        expected = SWING_MHZ * (seen * complex(math.sin(w_t), -math.cos(w_t))).real
        assert records[slot].delta_f_mhz == pytest.approx(expected, abs=5e-3)
    assert records[-1].state is SystemState.STANDBY


def test_frames_are_handed_on_in_the_order_consumed() -> None:
    bench = Bench()
    late = bench.streams.frame("N1", 1)
    frames = {"S1": [bench.streams.frame("S1", 0)], "N1": [late, bench.streams.frame("N1", 0)]}
    tick = bench.engine.tick(frames, (), START_NS + 71 * MS)
    assert [(frame.name, frame.time_ns) for frame in tick.frames] == [
        ("S1", START_NS),
        ("N1", START_NS + 16_667_000),
        ("N1", START_NS),
    ]
    assert tick.frames[1].wire == late.data


def test_what_cannot_be_read_is_counted_and_missing() -> None:
    bench = Bench()
    bench.engine.bindings.pop("S1")
    good = bench.streams.frame("N1", 0)
    short = good._replace(data=good.data[:-4] + chk(good.data[:-4]).to_bytes(2, "big"))
    foreign = good._replace(data=bench.streams.data("S1", START_NS))
    record = bench.tick({"N1": [short, foreign, good], "S1": [bench.streams.frame("S1", 0)], "N9": [good]})
    assert bench.engine.unread == {"N1": 2, "S1": 1, "N9": 1}
    assert math.isfinite(record.age_ms[0]) and math.isnan(record.age_ms[1])


def test_a_configuration_of_nobody() -> None:
    bench = Bench()
    problem = bench.engine.reconfigure("N9", bench.streams.streams["N1"].config)
    assert problem == "no PMU 'N9' in the settings; there are N1, S1"
    assert names(bench.tick()) == ["no_ready_instance system", "config_unusable N9"][::-1]


def test_the_same_configuration_again_changes_nothing() -> None:
    bench, other = Bench(), Bench()
    for one in (bench, other):
        one.run(60)
    assert bench.engine.reconfigure("N1", EmulatedStream(bench.streams.pmus[:1], 60).config) is None
    assert bench.run(60) == other.run(60)


def station(config: StreamConfig, **given: object) -> StreamConfig:
    return replace(config, stations=(replace(config.stations[0], **given),))  # type: ignore[arg-type]


def test_a_change_that_moves_nothing_is_an_event_and_no_more() -> None:
    bench = Bench()
    bench.run(60)
    assert bench.engine.state.instances[0].is_ready
    config = bench.streams.streams["N1"].config
    assert bench.engine.reconfigure("N1", station(config, name="RENAMED", cfgcnt=1)) is None
    record = bench.tick()
    assert names(record) == ["config_changed N1"]
    assert record.instances[0].state is InstanceState.READY


def test_a_change_that_moves_channels_starts_the_pmu_again() -> None:
    bench = Bench(("N1", "N2", "S1"))
    bench.run(60)
    assert bench.engine.reconfigure("N1", bench.streams.slim("N1")) is None
    record = bench.tick()
    assert names(record)[0] == "config_changed N1"
    assert record.instances[0].state is InstanceState.DISABLED  # N1-S1, until it has been verified anew
    assert record.instances[1].state is InstanceState.READY  # N2-S1
    assert "selected N2-S1" in names(record)
    later = bench.run(40)
    assert bench.engine.unread == {} and later[-1].instances[0].state is InstanceState.READY


def test_what_is_said_of_a_stream_in_its_own_words_is_brief() -> None:
    """Names of CFG-3 have 255 bytes: fifty such events in a status would be cut off."""
    bench = Bench()
    config = bench.streams.streams["N1"].config
    channels = tuple(PhasorChannel(f"{k}" + 120 * "é", 1) for k in range(100))
    problem = bench.engine.reconfigure("N1", replace(station(config, phasors=channels), kind=FrameType.CFG3))
    assert problem is not None and len(problem) == DETAIL and problem.startswith("PMU N1: station N1 has no channel")
    (event,) = (event for event in bench.tick().events if event.name == "config_unusable")
    assert event.detail == problem


def test_an_unusable_configuration_costs_the_pmu_until_a_good_one_comes() -> None:
    bench = Bench()
    bench.run(60)
    config = bench.streams.streams["N1"].config
    problem = bench.engine.reconfigure("N1", replace(config, data_rate=50))
    assert problem is not None and "sends 50 frames/s" in problem
    record = bench.tick()
    assert names(record) == ["config_unusable N1", "unread_frame N1"]
    later = bench.run(6)
    assert any("arrival_gap N1" in names(record) for record in later)
    assert later[-1].instances[0].state is InstanceState.DISABLED
    assert bench.engine.unread["N1"] == 7
    assert bench.engine.reconfigure("N1", config) is None
    assert names(bench.tick()) == ["config_changed N1"]
    assert bench.run(40)[-1].instances[0].state is InstanceState.READY


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32))
def test_no_content_of_a_frame_stops_the_controller(seed: int) -> None:
    """Frames of the right length and any content at all, between good ones: every record is whole and finite."""
    rng = random.Random(seed)
    bench = Bench()
    size = bench.streams.streams["N1"].config.frame_size
    for _ in range(8):
        good = bench.streams.frames(bench.slot)
        for name in good:
            for _ in range(rng.randrange(3)):
                head = good[name][0].data[: rng.choice((6, 14))]  # any stamp, or the right one
                body = head + rng.randbytes(size - 2 - len(head))
                wild = Frame(body + chk(body).to_bytes(2, "big"), rng.randrange(2**62), StampSource.KERNEL, 0)
                good[name].insert(rng.randrange(2), wild)
        record = bench.tick(good)
        assert math.isfinite(record.command_mw) and record.output_v == 0.0
        assert record.state is not SystemState.FAULT, record.events


@settings(max_examples=150, deadline=None)
@given(seed=st.integers(0, 2**32))
def test_any_configuration_is_taken_or_refused_in_one_line(seed: int) -> None:
    rng = random.Random(seed)
    bench = Bench()
    config = bench.streams.streams["N1"].config
    numbers = (0.0, 1.0, -1e-3, 1e38, math.inf, -math.inf, math.nan)
    channels = tuple(
        PhasorChannel(
            name,
            rng.getrandbits(32),
            rng.choice((None, PhasorScale(0, rng.getrandbits(8), 0, rng.choice(numbers), rng.choice(numbers)))),
        )
        for name in rng.choice((("VA", "VB", "VC"), ("VC", "X", "VB", "VA"), ("", "VA"), ()))
    )
    odd = replace(
        station(config, phasors=channels, format=Format(rng.getrandbits(4)), fnom=rng.choice((0, 0, 1))),
        data_rate=rng.choice((60, 60, 60, 50, 0, -1, 32767, -32768)),
        time_base=rng.choice((1, 1_000_000, 2**24 - 1)),
    )
    problem = bench.engine.reconfigure("N1", rng.choice((odd, odd, replace(odd, stations=()))))
    assert problem is None or (problem and "\n" not in problem)
    head = struct.pack(">HHHII", 0xAA01, odd.frame_size, odd.idcode, START_NS // 10**9, 0)
    for _ in range(3):
        body = head + rng.choice((rng.randbytes, bytes))(odd.frame_size - 16)
        frame = Frame(body + chk(body).to_bytes(2, "big"), START_NS + 60 * MS, StampSource.CAPTURE, 0)
        record = bench.tick({"N1": [frame]})
        assert math.isfinite(record.command_mw)
        assert record.state is not SystemState.FAULT, record.events
        assert bench.engine.unread.get("N1", 0) == (0 if problem is None else bench.slot)
