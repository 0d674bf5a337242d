"""Live streams in rounds of blocks: in order, complete, bounded, with the configuration that rules them."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from support.playing import START_NS, recording, stream
from support.recordings import write

from pmutools import linux
from pmutools.c37118 import FrameType, Message, StreamConfig, encode_config
from pmutools.c37118.batch import decode_batch
from pmutools.c37118.demux import Loss
from pmutools.cli.news import News
from pmutools.clock import VirtualClock
from pmutools.flow import Flow
from pmutools.formats.source import Block
from pmutools.host import ClockStep, Stall
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.net.endpoint import parse_endpoint
from pmutools.net.tcp import TcpCounts
from pmutools.sites import Site, load_sites
from pmutools.timebase import NS
from pmutools.tools import live
from pmutools.tools.characterizer.engine import Engine
from pmutools.tools.characterizer.wanted import wanted_of
from pmutools.tools.live import LiveSource
from pmutools.tools.reader.recorder import names_of
from pmutools.tools.recordings import saved_configs

pytestmark = pytest.mark.realtime
Item = Block | Message | Loss


@contextmanager
def sending(source: LiveSource) -> Iterator[socket.socket]:
    """A socket whose datagrams go to the first endpoint of ``source``."""
    local = source.receivers.local(0)
    assert local is not None
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind(("127.0.0.1", 0))
        sender.connect(("127.0.0.1", local.port))
        yield sender


def frames_of(messages: Sequence[Message]) -> list[bytes]:
    return [message.frame.data for message in messages]


def data_frames(source: LiveSource) -> int:
    return source.tally.frames.get(FrameType.DATA, 0)


def wires(items: Sequence[Item]) -> dict[int, list[tuple[bytes, StreamConfig]]]:
    """Data frames with their configuration, by IDCODE, in order."""
    found = defaultdict(list)
    for item in items:
        if isinstance(item, Block):
            assert item.batch.wire is not None
            raw, size = item.batch.wire.tobytes(), item.batch.config.frame_size
            found[item.batch.config.idcode] += [
                (raw[at : at + size], item.batch.config) for at in range(0, len(raw), size)
            ]
    return dict(found)


@pytest.mark.parametrize("named", [True, False])
def test_news_of_a_sender_name_it_as_the_user_does(named: bool) -> None:
    """In virtual time: it falls silent at once."""
    news: list[LinkEvent] = []
    url = "udp://127.0.0.1:0?idcode=7"
    wanted = Site("NORTH", parse_endpoint(url)) if named else url
    source = LiveSource([wanted], duration_ns=8 * NS, clock=VirtualClock(START_NS), tell=news.append)
    with source, sending(source) as sender:
        for frame in frames_of(recording(stream(7), 5)):
            sender.send(frame)
        deque(source.rounds(), maxlen=0)
        (silent,) = [event for event in news if event.kind is LinkKind.SILENT]
        host, port = sender.getsockname()
        assert silent.label == f"{'NORTH' if named else url} (IDCODE 7 from {host}:{port})"
        assert {event.label for event in news if event.kind is LinkKind.BOUND} == {""}
        said: list[str] = []
        News(said.append, 0)(silent)
        assert said == [f"{silent.label}: silent"]
        engine = Engine(wanted_of([url]))
        engine.hear(silent, START_NS)
        assert [line for _, line in engine.chronicle.lines()] == said


def test_rounds_hold_all_that_came_in_order() -> None:
    source = LiveSource(["udp://127.0.0.1:0"], stop=lambda: data_frames(source) == 600)
    sent = {idcode: recording(stream(idcode), 20) for idcode in range(1, 31)}
    with source, sending(source) as sender:
        rounds = source.rounds(round_ns=NS // 50)
        items = list(next(rounds))
        for frames in zip(*(frames_of(messages) for messages in sent.values()), strict=True):
            for frame in frames:
                sender.send(frame)
            items += next(rounds)
        items += chain.from_iterable(rounds)
    configs = {idcode: messages[0].config for idcode, messages in sent.items()}
    expected = {
        idcode: [(frame, configs[idcode]) for frame in frames_of(messages)[1:]] for idcode, messages in sent.items()
    }
    assert wires(items) == expected
    shown = set[int]()
    for item in items:
        if isinstance(item, Message):
            shown.add(item.frame.idcode)
        elif isinstance(item, Block):
            assert item.batch.config.idcode in shown
    blocks = [item for item in items if isinstance(item, Block)]
    assert all((np.diff(block.batch.arrival_ns) >= 0).all() for block in blocks)


def test_blocks_decoded_together_are_what_each_is_alone() -> None:
    """Streams laid out alike, and others; their columns are their own."""
    configs = [stream(1), stream(2), replace(stream(3), time_base=1000), stream(4, rate=25)]
    source = LiveSource(["udp://127.0.0.1:0"], stop=lambda: data_frames(source) == 200)
    with source, sending(source) as sender:
        for frame in chain.from_iterable(frames_of(recording(config, 50)) for config in configs):
            sender.send(frame)
        blocks = [item for found in source.rounds() for item in found if isinstance(item, Block)]
    assert sum(len(block.batch) for block in blocks) == 200
    for _, batch in blocks:
        assert batch.wire is not None
        alone = decode_batch(batch.wire.tobytes(), batch.config, batch.arrival_ns, batch.stamp_source)
        for name in ("time_ns", "arrival_ns", "stamp_source", "time_quality", "stat", "phasors", "frequency", "rocof"):
            np.testing.assert_array_equal(getattr(batch, name), getattr(alone, name))
        assert batch.time_ns.base is None or batch.time_ns.base.size <= len(batch), "keeps no other stream's memory"
        assert not batch.wire.flags.writeable


def test_another_rate_begins_another_block_with_its_configuration_before_it() -> None:
    """An epoch ends where the configuration says so, also amid a round, although frames look the same."""
    old, new = stream(7), stream(7, rate=25)
    source = LiveSource(["udp://127.0.0.1:0"], stop=lambda: data_frames(source) == 60)
    with source, sending(source) as sender:
        for frame in frames_of([*recording(old, 30), *recording(new, 30)]):
            sender.send(frame)
        items = [item for found in source.rounds() for item in found]
    seen = list[tuple[str, StreamConfig | None]]()
    for item in items:
        if isinstance(item, Block):
            seen.append(("data", item.batch.config))
        elif isinstance(item, Message):
            seen.append(("config", item.config))
    epochs = [what for what, before in zip(seen, [None, *seen], strict=False) if what != before]
    assert epochs == [("config", old), ("data", old), ("config", new), ("data", new)]


def test_a_quiet_source_gives_empty_rounds_until_its_end() -> None:
    clock = VirtualClock()
    source = LiveSource(["udp://127.0.0.1:0"], duration_ns=3 * NS, clock=clock)
    with source:
        rounds = list(source.rounds(round_ns=NS // 2))
    assert clock.monotonic_ns() == 3 * NS
    assert rounds == [[]] * len(rounds)
    assert 6 <= len(rounds) <= 7


def test_much_is_handed_on_before_its_round_is_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "ROUND_FRAMES", 100)
    if linux.NATIVE:
        monkeypatch.setattr("pmutools.linux_receive.ReceiveColumns.__init__.__defaults__", (64, 256, 16))
    source = LiveSource(["udp://127.0.0.1:0"], stop=lambda: data_frames(source) == 1000)
    with source, sending(source) as sender:
        for frame in frames_of(recording(stream(7), 1000)):
            sender.send(frame)
        rounds = list(source.rounds(round_ns=3600 * NS))
    counts = [sum(len(item.batch) for item in found if isinstance(item, Block)) for found in rounds]
    assert sum(counts) == 1000
    assert max(counts) < 100 + 256, "and so memory is bounded"


@pytest.mark.skipif(not linux.NATIVE, reason="SO_MEMINFO")
def test_own_drops_are_counted_in_rounds_too() -> None:
    told = list[LinkEvent]()
    source = LiveSource(["udp://127.0.0.1:0"], stop=lambda: True, tell=told.append, rcvbuf_bytes=16 << 10)
    frames = frames_of(recording(stream(7), 2000))
    with source, sending(source) as sender:
        for frame in frames:
            sender.send(frame)
        blocks = [item for found in source.rounds() for item in found if isinstance(item, Block)]
    assert source.own_drops > 0
    assert sum(len(block.batch) for block in blocks) + 1 + source.own_drops == len(frames)
    assert [event.datagrams for event in told if event.kind is LinkKind.OWN_DROPS] == [source.own_drops]


def test_cfg3_is_asked_for_and_cfg2_taken() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"tcp://127.0.0.1:{server.getsockname()[1]}?idcode=7"
        source = LiveSource([url], stop=lambda: data_frames(source) == 10)
        with source:
            rounds = source.rounds(round_ns=NS // 100)
            next(rounds)
            client, heard = server.accept()[0], b""
            client.setblocking(False)
            items, codes, end = list[Item](), list[int](), time.monotonic() + 10
            while codes != [6, 5, 2] and time.monotonic() < end:
                items += next(rounds)
                try:
                    heard += client.recv(1000)
                except BlockingIOError:
                    continue
                codes = [heard[at + 15] for at in range(0, len(heard), 18)]
                if codes == [6, 5]:
                    client.sendall(encode_config(stream(7)))
            for frame in frames_of(recording(stream(7), 10))[1:]:
                client.sendall(frame)
            items += chain.from_iterable(rounds)
            assert source.tcp_counts(0) == TcpCounts(0, 0)
            client.close()
    assert codes == [6, 5, 2]
    assert len(wires(items)[7]) == 10


# --- saved configurations


def ini(folder: Path, *sections: str) -> tuple[Site, ...]:
    path = folder / "pmus.ini"
    path.write_text("\n".join(sections))
    return load_sites(path)


def test_a_site_s_saved_configuration_serves_a_stream_that_never_sends_one(tmp_path: Path) -> None:
    config, other = stream(7), stream(8)
    write(tmp_path / "saved.pcap", [*recording(other, 3), *recording(config, 3)])
    sites = ini(tmp_path, "[pmu N1]", "url = udp://127.0.0.1:0", "idcode = 7", "config = saved.pcap")
    source = LiveSource(sites, stop=lambda: data_frames(source) == 20)
    with source, sending(source) as sender:
        for frame in frames_of(recording(config, 20))[1:]:
            sender.send(frame)
        items = [item for found in source.rounds() for item in found]
    (block,) = [item for item in items if isinstance(item, Block)]
    assert (len(block.batch), block.batch.config) == (20, config)
    assert source.name(block.flow, block.batch.config) == "N1"


def test_saved_configurations_are_found_whatever_holds_them(tmp_path: Path) -> None:
    for suffix in ("c37118", "mcap", "parquet"):
        write(tmp_path / f"saved.{suffix}", recording(stream(7), 3))
        (site,) = ini(tmp_path, "[pmu N1]", "url = udp://127.0.0.1:0", f"config = saved.{suffix}")
        assert saved_configs([site]) == (stream(7),)


def test_a_stream_is_called_by_all_its_sites(tmp_path: Path) -> None:
    url = "url = udp://127.0.0.1:0?idcode=7"
    sites = ini(tmp_path, "[pmu NORTH]", url, "station = N1", "[pmu SOUTH]", url, "station = S1")
    lone = stream(7)
    pair = replace(lone, stations=(replace(lone.stations[0], name="N1"), replace(lone.stations[0], name="S1")))
    with LiveSource(sites) as source, LiveSource(["udp://127.0.0.1:0"]) as unnamed:
        local = source.receivers.local(0)
        assert local is not None
        flow = Flow("udp", "127.0.0.1:5000", f"127.0.0.1:{local.port}")
        assert source.name(flow, pair) == names_of(source)(flow, pair) == "NORTH+SOUTH"
        assert source.name(flow, replace(pair, idcode=8)) == "PDC8"
        assert unnamed.name(flow, lone) == lone.stations[0].name.strip()


# --- the machine

STALLED = """
import sys
from pmutools.tools.characterizer.engine import Engine
from pmutools.tools.characterizer.wanted import wanted_of
from pmutools.tools.live import LiveSource
told = []
url = "udp://127.0.0.1:0"
source = LiveSource([url], duration_ns=20 * 10**9, tell_host=told.append, stop=lambda: bool(told))
with source:
    for number, _ in enumerate(source.rounds()):
        if not number:
            print("reading", flush=True)
print(*(type(event).__name__ for event in told), max(event.length_ns for event in source.host.stalls) > 10**8)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_a_process_that_was_not_run_says_so(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", STALLED], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "reading\n"
        os.kill(process.pid, signal.SIGSTOP)
        time.sleep(0.3)
        os.kill(process.pid, signal.SIGCONT)
        kinds, long_enough = process.stdout.read().rsplit(maxsplit=1)
    assert set(kinds.split()) == {"Stall"}
    assert long_enough == "True"


def test_news_of_the_machine_come_with_the_rounds() -> None:
    clock, told = VirtualClock(), list[Stall | ClockStep]()
    source = LiveSource(["udp://127.0.0.1:0"], duration_ns=NS, clock=clock, tell_host=told.append)
    with source:
        rounds = source.rounds()
        next(rounds)
        source.host.start()
        clock.advance(200_000_000)
        source.host.beat()
        list(rounds)
    assert [event.length_ns for event in told if isinstance(event, Stall)] == [200_000_000]
