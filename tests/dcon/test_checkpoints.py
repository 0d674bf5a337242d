"""Checkpoints: a memory comes back from its text to the last bit, and an engine that is given it goes on alike."""

from __future__ import annotations

import json
import math
import random
import struct
from collections.abc import Mapping
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.random_sessions import FOUR, session
from support.rig import Rig, steady
from support.swing import MS, Streams

from dcon.core.checks import Scope
from dcon.core.differentiator import Filter
from dcon.core.rows import CORE
from dcon.core.state import State, initial_state
from dcon.core.step import step
from dcon.core.thresholds import RING_SIZE
from dcon.core.values import Event, Flag
from dcon.engine import Engine, Memory
from dcon.session import checkpoint
from dcon.session.checkpoint import LAYOUT, MOST_BYTES, decode_checkpoint, encode_checkpoint, text_of
from dcon.session.encode import tick_entries
from pmutools.c37118 import StreamConfig
from pmutools.schema.descriptors import message_class


def exact(value: object) -> object:
    """``value`` with the type of everything in it, and every float as its eight bytes; one NaN."""
    if isinstance(value, float):
        return struct.pack(">d", math.nan if math.isnan(value) else value)
    if isinstance(value, complex):
        return exact((value.real, value.imag))
    if isinstance(value, Mapping):
        return tuple((exact(key), exact(each)) for key, each in value.items())
    if isinstance(value, tuple):
        return type(value).__name__, tuple(map(exact, value))
    return type(value).__name__, value


def back(memory: Memory) -> Memory:
    """``memory`` from its message."""
    data = encode_checkpoint(1, memory)
    assert data is not None
    decoded = decode_checkpoint(message_class("Checkpoint").FromString(data))
    assert decoded is not None
    return decoded


def remembered(state: State) -> Memory:
    return Memory(state, (Event("config_changed", "N1", "data frames of 60 bytes"),), (("N1", "0123456789abcdef"),))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32), faulty=st.sampled_from((0.0, 0.02, 0.3)))
def test_whatever_happens_the_controller_goes_on_alike_from_its_text(seed: int, faulty: float) -> None:
    """At random ticks the state is replaced by what its text gives: no record is another, to the last bit."""
    draw = random.Random(seed)
    one = other = initial_state(FOUR, verified=draw.random() < 0.5)
    for inputs, now_ns in session(seed, 240, faulty):
        if draw.random() < 0.2:
            memory = back(remembered(other))
            assert exact(memory) == exact(remembered(one))
            other = memory.state
        one, record = step(FOUR, one, inputs, now_ns)
        other, again = step(FOUR, other, inputs, now_ns)
        assert exact(again) == exact(record)
    assert text_of(remembered(one)) == text_of(remembered(other))


def test_every_kind_of_number_comes_back() -> None:
    state = initial_state(FOUR)
    numbers = (0.0, -0.0, math.nan, math.inf, -math.inf, 5e-324, 1.7976931348623157e308, 0.1, 1 / 3)
    pmu = state.pmus[0]._replace(
        ring=numbers, v1=complex(-0.0, math.nan), filter=Filter(*numbers[:4], 3), evidence=((1 << 63, -0.0),)
    )
    state = state._replace(pmus=(pmu, *state.pmus[1:]), overruns=(1 << 3600) - 1, gain_mw_per_mhz=9)
    memory = remembered(state)
    assert exact(back(memory)) == exact(memory)


class Site:
    """An engine on two PMUs whose configurations change, frame by frame; another may take over at any tick."""

    def __init__(self) -> None:
        self.streams = Streams()
        self.chosen = self.streams.settings()
        self.engine = self.fresh()
        self.sent = dict(self.streams.configs)
        """Newest configuration of each PMU, usable or not."""
        for name, config in self.sent.items():
            self.engine.reconfigure(name, config)

    def fresh(self) -> Engine:
        return Engine(self.chosen.params, self.chosen.sites)

    def configure(self, name: str, config: StreamConfig) -> None:
        self.sent[name] = config
        self.engine.reconfigure(name, config)

    def change(self, slot: int) -> None:
        """What comes before a tick."""
        config = self.streams.configs["N1"]
        if slot == 70:
            self.configure("N1", self.streams.slim("N1"))
        elif slot == 90:
            self.configure("S1", replace(self.streams.configs["S1"], data_rate=50))
        elif slot == 110:
            self.configure("S1", self.streams.configs["S1"])
        elif slot == 130:
            renamed = replace(config.stations[0], name="RENAMED")
            self.configure("N1", replace(config, stations=(renamed,)))


def test_an_engine_goes_on_from_any_tick_whatever_configurations_did() -> None:
    """From each tick another engine takes over for a while: amid changes, their events, and unusable ones too."""
    site = Site()
    records, memories, frames, sent = [], [], [], []
    for slot in range(160):
        site.change(slot)
        given = {} if slot % 37 == 5 else site.streams.frames(slot)
        now_ns = site.streams.stamp_ns(slot) + 71 * MS
        tick = site.engine.tick(given, (), now_ns)
        records.append(tick.record)
        memories.append(back(tick.memory))
        frames.append((given, now_ns))
        sent.append(dict(site.sent))
    assert {event.name for record in records for event in record.events} >= {"config_changed", "config_unusable"}
    assert any(memory.notes for memory in memories)
    for begin in range(0, 160, 3):
        engine = site.fresh()
        engine.resume(memories[begin], sent[begin])
        for slot in range(begin, min(begin + 30, 160)):
            if sent[slot] != sent[slot - 1] and slot > begin:
                for name, config in sent[slot].items():
                    engine.reconfigure(name, config)
            given, now_ns = frames[slot]
            tick = engine.tick(given, (), now_ns)
            assert exact(tick.record) == exact(records[slot]), (begin, slot)
            assert exact(tick.memory) == exact(memories[slot])


def test_an_engine_refuses_a_memory_of_other_configurations() -> None:
    site = Site()
    memory, before = site.engine.memory, dict(site.sent)
    site.configure("N1", site.streams.slim("N1"))
    engine = site.fresh()
    for configs in (site.sent, {"N1": before["N1"]}, {**before, "N9": before["N1"]}):
        with pytest.raises(ValueError, match="other configurations"):
            engine.resume(memory, configs)
    engine.resume(memory, before)
    assert exact(engine.memory) == exact(memory)


def test_equal_configurations_have_one_digest_and_others_another() -> None:
    streams = Streams()
    config = streams.configs["N1"]
    assert replace(config).digest == config.digest and len(config.digest) == 16
    others = [replace(config, idcode=9), replace(config, data_rate=50), streams.configs["S1"], streams.slim("N1")]
    assert len({config.digest, *(other.digest for other in others)}) == 5


def text_with(change: object, *path: int) -> str:
    """The text of a memory with the value at ``path`` replaced."""
    values = json.loads(text_of(remembered(initial_state(FOUR))))
    inner = values
    for place in path[:-1]:
        inner = inner[place]
    inner[path[-1]] = change
    return json.dumps(values)


SENSELESS = {
    "no JSON": "[[",
    "nothing": "",
    "another value": '{"state": 1}',
    "a field too few": "[[], []]",
    "a field too many": text_with([[], [], [], 1], 0),
    "text for a number": text_with("9", 0, 5),
    "a truth for a number": text_with(True, 0, 5),
    "a fraction for a count": text_with(1.5, 0, 9),
    "a state that is none": text_with("ASLEEP", 0, 2),
    "half a complex number": text_with([1.0], 0, 0, 0, 4),
    "no list": text_with(7, 0, 0),
    "text for a list": text_with("abc", 0, 0),
    "a number in a list of lists": text_with("abc", 0, 0, 0),
    "very deep": "[" * 100_000,
}


@pytest.mark.parametrize("text", SENSELESS.values(), ids=SENSELESS)
def test_what_makes_no_sense_is_none(text: str) -> None:
    assert decode_checkpoint(message_class("Checkpoint")(layout=LAYOUT, memory=text)) is None


@given(st.text() | st.recursive(st.none() | st.booleans() | st.floats() | st.text(), st.lists).map(json.dumps))
def test_no_text_is_an_error(text: str) -> None:
    assert decode_checkpoint(message_class("Checkpoint")(layout=LAYOUT, memory=text)) is None


def test_another_layout_is_passed_over() -> None:
    text = text_of(remembered(initial_state(FOUR)))
    assert decode_checkpoint(message_class("Checkpoint")(layout="0" * 16, memory=text)) is None
    assert decode_checkpoint(None) is None


def test_the_layout_is_of_the_fields_and_of_the_checks() -> None:
    described = checkpoint._described(Memory)
    for name in (*State._fields, *Memory._fields, *Filter._fields):
        assert f"{name}:" in described
    assert checkpoint._layout(Memory, CORE.names) == LAYOUT
    assert len({LAYOUT, checkpoint._layout(State, CORE.names), checkpoint._layout(Memory, CORE.names[:-1])}) == 3


def test_a_memory_that_is_too_large_is_left_out() -> None:
    rig = Rig(steady())
    rig.run(30)
    memory = rig.engine.memory
    notes = (Event("x", "system", "y" * MOST_BYTES),)
    for kept, count in ((memory, 1), (memory._replace(notes=notes), 0)):
        entries = tick_entries(rig.settings.params.instance_names, rig.records[-1], memory=kept)
        assert [entry.message for entry in entries].count("Checkpoint") == count
    assert len(text_of(memory)) < MOST_BYTES / 4


def test_the_largest_memory_of_eight_pmus_is_not_left_out() -> None:
    """Every list as long as it gets, every check up for every PMU, instance and the system."""
    rig = Rig(steady(("N1", "N2", "N3", "N4", "S1", "S2", "S3", "S4")))
    rig.run(60)
    assert len(rig.settings.params.instances) == 16 and len(rig.engine.state.pmus[0].ring) == RING_SIZE
    memory = rig.engine.memory
    subjects = {
        Scope.PMU: [pmu.name for pmu in rig.pmus],
        Scope.INSTANCE: rig.settings.params.instance_names,
        Scope.SYSTEM: ["system"],
    }
    numbers = (2**62, 2**62, 2**31, -1e-300 / 3, -1e-300 / 3)
    up = [
        Flag(row.name, subject, True, *numbers, True, "x" * 32) for row in CORE.rows for subject in subjects[row.scope]
    ]
    flags = {(flag.name, flag.subject): flag for flag in up}
    assert len(flags) == 8 * 22 + 16 * 4 + 27
    grown = memory._replace(state=memory.state._replace(flags=flags))
    assert len(text_of(grown)) < MOST_BYTES


def test_one_is_due_at_the_start_and_every_five_seconds() -> None:
    assert [tick for tick in range(1000) if checkpoint.is_due(tick, 60)] == [0, 300, 600, 900]
