"""The real-time loop in virtual time: its ticks, pauses of the machine, steps of UTC, streams that change."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import pytest
from support.swing import MS, START_NS, Streams
from support.virtual_platform import FLOWS, ORDERS, STREAMS, Bench, Item, config_chunk, stream, virtual_platform

from dcon.control.loop import EARLY_NS, TOLD
from dcon.control.orders import parse_order
from dcon.control.waiting import CONFIGS
from dcon.core.values import SystemState
from dcon.limiter import SLEW_MW_PER_S
from dcon.replay.difference import identical
from dcon.session.reader import SessionReader
from pmutools.c37118 import StreamConfig
from pmutools.errors import SettingsError
from pmutools.flow import Chunk, StampSource
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.timebase import NS, slot_time_ns

PHASE_NS = 4 * MS
Make = Callable[..., Bench]


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Make:
    def make(items: Iterable[tuple[int, Item]] = (), name: str = "s.mcap", platform: str = "") -> Bench:
        return virtual_platform(tmp_path / name, items, monkeypatch, platform)

    return make


def test_a_session_ticks_at_its_phase_and_logs_each_tick(bench: Make) -> None:
    made = bench(stream(3))
    summary = made.run(3, orders=[*ORDERS, parse_order("1.9:disarm")])
    records = made.records
    first = START_NS // NS * 60
    assert [record.tick_ns for record in records] == [
        slot_time_ns(first + k, Fraction(60)) + PHASE_NS for k in range(len(records))
    ]
    assert summary.ticks == len(records) == len(made.driver.sent) - 1 == 180
    assert [sent[:2] for sent in made.driver.sent[:-1]] == [(r.tick_ns, r.output_v) for r in records]
    assert (summary.caught_up_ticks, summary.skipped_ticks, summary.late_over_1ms, summary.clock_steps) == (0, 0, 0, 0)
    assert summary.frames == sum(len(tick.frames) for tick in SessionReader(made.path).ticks()) > 500
    assert max(abs(record.output_v) for record in records) > 0.5
    made.ended_well()


def test_orders_come_true_at_their_time(bench: Make) -> None:
    made = bench(stream(3))
    made.run(3, orders=[*ORDERS, parse_order("2:gain=12"), parse_order("2.5:disarm")])
    entered = {e.name: (r.tick_ns - START_NS) / NS for r in made.records for e in r.events if e.subject == "system"}
    for name, at_s in (("closed_loop", 0.8), ("armed", 0.9), ("active", 1.0), ("gain", 2.0), ("rampdown", 2.5)):
        assert at_s <= entered[name] < at_s + 1 / 60 + 1e-6
    made.ended_well()


@pytest.mark.parametrize("pause_s", [0.001, 0.015, 0.080, 0.5])
def test_a_pause_of_the_machine_changes_no_record(pause_s: float, bench: Make) -> None:
    """Missed ticks are made up for, with the frames that had arrived by their time: rows stay consecutive."""
    quiet, paused = bench(stream(3), "quiet.mcap"), bench(stream(3), "paused.mcap")
    quiet.run(3)
    paused.clock.pause(1.7, pause_s)
    summary = paused.run(3)
    assert summary.caught_up_ticks == int((pause_s - EARLY_NS / NS) * 60)  # it began before the loop took what had come
    assert summary.skipped_ticks == 0
    assert identical(tuple(quiet.records), tuple(paused.records))
    paused.ended_well()


@pytest.mark.parametrize(("pauses", "state"), [(2, "ACTIVE"), (3, "FAULT")])
def test_late_ticks_warn_and_three_in_a_second_trip_where_that_is_asked_for(
    pauses: int, state: str, bench: Make
) -> None:
    """A pause that makes one tick late; the trip replays like everything else."""
    made = bench(stream(3), platform="judge_overruns = yes\n")
    for number in range(pauses):
        made.clock.pause(1.7 + 0.2 * number, 0.02)
    made.run(2.6)
    ending = next(record for record in made.records if record.tick_ns >= START_NS + round(2.5 * NS))
    assert ending.state == state
    rose = [event.name for record in made.records for event in record.events if event.name.startswith("overrun")]
    assert rose == ["overrun"] * pauses + ["overruns"] * (state == "FAULT")
    made.ended_well()


def test_a_long_pause_is_not_made_up_for(bench: Make) -> None:
    made = bench(stream(8))
    made.clock.pause(2.0, 3.0)
    summary = made.run(6)
    assert summary.skipped_ticks == pytest.approx(179, abs=1)
    assert summary.caught_up_ticks == 1
    ticks = [record.tick_ns for record in made.records]
    assert max(b - a for a, b in pairwise(ticks)) == pytest.approx(3 * NS, abs=20 * MS)
    made.ended_well()


@pytest.mark.parametrize("step_s", [-10.0, 10.0, 0.5, -0.005])
def test_a_step_of_utc_holds_up_no_tick(step_s: float, bench: Make, caplog: pytest.LogCaptureFixture) -> None:
    made = bench(stream(8))
    made.clock.set(2.0, step_s)
    made.clock.set(4.0, -step_s)
    made.clock.at(6.0, made.platform.stop)
    summary = made.run(None, orders=())
    assert summary.clock_steps == 2
    assert f"UTC was stepped by {step_s:.6f} s" in caplog.text
    at_s = [passed for *_, passed in made.driver.sent]
    assert max(b - a for a, b in pairwise(at_s)) < 0.035  # two ticks, the wall over
    assert at_s[-1] == pytest.approx(6, abs=0.02)
    made.ended_well()


def at_50(name: str) -> StreamConfig:
    return Streams((name,), rate=50).streams[name].config


def test_first_configurations_of_which_none_can_be_used_end_the_start(bench: Make) -> None:
    made = bench([config_chunk(name, START_NS, at_50(name)) for name in STREAMS.configs])
    with pytest.raises(
        SettingsError, match=r"PMU ..: its stream \d+ sends 50 frames/s, the controller runs at 60; set"
    ):
        made.run(3)
    assert made.driver.sent[-1][1] == 0.0 and made.driver.closed


def test_a_first_configuration_that_cannot_be_used_costs_the_others_nothing(
    bench: Make, caplog: pytest.LogCaptureFixture
) -> None:
    made = bench([config_chunk("N2", START_NS, at_50("N2")), *stream(4, ("N1", "S1"))])
    summary = made.run(3)
    assert "PMU N2: its stream 102 sends 50 frames/s" in caplog.text
    assert summary.final_state == "STANDBY"


def test_once_an_instance_is_ready_a_wrong_stream_costs_no_control(
    bench: Make, caplog: pytest.LogCaptureFixture
) -> None:
    """A PMU that is switched on an hour later, and set up wrongly, must not stop the others."""
    items = [*stream(4, ("N1", "S1")), config_chunk("N2", START_NS + 2 * NS, at_50("N2"))]
    made = bench(items)
    made.run(3)
    assert "PMU N2: its stream 102 sends 50 frames/s" in caplog.text
    events = [event for record in made.records for event in record.events]
    assert [event.subject for event in events if event.name == "config_unusable"] == ["N2"]
    assert made.records[-1].state is not SystemState.FAULT
    made.ended_well()


def test_a_configuration_that_changes_is_an_event_and_switches_bumplessly(bench: Make) -> None:
    slim = Streams(("N1",))
    config, first = slim.slim("N1"), 2 * 60
    until_ns = START_NS + 2 * NS + 59 * MS  # the last frame before has come, the first of the new ones has not
    items = [(at, item) for at, item in stream(5) if item.flow != FLOWS["N1"] or at < until_ns]
    items.append(config_chunk("N1", until_ns, config))
    for slot in range(first, 5 * 60):
        arrival_ns = START_NS + slot * NS // 60 + 60 * MS
        items.append((arrival_ns, Chunk(slim.frame("N1", slot).data, arrival_ns, FLOWS["N1"], StampSource.KERNEL)))
    made = bench(items)
    made.run(4)
    switched = [record for record in made.records if any(event.name == "config_changed" for event in record.events)]
    assert len(switched) == 1
    assert switched[0].active == 1  # N2-S1
    assert switched[0].state is SystemState.ACTIVE
    assert made.platform.engine.unread == {}
    assert max(made.steps_mw()) <= SLEW_MW_PER_S / 60 + 1e-9
    made.ended_well()


def test_a_source_that_changes_its_configuration_without_end_costs_little_and_replays(
    bench: Make, caplog: pytest.LogCaptureFixture
) -> None:
    """Two in turn, eleven of them a tick; one is unusable."""
    caplog.set_level(logging.WARNING)
    both = [STREAMS.configs["N2"], at_50("N2")]
    times = range(START_NS + 3 * NS // 2, START_NS + 3 * NS, NS // 660)
    made = bench([*stream(3), *(config_chunk("N2", at, both[k % 2]) for k, at in enumerate(times))])
    summary = made.run(3)
    told = [event for record in made.records for event in record.events if event.name.startswith("config_")]
    assert 0 < len(told) <= 2 * CONFIGS and len(caplog.records) <= CONFIGS
    assert summary.counts["overtaken_configs"] > 900 and summary.counts["crowded"] > 50
    last = next(record for record in made.records if record.tick_ns >= START_NS + round(2.9 * NS))
    assert last.active == 0 and last.state is SystemState.ACTIVE
    made.ended_well()


def test_arrivals_stamped_by_a_wrong_clock_are_not_kept_for_ever(bench: Make) -> None:
    """An arrival an hour from now is a clock's mistake: the frame is taken, and the check on latency is for it."""
    items = stream(2)
    wrong = [(at, item._replace(arrival_ns=at + 3600 * NS) if isinstance(item, Chunk) else item) for at, item in items]
    made = bench(wrong)
    summary = made.run(2, orders=())
    assert summary.frames > 300
    assert len(made.platform._waiting) == 0
    assert made.records[-1].instances[0].reason.count("latency") >= 1


def test_trouble_with_streams_is_told_and_never_floods(bench: Make, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    news = [LinkEvent(LinkKind.NOTHING, "udp://127.0.0.1:4802", (1,), "nothing has come; is the sender on?")]
    news += [
        LinkEvent(LinkKind.FOREIGN, f"udp://192.0.2.9:{port}", (0,), f"IDCODE {port} comes from there")
        for port in range(1, 200)
    ]
    held = "held until one comes; a spontaneous sender repeats its own about once a minute"
    news.append(LinkEvent(LinkKind.NO_CONFIG, "udp://127.0.0.1:4803", (1,), held))
    news.append(LinkEvent(LinkKind.OWN_DROPS, "udp://127.0.0.1:4801", (0,), "buffer full", datagrams=7))
    news.append(LinkEvent(LinkKind.STREAMING, "udp://192.0.2.101:4713", (0,)))
    made = bench([*stream(1), *((START_NS + MS, event) for event in news)])
    summary = made.run(1)
    assert summary.counts["own_drops"] == 7
    told = [entry.getMessage() for entry in caplog.records]
    assert told[0] == "udp://127.0.0.1:4802: nothing has come; is the sender on?"
    assert told[1] == "udp://192.0.2.9:1: foreign IDCODE 1 comes from there"
    assert told[-2] == f"udp://127.0.0.1:4803: no configuration for its data: {held}"
    assert len(told) == TOLD + 3 and told[-1] == "udp://127.0.0.1:4801: own-drops buffer full"
