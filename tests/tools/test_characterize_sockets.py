"""Live measurement against what an independent sender knows it sent; and what a live run must survive."""

from __future__ import annotations

import random
import socket
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.live import free_udp_port
from support.sending import MS, NS, Device, Plan, beside, config, data, planned, slots_from, spec, udp_to
from support.wire import StreamSpec

from pmutools.clock import SystemClock
from pmutools.measure.clockquality import ClockQuality, KernelClock
from pmutools.net.dialogue import LinkEvent
from pmutools.tools.characterizer.engine import Engine
from pmutools.tools.characterizer.folder import Folder
from pmutools.tools.characterizer.job import Job, Outcome, Settings
from pmutools.tools.characterizer.wanted import wanted_of
from pmutools.tools.live import LiveSource

pytestmark = pytest.mark.realtime
GOOD = ClockQuality(KernelClock(0, 0.0, 200, 100, 0x2001))
PATIENCE_S = 20


def run(
    out: Path,
    urls: list[str],
    *senders: Callable[[], object],
    clock: Any = None,
    rcvbuf_bytes: int = 1 << 22,
    **said: Any,
) -> Outcome:
    """Bind, start the senders, and measure until they are done and what was under way has come."""
    clock = clock or SystemClock()
    wanted, end_s, ended_s = wanted_of(urls), time.monotonic() + PATIENCE_S, list[float]()
    working: list[Callable[[], bool]] = []
    hearing: list[Callable[[LinkEvent], None]] = []

    def stop() -> bool:
        if all(done() for done in working) and not ended_s:
            ended_s.append(time.monotonic())
        return bool(ended_s and time.monotonic() > ended_s[0] + 0.3) or time.monotonic() > end_s

    def tell(event: LinkEvent) -> None:
        for hear in hearing:
            hear(event)

    endpoints = [each.endpoint for each in wanted]
    with ExitStack() as stack:
        source = stack.enter_context(
            LiveSource(endpoints, stop=stop, clock=clock, rcvbuf_bytes=rcvbuf_bytes, tell=tell)
        )
        engine = Engine(wanted, source.receivers.owners, begin_ns=clock.realtime_ns())
        hearing.append(lambda event: engine.hear(event, clock.realtime_ns()))
        job = Job(engine, Folder(out), Settings(**said), clock, source=", ".join(urls))
        working += [stack.enter_context(beside(sender)) for sender in senders]
        job.live(source, lambda: GOOD)
    return job.finish()


def streams(outcome: Outcome) -> dict[str, dict[str, Any]]:
    return {stream["name"]: stream for stream in outcome.run.summary["streams"]}


def ids(stream: dict[str, Any]) -> set[str]:
    return {diagnosis["id"] for diagnosis in stream["diagnoses"]}


def true_delays_ms(plan: Plan) -> np.ndarray:
    """Of the first copy of each frame: when it was really sent, less its stamp as the wire tells it."""
    found = []
    for frame, sent in plan.sent.items():
        soc, rest = int.from_bytes(frame[6:10], "big"), int.from_bytes(frame[11:14], "big")
        found.append((min(sent) - soc * NS - rest * 1000) / MS)
    return np.sort(found)


def reordered(plan: Plan) -> int:
    """By RFC 4737, from the order of sending, copies left out."""
    order = sorted((min(sent), frame[6:10] + frame[11:14]) for frame, sent in plan.sent.items())
    count, highest = 0, b""
    for _, stamp in order:
        count += stamp < highest
        highest = max(highest, stamp)
    return count


def wild(rng: random.Random, count: int, rate: int) -> list[list[float]]:
    """Delays of slots: noise, losses in runs, copies, and some that come several periods late."""
    delays: list[list[float]] = []
    while len(delays) < count:
        if rng.random() < 0.03:
            delays += [[]] * rng.choice((1, 1, 2, 5))
            continue
        delay = 20 + rng.expovariate(1 / 3)
        if rng.random() < 0.05:
            delay += 2.5 * 1000 / rate
        delays.append([delay, delay + 4] if rng.random() < 0.05 else [delay])
    delays = delays[:count]
    delays[0] = delays[-1] = [20.0]
    return delays


# --- truth


def test_what_was_sent_is_measured_back_at_mixed_rates_over_udp(tmp_path: Path) -> None:
    """Counts exactly; delays within what the sending itself takes on this machine."""
    rng = random.Random(3)
    specs = [spec(idcode, rate, name=f"R{rate}") for idcode, rate in ((1, 10), (2, 30), (3, 60), (4, 120))]
    ports = [free_udp_port() for _ in specs]
    begin_ns = time.time_ns() + NS // 2
    wanted = [wild(rng, of.data_rate * 2, of.data_rate) for of in specs]
    plans = [planned(of, begin_ns, delays) for of, delays in zip(specs, wanted, strict=True)]
    senders = [sent(port, plan, config(of)) for of, plan, port in zip(specs, plans, ports, strict=True)]
    outcome = run(tmp_path, [f"udp://127.0.0.1:{port}" for port in ports], *senders)
    found = streams(outcome)
    for of, plan, delays in zip(specs, plans, wanted, strict=True):
        stream = found[of.stations[0].name.short]
        lengths = [len(run) for run in "".join("x" if copies else "." for copies in delays).split("x") if run]
        told = dict(stream["loss_runs"]["lengths"])
        assert (stream["rate_hz"], stream["expected"]) == (of.data_rate, len(delays))
        assert stream["received"] == sum(bool(copies) for copies in delays)
        assert stream["duplicated"] == sum(len(copies) > 1 for copies in delays)
        assert told == {length: lengths.count(length) for length in set(lengths)}
        assert stream["reordered"] == reordered(plan)
        truth = true_delays_ms(plan)
        for key, share in (("p50", 0.5), ("p90", 0.9)):
            assert stream["delay_ms"][key] == pytest.approx(truth[int(np.ceil(share * len(truth))) - 1], abs=1.0)
        assert stream["delay_ms"]["min"] >= truth[0] - 0.001  # nothing arrives before it is sent
        assert stream["uncertainty_ms"] == pytest.approx(0.301)
    assert outcome.run.summary["all"]["own_drops"] == 0
    assert outcome.failures == [] and outcome.incomplete == []


def test_what_was_sent_is_measured_back_over_tcp(tmp_path: Path) -> None:
    rng, of = random.Random(4), spec(rate=50)
    delays = [[20 + rng.random() * 5] if k % 40 else [] for k in range(1, 101)]
    delays[-1] = [20.0]
    with Device(of) as device:
        plans: list[Plan] = []

        def serve() -> None:
            plans.append(device.serve(lambda: planned(of, time.time_ns() + NS // 10, delays)))

        outcome = run(tmp_path, [f"tcp://127.0.0.1:{device.port}?idcode=7"], serve)
    (stream,) = streams(outcome).values()
    truth = true_delays_ms(plans[0])
    assert (stream["expected"], stream["received"], stream["lost"]) == (100, 98, 2)
    assert (stream["duplicated"], stream["reordered"]) == (0, 0)
    assert stream["delay_ms"]["p50"] == pytest.approx(truth[len(truth) // 2], abs=1.0)
    assert stream["events"]["connects"] == 1


# --- what a live run must survive


def sent(port: int, plan: Plan, *first: bytes) -> Callable[[], None]:
    """Sends ``first``, and then what is planned, to a port."""

    def send() -> None:
        with udp_to(port) as put:
            for frame in first:
                put(frame)
            plan.play(put)

    return send


def steady(of: StreamSpec, seconds: float, after_s: float = 0.4) -> Plan:
    return planned(of, time.time_ns() + round(after_s * NS), [[20.0]] * round(of.data_rate * seconds))


def test_a_full_receive_buffer_is_this_host_s_doing(tmp_path: Path) -> None:
    port, of = free_udp_port(), spec()
    frames = [data(of, at_ns) for at_ns in slots_from(of, time.time_ns() - 60 * NS, 4000)]

    def flood() -> None:
        time.sleep(0.4)
        with udp_to(port) as put:
            put(config(of))
            for frame in frames:
                put(frame)

    class Slow(SystemClock):
        """A machine that has no time for its sockets."""

        def monotonic_ns(self) -> int:
            time.sleep(0.002)
            return super().monotonic_ns()

    outcome = run(tmp_path, [f"udp://127.0.0.1:{port}"], flood, clock=Slow(), rcvbuf_bytes=4096)
    told = outcome.run.summary
    (stream,) = told["streams"]
    drops = told["all"]["own_drops"]
    assert drops == stream["own_drops"] > 0
    assert stream["received"] + drops == len(frames)
    assert "own-drops" in ids(stream)
    assert any("this machine's receive buffer" in line for line in outcome.incomplete)


def test_garbage_costs_nothing_that_is_measured(tmp_path: Path) -> None:
    """Random bytes from a stranger, and among the sender's own datagrams."""
    rng, port, of = random.Random(1), free_udp_port(), spec()
    plan = steady(of, 1)
    own = [rng.randbytes(rng.randrange(1, 200)) for _ in range(25)]
    for number, junk in enumerate(own):
        plan.add(plan.frames[2 * number][0] + 5 * MS, junk)

    def flood() -> None:
        with udp_to(port) as put:
            for _ in range(3000):
                put(rng.randbytes(rng.randrange(1, 1400)))

    outcome = run(tmp_path, [f"udp://127.0.0.1:{port}"], flood, sent(port, plan, config(of)))
    (stream,) = streams(outcome).values()
    assert (stream["expected"], stream["received"], stream["duplicated"]) == (60, 60, 0)
    told = outcome.run.summary["run"]["input"]
    assert sum(told["skipped"].values()) == sum(map(len, own))
    assert told["ignored_flows"] == 1 and told["ignored_bytes"] > 0
    assert any("without a single frame" in line for line in outcome.incomplete)


def test_a_sender_with_another_configuration(tmp_path: Path) -> None:
    port, before, after = free_udp_port(), spec(phasors=1), spec(phasors=3, rate=30)
    plan = steady(before, 1)
    middle_ns = plan.frames[-1][0]
    plan.add(middle_ns + 10 * MS, config(after))
    plan.frames += planned(after, middle_ns + 20 * MS, [[20.0]] * 30).frames
    outcome = run(tmp_path, [f"udp://127.0.0.1:{port}"], sent(port, plan, config(before)))
    (stream,) = streams(outcome).values()
    assert (stream["received"], stream["lost"], stream["epochs"]) == (90, 0, 2)
    assert stream["quality"]["config_changes"] == 1
    assert "config-changed" in ids(stream)
    assert any("configured" in line for _, line in outcome.run.news)


def test_a_peer_that_hangs_up_and_comes_back_is_one_stream(tmp_path: Path) -> None:
    of = spec(rate=50)
    with Device(of) as device:

        def serve() -> None:
            for _ in range(2):
                device.serve(lambda: steady(of, 0.6, 0.1))

        outcome = run(tmp_path, [f"tcp://127.0.0.1:{device.port}?idcode=7"], serve)
    (stream,) = streams(outcome).values()
    assert stream["received"] == 60
    assert stream["lost"] > 10  # while there was no connection
    assert (stream["events"]["connects"], stream["events"]["disconnects"]) == (2, 2)
    assert "reconnects" in ids(stream)
    assert any("lost" in line for _, line in outcome.run.news)


def test_a_sender_that_begins_anew_over_udp_is_one_stream(tmp_path: Path) -> None:
    port, of = free_udp_port(), spec()
    plans = [steady(of, 0.5), steady(of, 0.5, 1.1)]

    def send() -> None:
        for plan in plans:
            sent(port, plan, config(of))()

    outcome = run(tmp_path, [f"udp://127.0.0.1:{port}"], send)
    (stream,) = streams(outcome).values()
    assert (stream["received"], stream["events"]["connects"], stream["events"]["disconnects"]) == (60, 2, 1)
    assert stream["loss_runs"]["count"] == 1


def test_two_senders_at_once_are_told(tmp_path: Path) -> None:
    port, of = free_udp_port(), spec()
    one, other = steady(of, 1), steady(of, 1)
    other.frames = [(at_ns + 3 * MS, data(of, at_ns - 20 * MS, value=9)) for at_ns, _ in other.frames]
    outcome = run(tmp_path, [f"udp://127.0.0.1:{port}"], sent(port, one, config(of)), sent(port, other, config(of)))
    (stream,) = streams(outcome).values()
    assert (stream["received"], stream["duplicated"], stream["conflicting"]) == (60, 60, 60)
    assert (stream["events"]["senders"], stream["events"]["disconnects"]) == (2, 0)
    assert "two-senders" in ids(stream)


def test_a_clock_that_is_set_is_told(tmp_path: Path) -> None:
    class Set(SystemClock):
        """UTC as the tool sees it jumps by 2 s; the kernel's stamps do not."""

        began_s = time.monotonic()

        def realtime_ns(self) -> int:
            return super().realtime_ns() + 2 * NS * (time.monotonic() > self.began_s + 1.0)

    port, of = free_udp_port(), spec()
    clock = Set()
    outcome = run(tmp_path, [f"udp://127.0.0.1:{port}"], sent(port, steady(of, 1), config(of)), clock=clock)
    told = outcome.run.summary
    assert told["clock"]["steps"] == 1
    assert told["clock"]["largest_step_ms"] == pytest.approx(2000, abs=1)
    (stream,) = told["streams"]
    assert stream["received"] == 60
    assert {"receiver-clock"} <= ids(stream)
    assert any("was set by +2000" in line for _, line in outcome.run.news)


def test_data_whose_configuration_never_comes(tmp_path: Path) -> None:
    port, of = free_udp_port(), spec()
    outcome = run(tmp_path, [f"udp://127.0.0.1:{port}"], sent(port, steady(of, 1)))
    (stream,) = streams(outcome).values()
    assert (stream["received"], stream["events"]["before_config"]) == (0, 60)
    assert stream["name"] == f"udp://127.0.0.1:{port}"
    assert stream["diagnoses"][0]["text"].startswith("60 data frames came")
    assert outcome.received == 0 and outcome.incomplete


def test_a_silent_endpoint_beside_one_that_sends(tmp_path: Path) -> None:
    port, silent, of = free_udp_port(), free_udp_port(), spec()
    with socket.create_server(("127.0.0.1", 0)) as refusing:
        refused = refusing.getsockname()[1]
    urls = [f"udp://127.0.0.1:{silent}", f"udp://127.0.0.1:{port}", f"tcp://127.0.0.1:{refused}"]
    outcome = run(tmp_path, urls, sent(port, steady(of, 1), config(of)))
    found = streams(outcome)
    assert [name.rpartition(":")[0] for name in found] == ["udp://127.0.0.1", "", "tcp://127.0.0.1"]
    assert [stream["received"] for stream in found.values()] == [0, 60, 0]
    assert [("silent" in ids(stream)) for stream in found.values()] == [True, False, True]
    assert any("failed" in line for _, line in outcome.run.news)
