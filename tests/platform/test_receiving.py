"""From datagrams to frames of the settings' PMUs: a configuration that cannot be handed on is a refusal, no end."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.virtual_platform import FLOWS, STREAMS, Clock, Script

from dcon.front.allowance import BURST, FRAMES_A_SECOND, Allowance
from dcon.front.receiving import LONGEST_CONFIG, Reception
from dcon.link.crossing import Item, PmuFrameIn
from pmutools.c37118 import FrameType, StreamConfig
from pmutools.c37118.checksum import chk
from pmutools.c37118.config import PhasorChannel, encode_config
from pmutools.flow import Chunk, StampSource
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.timebase import NS


def long_config(phasors: int = 70) -> StreamConfig:
    """CFG-3 of N1; each of its phasors takes more than 255 bytes of it."""
    config = STREAMS.configs["N1"]
    channels = tuple(PhasorChannel(f"{number:0255d}") for number in range(phasors))
    station = replace(config.stations[0], phasors=channels)
    return replace(config, stations=(station,), kind=FrameType.CFG3)


def fragments(config: StreamConfig) -> list[bytes]:
    """Frames of at most 5,000 bytes of it, each with CONT_IDX and CHK."""
    body = config.body[2:]
    parts = [body[at : at + 5000] for at in range(0, len(body), 5000)]
    out = []
    for number, part in enumerate(parts, 1):
        head = (config.kind.sync & 0xFFF0 | config.version).to_bytes(2, "big") + (18 + len(part)).to_bytes(2, "big")
        index = 0xFFFF if number == len(parts) else number
        frame = head + config.idcode.to_bytes(2, "big") + bytes(8) + index.to_bytes(2, "big") + part
        out.append(frame + chk(frame).to_bytes(2, "big"))
    return out


class Rig:
    def __init__(self) -> None:
        self.reception = Reception(Script(Clock()))  # type: ignore[arg-type]

    def __call__(self, *frames: bytes) -> list[Item]:
        found: list[Item] = []
        chunks = [Chunk(frame, 1, FLOWS["N1"], StampSource.KERNEL) for frame in frames]
        self.reception.parse(chunks, found.append)
        return found


def test_a_configuration_of_several_frames_is_handed_on_as_one() -> None:
    config = long_config(50)
    assert len(fragments(config)) == 3
    (item,) = Rig()(*fragments(config))
    assert isinstance(item, PmuFrameIn) and item.is_config and item.frame.data == encode_config(config)


@pytest.mark.parametrize("cut", [True, False])
def test_a_long_one_is_refused_and_told_and_data_are_no_more_read_by_the_one_before(cut: bool) -> None:
    rig = Rig()
    short, data = STREAMS.configs["N1"], STREAMS.data("N1", STREAMS.stamp_ns(0))
    assert [getattr(item, "is_config", None) for item in rig(encode_config(short), data)] == [True, False]
    long = long_config()
    assert len(encode_config(long)) > LONGEST_CONFIG
    frames = fragments(long) if cut else [encode_config(long)]
    (event,) = rig(*frames)
    assert isinstance(event, LinkEvent) and event.kind is LinkKind.NO_CONFIG and event.owners == (0,)
    assert f"its configuration takes more than {LONGEST_CONFIG} bytes and is refused" in event.detail
    assert rig.reception.counts.undecodable == 1
    assert rig(*frames, data) == [], "said once; and whether the frame is of the one before nobody knows"
    counts = rig.reception.counts
    assert counts.undecodable == 3 and counts.unneeded == (2 * (len(frames) - 1))
    assert [getattr(item, "is_config", None) for item in rig(encode_config(short), data)] == [True, False]


@pytest.mark.parametrize("cut", [True, False])
def test_any_configuration_is_handed_on_or_refused_by_its_length(cut: bool) -> None:
    for phasors in range(1, 240):
        config = long_config(phasors)
        frames = fragments(config) if cut and len(fragments(config)) > 1 else [encode_config(config)]
        found = Rig()(*frames)
        assert [isinstance(item, PmuFrameIn) for item in found] == [len(config.body) <= LONGEST_CONFIG], phasors


def test_a_long_cfg_1_rules_nothing_and_changes_nothing() -> None:
    rig = Rig()
    short, data = STREAMS.configs["N1"], STREAMS.data("N1", STREAMS.stamp_ns(0))
    cfg1 = replace(short, stations=short.stations * 200, kind=FrameType.CFG1)
    assert len(encode_config(cfg1)) > LONGEST_CONFIG
    found = rig(encode_config(short), encode_config(cfg1), data)
    assert [getattr(item, "is_config", None) for item in found] == [True, False]


def test_a_flood_in_the_name_of_a_pmu_passes_as_far_as_a_tick_may_read_it() -> None:
    """A second of 10,000 frames/s, between two seconds of 60."""
    rig, found = Rig(), list[Item]()
    data = STREAMS.data("N1", STREAMS.stamp_ns(0))
    rig(encode_config(STREAMS.configs["N1"]))
    seconds = [(0, 60), (1, 10_000), (2, 60)]
    passed = []
    for second, rate in seconds:
        before = len(found)
        arrivals = (second * NS + k * NS // rate for k in range(rate))
        rig.reception.parse([Chunk(data, at, FLOWS["N1"], StampSource.KERNEL) for at in arrivals], found.append)
        passed.append(len(found) - before)
    assert passed == [60, pytest.approx(BURST + FRAMES_A_SECOND, abs=2), 60]
    assert rig.reception.counts.crowded == 10_120 - sum(passed)


@given(st.lists(st.integers(-(10**10), 10**10), max_size=300))
def test_however_stamps_jump_a_frame_passes_after_a_second(jumps: list[int]) -> None:
    allowance, now_ns = Allowance(), 10**18
    for jump in jumps:
        now_ns += jump
        allowance.takes(0, now_ns)
    assert allowance.takes(0, now_ns + NS) and allowance.takes(1, 0)


def test_what_was_held_for_a_first_configuration_counts_by_a_name_of_its_own_once_it_is_old() -> None:
    rig = Rig()
    found: list[Any] = []
    data = STREAMS.data("N1", STREAMS.stamp_ns(0))
    arrivals_ns = [*range(0, 60 * NS, NS // 10), 60 * NS]
    for arrival_ns in arrivals_ns:
        frame = encode_config(STREAMS.configs["N1"]) if arrival_ns == 60 * NS else data
        chunk = Chunk(frame, arrival_ns, FLOWS["N1"], StampSource.KERNEL)
        rig.reception.parse([chunk], found.append)
    assert [item.is_config for item in found] == [True, *[False] * 10]
    assert [item.frame.arrival_ns for item in found[1:]] == arrivals_ns[-11:-1]
    assert rig.reception.counts.unreadable_yet == 590 and rig.reception.counts.undecodable == 0
