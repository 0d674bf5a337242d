"""The engine: whose a frame is, what is counted where, and when; by messages and news alone."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from support.measured import MS, START_NS, batch, config, stamps

from pmutools.c37118 import Frame, Message, StreamConfig, encode_config
from pmutools.c37118.batch import NO_TIME
from pmutools.c37118.demux import Loss
from pmutools.c37118.framer import Skipped, SkipReason
from pmutools.flow import Flow, StampSource
from pmutools.formats.source import Block
from pmutools.measure.clockquality import ClockQuality, KernelClock
from pmutools.measure.scene import peers_of
from pmutools.measure.stream import StreamResult
from pmutools.measure.summary import stream_summary
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.net.endpoint import parse_endpoint
from pmutools.timebase import NS
from pmutools.tools.characterizer.engine import Engine, merged
from pmutools.tools.characterizer.intervals import Intervals
from pmutools.tools.characterizer.job import groups
from pmutools.tools.characterizer.summaries import checkpoint, final_summary, results_of, run_part
from pmutools.tools.characterizer.wanted import Wanted

HERE = "192.0.2.9:4713"


def udp(port: int = 4713, host: str = "192.0.2.1") -> Flow:
    return Flow("udp", f"{host}:{port}", HERE)


def tcp(port: int, connection: int = 0) -> Flow:
    return Flow("tcp", "192.0.2.1:4712", f"192.0.2.9:{port}", connection)


def block(
    slots: Iterable[int], flow: Flow, *, of: StreamConfig | None = None, delay_ms: Any = 20.0, **options: Any
) -> Block:
    of = of or config()
    return Block(flow, batch(stamps(slots, int(of.rate)), delay_ms, of=of, **options))


def announcement(flow: Flow, of: StreamConfig, arrival_ns: int) -> Message:
    return Message(Frame(encode_config(of), arrival_ns, StampSource.KERNEL, 0), flow, of)


def loss(reason: SkipReason, flow: Flow, nbytes: int = 34, idcode: int | None = None) -> Loss:
    return Loss(Skipped(reason, 0, nbytes, idcode), flow)


def results(engine: Engine, end_ns: int | None = None) -> dict[str, StreamResult]:
    engine.close()
    return {result.identity.name: result for result in results_of(engine, end_ns)}


def ids(engine: Engine, result: StreamResult) -> set[str]:
    return {row["id"] for row in stream_summary(result, engine.clock, peers_of([result]), fit=False)["diagnoses"]}


# --- whose it is


def test_a_sender_that_begins_anew_from_another_port_is_the_same_stream() -> None:
    engine = Engine()
    engine.take([block(range(60), udp(40_001))])
    engine.take([block(range(70, 130), udp(40_002))])
    (result,) = results(engine).values()
    assert (result.counts.slots.expected, result.counts.slots.lost) == (130, 10)
    assert (result.counts.events.connects, result.counts.events.disconnects) == (2, 1)
    assert result.counts.events.senders == 0
    assert "reconnects" in ids(engine, result)


def test_a_connection_that_is_made_again_is_the_same_stream() -> None:
    engine = Engine()
    engine.take([block(range(60), tcp(50_001))])
    engine.take([block(range(60, 120), tcp(50_002, 1))])
    (result,) = results(engine).values()
    assert result.counts.slots.received == 120
    assert (result.counts.events.connects, result.counts.events.disconnects) == (2, 1)


def test_senders_at_once_are_told_and_are_no_restart() -> None:
    """Two devices with one IDCODE, half a period apart, other values: their frames come in turns."""
    engine = Engine()
    for second in range(5):
        slots = range(60 * second, 60 * second + 60)
        one, other = block(slots, udp(4713)), block(slots, udp(4713, "192.0.2.2"), delay_ms=28.0, values=np.full(60, 2))
        engine.take([one, other])
    (result,) = results(engine).values()
    slots = result.counts.slots
    assert (slots.received, slots.duplicated, slots.conflicting, slots.stale) == (300, 300, 300, 0)
    assert result.counts.order.reordered == 0
    assert (result.counts.events.senders, result.counts.events.disconnects) == (2, 0)
    assert "two-senders" in ids(engine, result) and "reconnects" not in ids(engine, result)


def test_streams_of_one_flow_and_of_one_idcode_elsewhere_are_apart() -> None:
    engine = Engine()
    engine.take([block(range(60), udp(), of=config(idcode=idcode)) for idcode in (1, 2)])
    engine.take([Block(udp()._replace(destination="192.0.2.9:4714"), batch(stamps(range(60)), of=config(idcode=1)))])
    found = results(engine)
    assert {(r.identity.idcode, r.counts.slots.received) for r in found.values()} == {(1, 60), (2, 60)}
    assert len(found) == 3
    assert set(found) == {"N1", "N1#2", "N1#3"}  # the station's name, told apart


def test_what_the_user_asked_for_gives_name_rate_and_key() -> None:
    wanted = (
        Wanted(parse_endpoint("udp://0.0.0.0:4713?idcode=101"), ("north",), 60),
        Wanted(parse_endpoint("udp://0.0.0.0:4713?idcode=102"), ("south", "west"), 50),
        Wanted(parse_endpoint("tcp://192.0.2.7:4712"), ("east",), 60),
        Wanted(parse_endpoint("udp://0.0.0.0:4999")),
    )
    engine = Engine(wanted, lambda flow, idcode: {101: (0,), 102: (1,)}.get(idcode, ()), begin_ns=START_NS)
    engine.take([block(range(60), udp(1)), block(range(60), udp(2), of=config(idcode=102))])
    engine.take([block(range(60, 90), udp(3))])
    found = results(engine, START_NS + 2 * NS)
    assert list(found) == ["north", "south+west", "east", "udp://0.0.0.0:4999"]
    assert found["north"].counts.slots.received == 90
    assert set(found["south+west"].identity.others) == {"south", "west", "N1", "102"}
    assert "unexpected-rate" in ids(engine, found["south+west"])
    for name in ("east", "udp://0.0.0.0:4999"):
        assert found[name].counts.slots.frames == 0
        assert "silent" in ids(engine, found[name])


def test_a_silent_site_is_told_what_kept_it_silent() -> None:
    wanted = (Wanted(parse_endpoint("udp://0.0.0.0:4713"), ("north",)),)
    engine = Engine(wanted, begin_ns=START_NS)
    where = "udp://192.0.2.1:4713"
    engine.hear(LinkEvent(LinkKind.NO_CONFIG, where, (0,), "held until one comes", 101, udp()), START_NS)
    engine.take([loss(SkipReason.NO_CONFIG, udp()) for _ in range(7)])
    (result,) = results(engine).values()
    assert result.counts.events.before_config == 7
    text = stream_summary(result, engine.clock, fit=False)["diagnoses"][0]["text"]
    assert text.startswith("7 data frames came")
    assert engine.host.before_config == 0
    assert any("no-config" in line for _, line in engine.chronicle.lines())


def test_more_streams_than_are_measured_are_counted() -> None:
    engine = Engine(max_streams=2)
    engine.take([block(range(10), udp(), of=config(idcode=idcode)) for idcode in (1, 2, 3, 4)])
    engine.take([block(range(10, 20), udp(), of=config(idcode=3))])
    assert len(results(engine)) == 2
    assert engine.unmeasured == 30
    assert "more than 2 streams" in engine.chronicle.lines()[0][1]


# --- what is counted where


def test_damaged_frames_are_those_of_the_stream_that_they_claim() -> None:
    engine = Engine()
    engine.take([block(range(10), udp(), of=config(idcode=idcode)) for idcode in (1, 2)])
    engine.take([loss(SkipReason.BAD_CHK, udp(), idcode=2), loss(SkipReason.BAD_CHK, udp(), idcode=77)])
    engine.take([loss(SkipReason.NO_SYNC, udp(), nbytes=5)])
    one, two = engine.gauges
    assert (one.meter.events.corrupt, two.meter.events.corrupt, engine.host.corrupt) == (0, 1, 1)
    assert engine.host.skipped_bytes == 34 + 5
    assert engine.skipped == {"bad-chk": 68, "no-sync": 5}
    told = final_summary(engine, list(results(engine).values()), {}, lambda: False)
    assert told["all"]["corrupt"] == 2


def test_on_a_connection_one_run_of_bytes_may_be_several_frames() -> None:
    engine = Engine()
    engine.take([block(range(10), tcp(50_001))])
    size = engine.gauges[0].meter.config.frame_size
    engine.take([loss(SkipReason.BAD_CHK, tcp(50_001), 3 * size)])
    assert engine.gauges[0].meter.events.corrupt == 3


def test_losses_before_the_first_frame_go_to_the_flow_s_stream() -> None:
    engine = Engine()
    engine.take([loss(SkipReason.BAD_CHK, udp(), idcode=101)])
    engine.take([block(range(10), udp())])
    assert engine.gauges[0].meter.events.corrupt == 1
    engine.take([loss(SkipReason.NO_SYNC, udp(9), nbytes=100)])  # of nobody
    engine.close()
    assert engine.host.skipped_bytes == 100


def test_drops_of_one_socket_are_not_doubled_in_all() -> None:
    wanted = tuple(Wanted(parse_endpoint(f"udp://0.0.0.0:4713?idcode={idcode}")) for idcode in (1, 2, 3))
    engine = Engine(wanted, lambda flow, idcode: (idcode - 1,), begin_ns=START_NS)
    engine.take([block(range(10), udp(), of=config(idcode=idcode)) for idcode in (1, 2, 3)])
    engine.hear(LinkEvent(LinkKind.OWN_DROPS, "udp://0.0.0.0:4713", (0, 1), "full", datagrams=96), START_NS)
    told = final_summary(engine, list(results(engine).values()), {}, lambda: False)
    assert [stream["own_drops"] for stream in told["streams"]] == [96, 96, 0]
    assert told["all"]["own_drops"] == told["all"]["events"]["own_drops"] == 96


def test_connections_are_counted_as_told() -> None:
    wanted = (Wanted(parse_endpoint("tcp://192.0.2.1:4712")),)
    engine = Engine(wanted, lambda flow, idcode: (0,), begin_ns=START_NS)
    where = "tcp://192.0.2.1:4712"
    first, second = tcp(50_001), tcp(50_002, 1)
    engine.hear(LinkEvent(LinkKind.CONNECTED, where, (0,), "", None, first), START_NS)
    engine.take([block(range(60), first)])
    engine.hear(LinkEvent(LinkKind.LOST, where, (0,), "reset", None, first), START_NS + NS)
    engine.hear(LinkEvent(LinkKind.CONNECTED, where, (0,), "", None, second), START_NS + 3 * NS)
    engine.take([block(range(180, 240), second)])
    (result,) = results(engine).values()
    assert (result.counts.events.connects, result.counts.events.disconnects) == (2, 1)
    lines = [line for _, line in engine.chronicle.lines()]
    assert lines == [f"{where}: lost: reset", f"{where}: connected"]  # the first connection is no news


def test_frames_that_came_before_their_configuration() -> None:
    engine = Engine(begin_ns=START_NS)
    of = config()
    engine.take([announcement(udp(), of, START_NS + 520 * MS), block(range(60), udp(), of=of)])
    events = engine.gauges[0].meter.events
    assert (events.before_config, events.first_config_ms, events.first_data_ms) == (30, 520.0, 20.0)


def test_a_stream_that_was_configured_and_sent_nothing_is_told() -> None:
    engine = Engine(begin_ns=START_NS)
    engine.take([announcement(udp(), config(), START_NS)])
    (result,) = results(engine).values()
    assert result.identity.name == "N1" and "silent" in ids(engine, result)


def test_a_configuration_that_changes_the_rate_goes_to_another_alignment() -> None:
    engine = Engine()
    engine.take([block(range(600), udp()), block(range(600), udp(2), of=config(idcode=2))])
    engine.take([block(range(300, 600), udp(), of=config(30)), block(range(600, 1200), udp(2), of=config(idcode=2))])
    found = results(engine)
    assert "config-changed" in ids(engine, found["N1"])
    assert engine.alignments[Fraction(30)].counts.complete == 300
    counts = engine.alignments[Fraction(60)].counts
    assert counts.complete == counts.stamps == 1200  # the second half by the one stream that is left


def test_a_clock_that_is_set_leaves_no_false_silence() -> None:
    engine = Engine(begin_ns=START_NS)
    engine.take([block(range(60), udp())])
    engine.clock_stepped(3600 * NS, START_NS + NS)
    engine.take([block(range(60, 120), udp(), delay_ms=20.0 + 3_600_000)])
    (result,) = results(engine).values()
    counts = result.counts
    assert engine.clock.steps == 1 and counts.slots.lost == 0
    assert counts.windows.empty == 0 and counts.delays.interarrival.max_ns < 20 * MS  # type: ignore[operator]
    assert result.silences == ()
    assert "set by +3600000.000 ms" in engine.chronicle.lines()[0][1]
    assert "receiver-clock" not in ids(Engine(), result)


def test_stalls_and_retransmissions_are_taken_down() -> None:
    wanted = (Wanted(parse_endpoint("tcp://192.0.2.1:4712")),)
    engine = Engine(wanted, lambda flow, idcode: (0,), begin_ns=START_NS)
    engine.take([block(range(60), tcp(50_001))])
    engine.stalled(80 * MS, START_NS)
    engine.resent((0,), 1, 5)
    (result,) = results(engine).values()
    assert {"host-stalls", "tcp-losses"} <= ids(engine, result)


# --- blocks


def test_merged_blocks_are_in_order_of_arrival() -> None:
    one, other = block(range(0, 60, 2), udp(1)), block(range(1, 60, 2), udp(2), delay_ms=21.0)
    pieces = list(merged([one, other]))
    arrivals = np.concatenate([piece.batch.arrival_ns for piece in pieces])
    assert len(arrivals) == 60 and (np.diff(arrivals) > 0).all()
    assert [piece.flow for piece in pieces[:2]] == [udp(1), udp(2)]
    whole = list(merged([one, block(range(60, 70), udp(2))]))
    assert [len(piece.batch) for piece in whole] == [30, 10]


def test_blocks_of_one_time_are_grouped() -> None:
    a, b = block(range(5), udp(1)), block(range(5), udp(2))
    found = [len(group) for group in groups([a, b, a, b, b])]
    assert found == [2, 2, 1]
    assert [len(group) for group in groups([loss(SkipReason.NO_SYNC, udp())] * 5000)] == [4096, 904]


def test_many_flows_cost_bounded_memory() -> None:
    engine = Engine()
    for port in range(20_000):
        engine.take([loss(SkipReason.BAD_CHK, Flow("udp", f"192.0.2.1:{port}", HERE))])
    assert len(engine._unclaimed) <= 1 << 14
    engine.close()
    assert engine.host.corrupt == 20_000


# --- what is told


def told_by(engine: Engine) -> dict[str, Any]:
    texts: list[str] = []
    run = run_part(engine, "x", engine.begin_ns, START_NS + 10 * NS, dict, complete=False)
    for _ in checkpoint(engine, lambda: run, START_NS + 10 * NS, texts.append):
        pass
    (text,) = texts
    found: dict[str, Any] = json.loads(text)
    return found


def test_a_checkpoint_is_a_summary_and_changes_nothing() -> None:
    engine = Engine()
    engine.sample_clock(ClockQuality(KernelClock(0, 0.0, 200, 100, 0x2001)))
    for second in range(3):
        slots = np.array([slot for slot in range(600 * second, 600 * second + 600) if slot % 50])
        engine.take([block(slots, udp(), delay_ms=20 + slots % 7), block(slots, udp(2), of=config(idcode=2))])
        before = told_by(engine)
    assert told_by(engine) == before
    found = list(results(engine).values())
    final = final_summary(engine, found, run_part(engine, "x", 0, 0, dict, complete=True), lambda: False)
    assert [s["received"] for s in before["streams"]] == [s["received"] for s in final["streams"]] == [1764, 1764]
    assert before["all"]["lost"] == final["all"]["lost"] == 70
    assert before["streams"][0]["delay_ms"] == final["streams"][0]["delay_ms"]
    assert (before["run"]["complete"], final["run"]["complete"]) == (False, True)
    assert before["clock"]["disciplined"]


@pytest.mark.parametrize("size", [1, 37, 5000])
def test_intervals_of_a_recording_are_cut_where_they_end(size: int) -> None:
    """Two streams, one of which ends early: a line holds what came within its two seconds, whatever the blocks."""
    engine, lines = Engine(), list[str]()
    intervals = Intervals(engine, 2 * NS, lines.append)
    engine.cut = intervals.pieces
    frames = {1: batch(stamps(range(1230)), of=config(idcode=1)), 2: batch(stamps(range(500)), of=config(idcode=2))}
    for at in range(0, 1230, size):
        engine.take([Block(udp(idcode), each[at : at + size]) for idcode, each in frames.items()])
        intervals.write_ready()
    intervals.finish()
    engine.close()
    told = [json.loads(line) for line in lines]
    assert [line["begin"] < line["end"] for line in told] == [True] * len(told)
    arrivals = {idcode: each.arrival_ns // (2 * NS) for idcode, each in frames.items()}
    for number, line in enumerate(told):
        interval = START_NS // (2 * NS) + number
        for stream in line["streams"]:
            assert stream["received"] == np.count_nonzero(arrivals[stream["idcode"]] == interval)
    assert sum(line["all"]["received"] for line in told) == 1730


def test_intervals_live_add_up_to_the_run() -> None:
    engine, lines = Engine(begin_ns=START_NS), list[str]()
    intervals = Intervals(engine, NS, lines.append)
    engine.sample_clock(ClockQuality(KernelClock(0, 0.0, 200, 100, 0x2001)))
    for second in range(5):
        engine.take([block(range(60 * second, 60 * second + 60), udp())])
        for _ in intervals.look(START_NS + second * NS, START_NS + (second + 1) * NS):
            pass
    told = [json.loads(line) for line in lines]
    assert [line["streams"][0]["received"] for line in told] == [60] * 5
    assert told[0]["clock"]["bound_ms"] == pytest.approx(0.2)
    assert told[0]["streams"][0]["uncertainty_ms"] == pytest.approx(0.301)
    (result,) = results(engine).values()
    assert result.counts.slots.received == 300


def test_streams_without_arrivals_are_measured_as_far_as_they_go() -> None:
    engine = Engine()
    engine.take([Block(Flow("file", "a.csv"), batch(stamps([*range(30), *range(40, 60)]), None, of=config()))])
    engine.take([Block(Flow("file", "b.csv"), replace_arrivals(batch(stamps(range(60)), None, of=config(idcode=2))))])
    first, second = results(engine).values()
    assert (first.counts.slots.lost, first.counts.delays.delay.count) == (10, 0)
    assert second.counts.delays.delay.count == 30
    assert engine.begin_ns == START_NS


def replace_arrivals(frames: Any) -> Any:
    arrivals = frames.arrival_ns.copy()
    arrivals[::2] = frames.time_ns[::2] + 20 * MS
    assert (arrivals[1::2] == NO_TIME).all()
    return replace(frames, arrival_ns=arrivals)


def test_sequences_are_whole(chunks: Sequence[int] = (1, 7, 60)) -> None:
    """However the blocks are cut, the same is measured."""
    found = []
    for size in chunks:
        engine = Engine()
        frames = batch(stamps([slot for slot in range(600) if slot % 11]), 20 + np.arange(545) % 5)
        for at in range(0, len(frames), size):
            engine.take([Block(udp(), frames[at : at + size])])
            engine.drain()
        (result,) = results(engine).values()
        found.append((result.counts.slots.lost, result.counts.delays.delay.mean_ns, result.counts.windows.empty))
    assert found[0][0] == found[1][0] == found[2][0]
    assert found[0][2] == found[1][2] == found[2][2]
    assert found[0][1] == pytest.approx(found[2][1])


def test_what_a_live_source_tells_of_the_host_is_handed_over_once() -> None:
    from types import SimpleNamespace

    from pmutools.tools.characterizer.hostwatch import HostWatch

    wanted = (Wanted(parse_endpoint("udp://0.0.0.0:4713")), Wanted(parse_endpoint("tcp://192.0.2.1:4712")))
    engine = Engine(wanted, lambda flow, idcode: (1,), begin_ns=START_NS)
    engine.take([block(range(60), tcp(50_001))])
    stalls = [SimpleNamespace(length_ns=60 * MS, utc_ns=START_NS), SimpleNamespace(length_ns=90 * MS, utc_ns=START_NS)]
    counts = SimpleNamespace(retransmits=1, out_of_order=4)
    source = SimpleNamespace(host=SimpleNamespace(stalled=2, stalls=stalls), tcp_counts=lambda place: counts)
    watch = HostWatch(source, engine)
    for second in range(3):
        watch.look(second * NS)
    events = engine.gauges[0].meter.events
    assert (events.stalls, events.longest_stall_ms) == (2, 90.0)
    assert (events.retransmits, events.out_of_order) == (1, 4)
    counts.out_of_order = 2  # another connection
    watch.look(9 * NS)
    assert events.out_of_order == 4
    lines = list(engine.chronicle.lines())
    HostWatch(SimpleNamespace(), engine).look(0)  # of a source that counts nothing
    assert list(engine.chronicle.lines()) == lines and (events.stalls, events.retransmits) == (2, 1)
