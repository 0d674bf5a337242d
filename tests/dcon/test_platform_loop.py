"""The real-time loop in virtual time: pauses, clock steps, ends of every kind, and nothing but 0 V at the last."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import pytest
from support.swing import MS, START_NS, Streams

from dcon.core.values import Record, SystemState
from dcon.engine import Engine
from dcon.limiter import SLEW_MW_PER_S
from dcon.platform import loop
from dcon.platform.loop import TOLD, Platform, Summary
from dcon.platform.orders import TimedOrder, parse_order
from dcon.session.log import SessionReader, SessionWriter
from dcon.session.replay import identical, replay
from pmutools.c37118 import Demux, Loss, Message, StreamConfig
from pmutools.c37118.config import encode_config
from pmutools.clock import VirtualClock
from pmutools.errors import SettingsError, SourceError
from pmutools.flow import Chunk, Flow, StampSource
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.timebase import NS, slot_time_ns

PHASE_NS = 4 * MS
STREAMS = Streams(("N1", "N2", "S1"))
FLOWS = {pmu.name: Flow("udp", f"192.0.2.{pmu.idcode}:4713", "192.0.2.1:4801") for pmu in STREAMS.pmus}
ORDERS = tuple(map(parse_order, ("0.8:closed_loop", "0.9:arm", "1.0:activate")))
Item = Chunk | LinkEvent


class Clock(VirtualClock):
    """Sleeps too long, or is set, when told to."""

    def __init__(self) -> None:
        super().__init__(START_NS - 10 * MS)
        self.born_ns = self.monotonic_ns()
        self.pauses: deque[tuple[float, float]] = deque()
        """(seconds from the start, for how long)."""
        self.steps: deque[tuple[float, float]] = deque()
        """(seconds from the start, by how much)."""

    @property
    def passed_s(self) -> float:
        return (self.monotonic_ns() - self.born_ns) / NS

    def sleep_until(self, deadline_ns: int, /) -> None:
        super().sleep_until(deadline_ns)
        if self.pauses and self.pauses[0][0] <= self.passed_s:
            self.advance(round(self.pauses.popleft()[1] * NS))
        if self.steps and self.steps[0][0] <= self.passed_s:
            self.step(round(self.steps.popleft()[1] * NS))


class Script:
    """In the place of ``Receivers``: what arrives at which time, demultiplexed as there."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.demux = Demux()
        self.waiting: deque[tuple[int, Item]] = deque()
        self.closed = False

    def play(self, items: Iterable[tuple[int, Item]]) -> None:
        """Items with their arrival, in ns of unstepped UTC."""
        self.waiting = deque(sorted(items, key=lambda entry: entry[0]))

    def poll(self, timeout_ns: int | None) -> list[Item]:
        clock = self.clock
        end_ns = clock.monotonic_ns() + (timeout_ns or 0)
        if self.waiting and (due_ns := self._at(self.waiting[0][0])) <= end_ns:
            super(Clock, clock).sleep_until(due_ns)
            ready = []
            while self.waiting and self._at(self.waiting[0][0]) <= clock.monotonic_ns():
                ready.append(self.waiting.popleft()[1])
            return ready
        super(Clock, clock).sleep_until(end_ns)
        return []

    def _at(self, arrival_ns: int) -> int:
        return arrival_ns - START_NS + 10 * MS + self.clock.born_ns

    def parse(self, item: Item) -> list[Message | Loss]:
        return self.demux.feed(item) if isinstance(item, Chunk) else []

    def owners(self, flow: Flow, idcode: int) -> tuple[int, ...]:
        return tuple(k for k, pmu in enumerate(STREAMS.pmus) if pmu.idcode == idcode and FLOWS[pmu.name] == flow)

    def close(self) -> None:
        self.closed = True


class Driver:
    """In the place of the UDP driver."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.sent: list[tuple[int, float, float]] = []
        """(tick, volts, seconds that had passed)."""
        self.failed = 0
        self.closed = False

    def send(self, time_ns: int, output_v: float, flags: int = 0) -> None:
        self.sent.append((time_ns, output_v, self.clock.passed_s))

    def close(self) -> None:
        self.closed = True


def config_chunk(name: str, arrival_ns: int, config: StreamConfig | None = None) -> tuple[int, Item]:
    frame = encode_config(config or STREAMS.streams[name].config)
    return arrival_ns, Chunk(frame, arrival_ns, FLOWS[name], StampSource.KERNEL)


def stream(seconds: float, names: Iterable[str] = STREAMS.streams) -> list[tuple[int, Item]]:
    """Configurations, then the frames, 60 ms late each."""
    items = [config_chunk(name, START_NS) for name in names]
    for slot in range(round(seconds * 60)):
        for name in names:
            frame = STREAMS.frame(name, slot, delay_ms=60.0 + 0.1 * slot % 3)
            arrival_ns = frame.arrival_ns or 0
            items.append((arrival_ns, Chunk(frame.data, arrival_ns, FLOWS[name], StampSource.KERNEL)))
    return items


class Bench:
    """A platform on a script."""

    def __init__(self, path: Path, items: Iterable[tuple[int, Item]]) -> None:
        self.path = path
        self.clock = Clock()
        self.script = Script(self.clock)
        self.script.play(items)
        self.driver = Driver(self.clock)
        self.platform = Platform(
            STREAMS.settings(extra="\n[output]\nurl = udp://127.0.0.1:9\n[platform]\nfifo = no\n"), clock=self.clock
        )

    def run(self, duration_s: float | None, orders: Sequence[TimedOrder] = ORDERS) -> Summary:
        return self.platform.run(str(self.path), orders=orders, start_ns=START_NS, duration_s=duration_s)

    @property
    def records(self) -> list[Record]:
        return [tick.record for tick in SessionReader(self.path).ticks()]

    def steps_mw(self) -> list[float]:
        return [abs(b[1] - a[1]) * 12.5 for a, b in pairwise(self.driver.sent)]


Make = Callable[..., Bench]


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Make:
    def make(items: Iterable[tuple[int, Item]] = (), name: str = "s.mcap") -> Bench:
        made: list[Bench] = []
        monkeypatch.setattr(loop, "Receivers", lambda endpoints, clock: Script(clock))
        monkeypatch.setattr(loop, "UdpCommandDriver", lambda endpoint: None)
        monkeypatch.setattr(loop, "prepare", lambda *, fifo: None)
        made.append(Bench(tmp_path / name, items))
        made[0].platform.receivers = made[0].script  # type: ignore[assignment]
        made[0].platform.driver = made[0].driver  # type: ignore[assignment]
        return made[0]

    return make


def ended_well(bench: Bench) -> None:
    assert bench.driver.sent[-1][1] == 0.0
    assert bench.driver.closed and bench.script.closed
    result = replay(str(bench.path))
    assert (result.different, result.stopped) == (0, ""), str(result.first)


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
    ended_well(made)


def test_orders_come_true_at_their_time(bench: Make) -> None:
    made = bench(stream(3))
    made.run(3, orders=[*ORDERS, parse_order("2:gain=12"), parse_order("2.5:disarm")])
    entered = {e.name: (r.tick_ns - START_NS) / NS for r in made.records for e in r.events if e.subject == "system"}
    for name, at_s in (("closed_loop", 0.8), ("armed", 0.9), ("active", 1.0), ("gain", 2.0), ("rampdown", 2.5)):
        assert at_s <= entered[name] < at_s + 1 / 60 + 1e-6
    ended_well(made)


@pytest.mark.parametrize("pause_s", [0.001, 0.015, 0.080, 0.5])
def test_a_pause_of_the_machine_changes_no_record(pause_s: float, bench: Make) -> None:
    """Missed ticks are made up for, with the frames that had arrived by their time: rows stay consecutive."""
    quiet, paused = bench(stream(3), "quiet.mcap"), bench(stream(3), "paused.mcap")
    quiet.run(3)
    paused.clock.pauses.append((1.7, pause_s))
    summary = paused.run(3)
    assert summary.caught_up_ticks == int(pause_s * 60)
    assert summary.skipped_ticks == 0
    assert identical(tuple(quiet.records), tuple(paused.records))
    ended_well(paused)


def test_a_long_pause_is_not_made_up_for(bench: Make) -> None:
    made = bench(stream(8))
    made.clock.pauses.append((2.0, 3.0))
    summary = made.run(6)
    assert summary.skipped_ticks == pytest.approx(179, abs=1)
    assert summary.caught_up_ticks == 1
    ticks = [record.tick_ns for record in made.records]
    assert max(b - a for a, b in pairwise(ticks)) == pytest.approx(3 * NS, abs=20 * MS)
    ended_well(made)


@pytest.mark.parametrize("step_s", [-10.0, 10.0, 0.5, -0.005])
def test_a_step_of_utc_holds_up_no_tick(step_s: float, bench: Make, caplog: pytest.LogCaptureFixture) -> None:
    made = bench(stream(8))
    made.clock.steps.append((2.0, step_s))
    made.clock.steps.append((4.0, -step_s))
    made.clock.sleep_until = _after(made, 6.0, made.platform.stop)  # type: ignore[method-assign]
    summary = made.run(None, orders=())
    assert summary.clock_steps == 2
    assert f"UTC was stepped by {step_s:.6f} s" in caplog.text
    at_s = [passed for *_, passed in made.driver.sent]
    assert max(b - a for a, b in pairwise(at_s)) < 0.035  # two ticks, the wall over
    assert at_s[-1] == pytest.approx(6, abs=0.02)
    ended_well(made)


def _after(made: Bench, at_s: float, act: Callable[[], object]) -> Callable[[int], None]:
    sleep = made.clock.sleep_until

    def sleep_until(deadline_ns: int, /) -> None:
        sleep(deadline_ns)
        if made.clock.passed_s >= at_s:
            act()

    return sleep_until


def active_mw(made: Bench, at_s: float) -> float:
    """The command at a time; the tests below want it to be far from 0 when the end comes."""
    k = next(k for k, sent in enumerate(made.driver.sent) if sent[2] >= at_s)
    return made.driver.sent[k][1] * 12.5


def ramped(made: Bench, at_s: float) -> None:
    assert abs(active_mw(made, at_s)) > 10
    assert max(made.steps_mw()) <= SLEW_MW_PER_S / 60 + 1e-9
    down = [volts * 12.5 for *_, volts, passed in made.driver.sent if passed > at_s + 0.02]
    assert all(abs(b) <= abs(a) + 1e-9 for a, b in pairwise(down))
    assert made.driver.sent[-1][2] - at_s == pytest.approx(1.0, abs=0.06)


def test_the_end_of_its_time_ramps_the_command_down(bench: Make) -> None:
    made = bench(stream(6))
    summary = made.run(3.2)
    assert summary.final_state == "STANDBY"
    ramped(made, 3.21)
    ended_well(made)


def test_a_request_to_stop_ramps_the_command_down(bench: Make) -> None:
    made = bench(stream(6))
    made.clock.sleep_until = _after(made, 3.2, made.platform.stop)  # type: ignore[method-assign]
    summary = made.run(None)
    assert summary.final_state == "STANDBY"
    ramped(made, 3.21)
    ended_well(made)


def test_a_request_to_stop_while_nothing_is_driven_ends_at_once(bench: Make) -> None:
    made = bench(stream(2))
    made.platform.stop()
    assert made.run(None).ticks == 0
    assert [volts for _, volts, _ in made.driver.sent] == [0.0]


def test_a_log_that_cannot_be_written_ends_the_session_with_a_ramp(
    bench: Make, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A full disk: nothing unrecorded is driven for longer than the ramp, and there is no step."""
    made = bench(stream(6))
    write = SessionWriter.tick

    def full(self: SessionWriter, record: Record, *args: object, **given: object) -> None:
        if made.clock.passed_s > 3.2:
            raise SourceError("s.mcap: cannot write: No space left on device")
        write(self, record, *args, **given)  # type: ignore[arg-type]

    monkeypatch.setattr(SessionWriter, "tick", full)
    with pytest.raises(SourceError, match="No space left on device"):
        made.run(20)
    assert caplog.text.count("No space left") == 1
    ramped(made, 3.22)
    assert made.records[-1].state is SystemState.ACTIVE  # the last that was written
    ended_well(made)


def test_a_log_that_cannot_be_opened(bench: Make, tmp_path: Path) -> None:
    made = bench(stream(1))
    made.path = tmp_path / "no" / "s.mcap"
    with pytest.raises(SourceError, match=r"^[^\n]*No such file[^\n]*$"):
        made.run(1)
    assert [volts for _, volts, _ in made.driver.sent] == [0.0]
    assert made.driver.closed and made.script.closed


@pytest.mark.parametrize("error", [RuntimeError("a bug"), KeyboardInterrupt(), MemoryError()])
def test_whatever_else_goes_wrong_leaves_0_v_and_a_readable_log(
    error: BaseException, bench: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = bench(stream(6))
    tick = Engine.tick

    def failing(self: Engine, frames: object, orders: object, now_ns: int) -> object:
        if made.clock.passed_s > 3.2:
            raise error
        return tick(self, frames, orders, now_ns)  # type: ignore[arg-type]

    monkeypatch.setattr(Engine, "tick", failing)
    with pytest.raises(type(error)):
        made.run(20)
    monkeypatch.undo()
    assert abs(made.driver.sent[-2][1]) > 0.5
    assert len(made.records) == len(made.driver.sent) - 1
    ended_well(made)


def at_50(name: str) -> StreamConfig:
    return Streams((name,), rate=50).streams[name].config


def test_a_first_configuration_that_cannot_be_used_ends_the_start(bench: Make) -> None:
    made = bench([config_chunk("N1", START_NS, at_50("N1"))])
    with pytest.raises(SettingsError, match="PMU N1: its stream 101 sends 50 frames/s, the controller runs at 60; set"):
        made.run(3)
    assert made.driver.sent[-1][1] == 0.0 and made.driver.closed


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
    ended_well(made)


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
    ended_well(made)


def test_arrivals_stamped_by_a_wrong_clock_are_not_kept_for_ever(bench: Make) -> None:
    """An arrival an hour from now is a clock's mistake: the frame is taken, and the check on latency is for it."""
    items = stream(2)
    wrong = [(at, item._replace(arrival_ns=at + 3600 * NS) if isinstance(item, Chunk) else item) for at, item in items]
    made = bench(wrong)
    summary = made.run(2, orders=())
    assert summary.frames > 300
    assert sum(map(len, made.platform._frames.values())) == 0
    assert made.records[-1].instances[0].reason.count("latency") >= 1


def test_trouble_with_streams_is_told_and_never_floods(bench: Make, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    news = [
        LinkEvent(LinkKind.FOREIGN, f"udp://192.0.2.9:{port}", (0,), f"IDCODE {port} comes from there")
        for port in range(1, 200)
    ]
    news.append(LinkEvent(LinkKind.OWN_DROPS, "udp://127.0.0.1:4801", (0,), "buffer full", datagrams=7))
    news.append(LinkEvent(LinkKind.STREAMING, "udp://192.0.2.101:4713", (0,)))
    made = bench([*stream(1), *((START_NS + MS, event) for event in news)])
    summary = made.run(1)
    assert summary.own_drops == 7
    told = [entry.getMessage() for entry in caplog.records]
    assert told[0] == "udp://192.0.2.9:1: foreign IDCODE 1 comes from there"
    assert len(told) == TOLD + 1 and told[-1] == "udp://127.0.0.1:4801: own-drops buffer full"
