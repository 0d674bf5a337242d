"""Live sessions fed by another maker's PMUs and by recordings, of real devices too: each replays from its log.

All sessions of this module run at the same time, so that it takes seconds. Recordings of real devices are beside the
checkout; where they are absent, theirs are skipped.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pytest
from support.captures import CAPTURE_DIR, capture_path
from support.commands import started, wait_for_tcp
from support.live import free_ports
from support.peers import start_pyc37_pmu
from support.requires import requires_module
from support.swing import Streams

from dcon.cli import dcon
from dcon.core.values import InstanceState
from dcon.replay.replay import replay
from dcon.session.reader import LoggedTick, SessionReader
from pmutools.c37118 import Format, StreamConfig, decode_data, decode_prefix, encode_data
from pmutools.c37118.config import encode_config
from pmutools.c37118.frames import wire_values
from pmutools.cli.shell import run
from pmutools.errors import SourceError
from pmutools.formats import open_source
from pmutools.formats.source import Block
from pmutools.timebase import NS

pytestmark = [pytest.mark.realtime, pytest.mark.peer]
PATIENCE_S = 40.0
SAMPLES = Path(__file__).parents[2] / "captures"
AHEAD_S = 25
"""Of frames made for pyc37: until everything has started on a busy machine, and for a session."""


class Pmu(NamedTuple):
    """A section of the initialisation file: ``source`` is the recording or the peer that its frames come from."""

    name: str
    source: str
    idcode: int
    voltage: str
    station: str = ""


class Feed(NamedTuple):
    """What a session is fed: recordings with the transport each is played over; pyc37 where there is none."""

    rate: int
    pmus: tuple[Pmu, ...]
    played: tuple[tuple[str, str, tuple[str, ...]], ...] = ()
    """Recording, scheme, more words for ``pmu play``."""
    ready: frozenset[str] = frozenset()
    """Instances that these data make READY; all others must not be."""

    @property
    def pairs(self) -> list[str]:
        """Its control instances."""
        sides: dict[str, list[str]] = {"N": [], "S": []}
        for pmu in self.pmus:
            sides[pmu.name[0]].append(pmu.name)
        return [f"{north}-{south}" for north in sides["N"] for south in sides["S"]]

    @property
    def nominal_hz(self) -> int:
        return 50 if self.rate == 50 else 60


ONE_TCP, ONE_UDP, FOUR = "C37.118_1PMU_TCP.pcap", "C37.118_1PMU_UDP.pcap", "C37.118_4in1PMU_TCP.pcap"
EIGHT, UNLOCKED = "cjb-8pmu.pcap", "c37_1100_fullclean.pcap"
LOOPED = ("--loop", "0", "--cfg-period", "1")
FEEDS = {
    "sample": Feed(
        60,
        tuple(Pmu(name, EIGHT, idcode, "V1") for name, idcode in (("N1", 101), ("N4", 104), ("S1", 201), ("S3", 203))),
        ((EIGHT, "udp", LOOPED),),
        frozenset({"N1-S1", "N1-S3", "N4-S1", "N4-S3"}),
    ),
    "devices": Feed(  # of the concentrator's four PMUs the first is alive, the others send zeros
        50,
        (
            Pmu("N1", ONE_TCP, 241, "V1LPM"),
            Pmu("N2", FOUR, 60, "PMU2-PHS 1,PMU2-PHS 2,PMU2-PHS 3", "PMU2"),
            Pmu("S1", ONE_UDP, 60, "VA,VB,VC"),
            Pmu("S2", FOUR, 60, "VA,VB,VC", "PMU1"),
        ),
        ((ONE_TCP, "tcp", ()), (ONE_UDP, "udp", LOOPED), (FOUR, "tcp", ())),
        frozenset({"N1-S1", "N1-S2"}),
    ),
    "unlocked device": Feed(
        60,
        (Pmu("N1", UNLOCKED, 1, "VA P,VB P,VC P"), Pmu("S1", UNLOCKED, 2, "VP P")),
        ((UNLOCKED, "udp", ("--emulate", "2", *LOOPED)),),
    ),
    "pyc37": Feed(30, (Pmu("N1", "N1", 101, "VA,VB,VC"), Pmu("S1", "S1", 201, "V1")), ready=frozenset({"N1-S1"})),
}
"""By name."""


def present(feed: Feed) -> bool:
    """Whether what it is fed by is there."""
    if not feed.played:
        return find_spec("pyc37") is not None
    return all(recording(name).exists() for name, *_ in feed.played)


def recording(name: str) -> Path:
    sample = SAMPLES / name
    return sample if sample.exists() else CAPTURE_DIR / name


@dataclass
class Session:
    """``dcon platform`` on a feed, and what it leaves."""

    feed: Feed
    folder: Path
    process: subprocess.Popen[str] | None = None
    out: str = ""
    err: str = ""
    given: dict[str, set[bytes]] = field(default_factory=dict)
    """By source: its data frames, without what a player makes anew (IDCODE, SOC, CHK)."""

    @property
    def log(self) -> Path:
        return self.folder / "s.mcap"

    def start(self, urls: dict[str, str]) -> None:
        feed = self.feed
        text = f"[DEFAULT]\nrate = {feed.rate}\n"
        for pmu in feed.pmus:
            side = "north" if pmu.name[0] == "N" else "south"
            text += f"[pmu {pmu.name}]\nurl = {urls[pmu.source]}\nidcode = {pmu.idcode}\nside = {side}\n"
            text += f"voltage = {pmu.voltage}\n" + (f"station = {pmu.station}\n" if pmu.station else "")
        text += f"[controller]\nnominal_hz = {feed.nominal_hz}\ninit_s = 0.3\n[platform]\nfifo = no\n"
        (self.folder / "dcon.ini").write_text(text)
        command = [sys.executable, "-m", "dcon.cli", "platform", "--ini", str(self.folder / "dcon.ini"), "--json"]
        command += ["--log", str(self.log)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def until_fed(self) -> None:
        """Wait until the log, which is flushed once a second, has what the tests want; they fail where it has not."""
        assert self.process is not None
        deadline = time.monotonic() + PATIENCE_S
        while self.process.poll() is None and time.monotonic() < deadline:
            ticks = self.ticks() if self.log.exists() else []
            if self.frames_of_each(ticks) > self.feed.rate and self.readied(ticks) >= self.feed.ready:
                return
            time.sleep(0.5)

    def end(self) -> None:
        if self.process is not None and not (self.out or self.err):
            self.process.send_signal(signal.SIGINT)
            try:
                self.out, self.err = self.process.communicate(timeout=30)
            finally:
                self.process.kill()
                self.process.wait()

    def ticks(self) -> list[LoggedTick]:
        """All that are in the log so far."""
        try:
            return list(SessionReader(self.log).ticks())
        except SourceError:
            return []  # not even its beginning is there

    def frames_of_each(self, ticks: list[LoggedTick]) -> int:
        """How many frames came of the PMU of which the fewest came."""
        names = [frame.name for tick in ticks for frame in tick.frames]
        return min(names.count(pmu.name) for pmu in self.feed.pmus)

    def readied(self, ticks: list[LoggedTick]) -> set[str]:
        """Instances that were READY at some time."""
        states = [[instance.state for instance in tick.record.instances] for tick in ticks]
        return {pair for k, pair in enumerate(self.feed.pairs) if any(now[k] is InstanceState.READY for now in states)}


def content(frame: bytes) -> bytes:
    """What a player leaves as it is, stamps moved by whole seconds: all but IDCODE, SOC and CHK."""
    return frame[:4] + frame[10:-2]


def recorded(name: str) -> set[bytes]:
    blocks = [block for block in open_source(recording(name)).blocks() if isinstance(block, Block)]
    return {content(row.tobytes()) for block in blocks if block.batch.wire is not None for row in block.batch.wire}


def for_pyc37(name: str, rate: int) -> tuple[StreamConfig, list[bytes]]:
    """An emulated PMU from now on, with FREQ as a whole number: pyc37 takes no float (see its limits)."""
    streams = Streams((name,), rate)
    config = streams.configs[name]
    station = replace(config.stations[0], format=Format.PHASOR_FLOAT | Format.POLAR)
    made = replace(config, stations=(station,))
    frames, start_ns = [], time.time_ns() // NS * NS
    for slot in range(AHEAD_S * rate):
        frame = streams.data(name, streams.stamp_ns(slot, start_ns))
        *values, frequency_hz, rocof_hz_s, _ = decode_data(frame, config).values[5:]
        values += [round((frequency_hz - 60) * 1e3), round(rocof_hz_s * 100)]
        frames.append(encode_data(wire_values(made, decode_prefix(frame), [values])))
    return made, frames


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Session]]:
    made = {name: Session(feed, tmp_path_factory.mktemp("fed")) for name, feed in FEEDS.items() if present(feed)}
    try:
        with ExitStack() as stack:
            for session in made.values():
                session.start(sources(session, stack))
            for session in made.values():
                session.until_fed()
            for session in made.values():
                session.end()
        yield made
    finally:
        for session in made.values():
            session.end()


def sources(session: Session, stack: ExitStack) -> dict[str, str]:
    """Start what feeds a session; the URL of each."""
    feed = session.feed
    urls = {}
    if not feed.played:
        for pmu, port in zip(feed.pmus, free_ports(len(feed.pmus)), strict=True):
            config, frames = for_pyc37(pmu.source, feed.rate)
            stack.enter_context(start_pyc37_pmu(port, encode_config(config), frames, age_s=0.04, limit_s=AHEAD_S))
            urls[pmu.source] = f"tcp://127.0.0.1:{port}"
            session.given[pmu.source] = set(map(content, frames))
    for (name, scheme, words), port in zip(feed.played, free_ports(len(feed.played)), strict=True):
        url = urls[name] = f"{scheme}://127.0.0.1:{port}"
        way = "--to" if scheme == "udp" else "--listen"
        player = stack.enter_context(started("play", recording(name), way, url, "--quiet", *words))
        if scheme == "tcp":
            wait_for_tcp(port, player)
        session.given[name] = recorded(name)
    return urls


@pytest.fixture(params=FEEDS)
def session(request: pytest.FixtureRequest, sessions: dict[str, Session]) -> Session:
    if request.param not in sessions:  # skip, and say why
        for name, *_ in FEEDS[request.param].played:
            capture_path(name)
        requires_module("pyc37")
    found = sessions[request.param]
    assert found.process is not None and found.process.returncode == 130, found.err
    return found


def test_it_replays_bit_for_bit_and_no_tick_is_missing(session: Session) -> None:
    result = replay(str(session.log))
    assert (result.different, result.stopped, result.problems) == (0, "", []), str(result.first)
    numbers = [round((tick.record.tick_ns - 4_000_000) * 60 / NS) for tick in session.ticks()]
    assert {after - before for before, after in pairwise(numbers)} == {1}
    summary = json.loads(session.out)
    assert result.ticks == len(numbers) == summary["ticks"] > 60
    assert (summary["skipped_ticks"], summary["unlogged_ticks"], summary["unread"]) == (0, 0, {})
    assert run(dcon(), ["replay", str(session.log), "--quiet"]) == 0


def test_frames_are_those_that_were_given(session: Session) -> None:
    ticks = session.ticks()
    assert session.frames_of_each(ticks) > session.feed.rate
    frames = [frame for tick in ticks for frame in tick.frames]
    for pmu in session.feed.pmus:
        own = [frame for frame in frames if frame.name == pmu.name]
        assert {content(frame.wire) for frame in own} <= session.given[pmu.source]


def test_instances_become_ready_where_the_data_allow_it(session: Session) -> None:
    assert list(SessionReader(session.log).instances) == session.feed.pairs
    assert session.readied(session.ticks()) == session.feed.ready


def test_devices_without_a_clock_are_heard_and_not_used(sessions: dict[str, Session]) -> None:
    """STAT 0x21F0: not synchronised, for over 1000 s; the frames are in the log all the same."""
    capture_path(UNLOCKED)
    ticks = sessions["unlocked device"].ticks()
    assert {frame.stat for tick in ticks for frame in tick.frames} == {0x21F0}
    assert {instance.state for tick in ticks for instance in tick.record.instances} == {InstanceState.DISABLED}
    assert ticks[-1].record.instances[0].reason
