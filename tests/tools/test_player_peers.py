"""Every sample and every real capture, over every transport, as tshark, pyc37, our reader and plain sockets take it."""

from __future__ import annotations

import cmath
import signal
import struct
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from support.captures import CAPTURE_DIR, REAL_CAPTURES
from support.chain import PATIENCE_S, EarlyClock, has, playing
from support.commands import command as command_line
from support.ear import CFG1, CFG2, CFG3, HEADER, START, Ear, Heard, good, is_data, listening, undisturbed, word
from support.live import free_ports, free_udp_port
from support.peers import run_pyc37_pdc
from support.playing import MS
from support.requires import requires
from support.tshark import Masked, differences, dissect

from pmutools.c37118 import Frame, FrameType, Message, StreamConfig
from pmutools.clock import SystemClock
from pmutools.flow import StampSource
from pmutools.formats.describe import describe
from pmutools.net.endpoint import parse_endpoint
from pmutools.parsers import parse_place
from pmutools.timebase import NS
from pmutools.tools.live import LiveSource
from pmutools.tools.player.cast import Cast
from pmutools.tools.player.ledger import LedgerWriter
from pmutools.tools.player.material import Choice, material
from pmutools.tools.player.play import Options, Player
from pmutools.tools.recast import parse_form
from pmutools.tools.window import Window

pytestmark = [
    pytest.mark.peer,
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform != "linux", reason="receivers ask for Linux's arrival stamps"),
]

Row = dict[str, Any]
Object = dict[str, Any]
Port = tuple[str, int]
SAMPLE_DIR = Path(__file__).resolve().parents[2] / "captures"
SAMPLES = (
    "ambient.csv",
    "bc-us-separation.parquet",
    "cjb-8pmu.pcap",
    "cjb-pdc-30fps.pcapng",
    "fault-waveform.cfg",
    "square-pulse-50fps.c37118",
)
RECORDINGS = {name: SAMPLE_DIR / name for name in SAMPLES} | {name: CAPTURE_DIR / name for name in REAL_CAPTURES}
ASKED = (HEADER, CFG1, CFG3, CFG2, START)
SPONTANEOUS = ("udp", "multicast", "broadcast")
COMMANDED = ("udp+cmd", "tcp", "tcp+udp")
GROUP = "239.255.77.1"
SPAN = "0.4"
"""Seconds of a recording that are played."""


def existing(name: str) -> Path:
    if not RECORDINGS[name].exists():
        pytest.skip(f"real capture {name} is not in ../shared/captures beside the checkout")
    return RECORDINGS[name]


def cast_of(name: str, span: str = SPAN, **choices: Any) -> Cast:
    window = Window(None, parse_place(span))
    return material(Choice(files=[str(existing(name))], window=window, **choices)).cast


def urls_of(ports: Sequence[int]) -> list[str]:
    """Where spontaneous data go."""
    return [
        f"udp://127.0.0.1:{ports[0]}",
        f"udp://{GROUP}:{ports[1]}?iface=127.0.0.1",
        f"udp://127.255.255.255:{ports[2]}?source=127.0.0.1",
    ]


@dataclass
class Playing:
    """A recording that is served over all transports at once."""

    name: str
    ledger: Path
    own: Sequence[int]
    """Ports that are free: for receivers of datagrams, and to serve at."""
    cast: Cast = field(init=False)
    over: threading.Event = field(default_factory=threading.Event)
    ports: dict[str, int] = field(default_factory=dict)
    data_port: int = 0

    def __post_init__(self) -> None:
        self.cast = cast_of(self.name)
        self.clock = EarlyClock(self.cast.reel.first_due_ns)
        *own, self.data_port = self.own
        self.ports = dict(zip((*SPONTANEOUS, *COMMANDED), own, strict=True))
        listen = [f"{transport}://127.0.0.1:{self.ports[transport]}" for transport in COMMANDED]
        listen[-1] += f"?data={self.data_port}"
        options = Options(to=list(map(parse_endpoint, urls_of(own))), listen=list(map(parse_endpoint, listen)))
        self.player = Player(self.cast, options, self.clock, stop=self.over.is_set)

    @property
    def idcodes(self) -> list[int]:
        return [part.idcode for part in self.cast.parts]

    def ears(self) -> Iterator[Ear]:
        for transport, host in zip(SPONTANEOUS, ("127.0.0.1", GROUP, "0.0.0.0"), strict=True):
            yield Ear(f"{self.name} {transport}", "udp", self.ports[transport], host=host)
        for transport in COMMANDED:
            for first, idcode in enumerate(self.idcodes):
                data_port = self.data_port if transport == "tcp+udp" and not first else 0
                name = f"{self.name} {transport} {idcode}"
                yield Ear(name, transport, self.ports[transport], idcode, ask=ASKED, data_port=data_port)

    def expected(self, rows: Sequence[Row]) -> dict[int, list[Object]]:
        """What tshark should find in the data frames: those of the source, with the stamps that the ledger tells."""
        reel = self.cast.reel
        stamps = {(row["stream"], row["index"]): row["time_ns"] for row in rows}
        found: dict[int, list[Object]] = defaultdict(list)
        for row in range(len(reel.rows)):
            config = reel.editions[reel.rows.edition[row]]
            at = int(reel.rows.at[row])
            frame = Frame(reel.wire[at : at + config.frame_size].tobytes(), None, StampSource.CAPTURE, 0)
            told = describe(Message(frame, reel.tracks[0].flow, config))
            track = int(reel.rows.track[row])
            recorded_ns = told["time_ns"]
            told["time_ns"] = stamps[reel.tracks[track].name, int(reel.rows.number[row])]
            told["soc"] += (told["time_ns"] - recorded_ns) // NS
            found[config.idcode].append(told)
        return found


@dataclass
class Captured:
    """What tshark made of all of it: objects by the port of the player's end, or of the receiver of datagrams."""

    runs: dict[str, Playing]
    rows: dict[str, list[Row]]
    heard: dict[str, Heard]
    objects: dict[Port, list[Object]]

    def of(self, run: Playing, transport: str) -> list[Object]:
        if transport == "data":
            return self.objects["udp", run.data_port]
        return self.objects["tcp" if transport.startswith("tcp") else "udp", run.ports[transport]]


@pytest.fixture(scope="module")
def captured(tmp_path_factory: pytest.TempPathFactory) -> Captured:
    """A capture that tells the packets apart. On two processors two may have one stamp, or be written out of order, of
    which tshark makes nothing: then they are played again.
    """
    for _ in range(2):
        try:
            taken = capture(tmp_path_factory.mktemp("peers"))
        except OneStampTwice:
            continue
        if all(taken.of(run, transport) for run in taken.runs.values() for transport in (*SPONTANEOUS, *COMMANDED)):
            return taken
    return capture(tmp_path_factory.mktemp("peers"))


class OneStampTwice(Exception):
    """Two packets of different ports have the same stamp."""


def capture(folder: Path) -> Captured:
    """All recordings are played at once, while tshark captures the ports that they use, and no others."""
    import pyarrow.parquet as pq

    names = [name for name, path in RECORDINGS.items() if path.exists()]
    free = free_ports(7 * len(names))
    runs = {name: Playing(name, folder / f"{name}.parquet", free[7 * n : 7 * n + 7]) for n, name in enumerate(names)}
    ports = [port for run in runs.values() for port in (*run.ports.values(), run.data_port)]
    pcap = folder / "lo.pcapng"
    with ExitStack() as stack:
        stack.enter_context(capturing(pcap, ports))
        heard = stack.enter_context(listening(*(ear for run in runs.values() for ear in run.ears())))
        with ExitStack() as players:
            for run in runs.values():
                run.clock.be_early(run.cast.reel.first_due_ns, 600 * MS)
                players.enter_context(playing(run.player, run.over, LedgerWriter(run.ledger)))
    by_arrival = ports_of(pcap, set(ports))
    objects: dict[Port, list[Object]] = defaultdict(list)
    selectors = [f"{protocol}.port=={port}" for protocol in ("udp", "tcp") for port in ports]
    for told in dissect(pcap, decode_as=selectors):
        objects[by_arrival[told["arrival_ns"]]].append(told)
    rows = {name: pq.read_table(run.ledger).to_pylist() for name, run in runs.items()}
    return Captured(runs, rows, heard, objects)


@contextmanager
def capturing(pcap: Path, ports: Sequence[int]) -> Iterator[None]:
    """tshark captures on the loopback interface meanwhile."""
    wanted = " or ".join(f"port {port}" for port in ports)
    command = [str(requires("tshark")), "-i", "lo", "-f", wanted, "-B", "64", "-w", str(pcap), "-q"]
    tshark = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        assert tshark.stderr is not None
        said = []
        for line in tshark.stderr:
            said.append(line)
            if "Capture started" in line:
                break
        else:
            pytest.skip(f"tshark cannot capture here: {' '.join(said)}")
        time.sleep(0.2)
        yield
        time.sleep(0.3)
        tshark.send_signal(signal.SIGINT)
        tshark.communicate(timeout=10)
    finally:
        tshark.kill()
        tshark.communicate()


def ports_of(pcapng: Path, ours: set[int]) -> dict[int, Port]:
    """By the time of each packet, which of our ports it came from or went to; read by hand."""
    octets, at, found, tick_ns = pcapng.read_bytes(), 0, dict[int, Port](), 1000
    while at < len(octets):
        kind, size = struct.unpack_from("<II", octets, at)
        body = octets[at + 8 : at + size - 4]
        at += size
        if kind == _INTERFACE and _NANOSECONDS in body:
            tick_ns = 1
        if kind != _PACKET:
            continue
        _, high, low, length, _ = struct.unpack_from("<IIIII", body)
        packet = body[20 : 20 + length]
        ends = struct.unpack_from(">HH", packet, 14 + 4 * (packet[14] & 15))
        port = PROTOCOLS[packet[23]], next(port for port in reversed(ends) if port in ours)
        if found.setdefault((high << 32 | low) * tick_ns, port) != port:
            raise OneStampTwice
    return found


PROTOCOLS = {6: "tcp", 17: "udp"}
_INTERFACE, _PACKET = 1, 6
_NANOSECONDS = struct.pack("<HHI", 9, 1, 9)
"""Option if_tsresol."""


@pytest.mark.parametrize("name", RECORDINGS)
@pytest.mark.parametrize("transport", [*SPONTANEOUS, *COMMANDED])
def test_tshark_reads_what_is_played(captured: Captured, name: str, transport: str) -> None:
    existing(name)
    run = captured.runs[name]
    objects = captured.of(run, transport)
    data = captured.of(run, "data") if transport == "tcp+udp" else objects
    assert all(told["chk_ok"] for told in [*objects, *data])
    expected = run.expected(captured.rows[name])
    for idcode, wanted in expected.items():
        found = [told for told in data if told["type"] == "data" and told["idcode"] == idcode]
        assert len(found) == len(wanted)
        assert [told["idcode"] for told in found] == [idcode] * len(wanted)
        if transport == "tcp+udp":  # tshark does not look for a configuration in another conversation
            assert all(isinstance(told["stations"], Masked) for told in found)
        else:
            assert not any(isinstance(told["stations"], Masked) for told in found)
        ignored = ["arrival_ns", "time", "version"]
        if transport in SPONTANEOUS and len(expected) > 1:  # tshark goes by the last configuration, whose ever
            ignored += ["name", "idcode"]
        assert differences(wanted, found, ignore=ignored) == []
        kinds = [told["type"] for told in objects if told["idcode"] == idcode and told["type"] != "data"]
        if transport in SPONTANEOUS:
            assert "cfg2" in kinds
        else:
            assert {"header", "cfg1", "cfg2", "cfg3", "command"} <= {*kinds}
            names = [t["command"] for t in objects if t["idcode"] == idcode and t["type"] == "command"]
            assert names == ["send_header", "send_cfg1", "send_cfg3", "send_cfg2", "start_data"]


@pytest.mark.parametrize("name", RECORDINGS)
def test_every_transport_carries_the_same_frames(captured: Captured, name: str) -> None:
    """By plain sockets: equal bytes, as many as the ledger says, each with the stamp that it says."""
    existing(name)
    run, rows = captured.runs[name], captured.rows[name]
    assert {row["fate"] for row in rows} == {"sent"}
    reference: list[bytes] | None = None
    for transport in (*SPONTANEOUS, *COMMANDED):
        ears = [heard for ear, heard in captured.heard.items() if ear.split(" ")[:2] == [name, transport]]
        frames = [frame for heard in ears for frame in frames_of(heard, stream=transport == "tcp")]
        assert all(map(good, frames))
        data = sorted(filter(is_data, frames))
        reference = reference or data
        assert data == reference
        assert len(data) == len(rows)
    assert reference is not None
    bases = {
        part.idcode: run.cast.config(number, int(run.cast.editions[number])).time_base
        for number, part in enumerate(run.cast.parts)
    }
    told = sorted((int.from_bytes(f[6:10]), int.from_bytes(f[11:14]) / bases[word(f, 4)]) for f in reference)
    stamps = sorted((row["time_ns"] // NS, row["time_ns"] % NS / NS) for row in rows)
    assert told == [(soc, pytest.approx(fraction, abs=1e-8)) for soc, fraction in stamps]


def frames_of(heard: Heard, *, stream: bool) -> list[bytes]:
    if stream:
        return [frame for _, frame in undisturbed(b"".join(chunk.data for chunk in heard.chunks))]
    return [frame for chunk in heard.chunks for _, frame in undisturbed(chunk.data)]


# --- our reader


@pytest.mark.parametrize("name", RECORDINGS)
def test_our_reader_takes_what_is_played(name: str) -> None:
    """All transports at once, each a flow of its own: equal bytes on all, every frame, and what rules it."""
    cast = cast_of(name, "0.3")
    *ports, data_port = free_ports(7)
    idcodes = [part.idcode for part in cast.parts]
    clock, over = EarlyClock(cast.reel.first_due_ns), threading.Event()
    listen = [f"{transport}://127.0.0.1:{port}" for transport, port in zip(COMMANDED, ports[3:], strict=True)]
    listen[-1] += f"?data={data_port}"
    options = Options(to=list(map(parse_endpoint, urls_of(ports))), listen=list(map(parse_endpoint, listen)))
    player = Player(cast, options, clock, stop=over.is_set)
    shapes = {part.idcode: shape(cast.config(n, int(cast.editions[n]))) for n, part in enumerate(cast.parts)}
    served = set()
    urls = [f"udp://127.0.0.1:{ports[0]}", f"udp://{GROUP}:{ports[1]}?iface=127.0.0.1", f"udp://0.0.0.0:{ports[2]}"]
    for transport, port in zip(COMMANDED, ports[3:], strict=True):
        data = f"&data={data_port}" if transport == "tcp+udp" else ""
        served.add(f"127.0.0.1:{port}")
        urls += [f"{transport}://127.0.0.1:{port}?idcode={idcode}{data}" for idcode in idcodes]
    total = 6 * len(cast.reel.rows)
    system = SystemClock()
    end_ns = system.monotonic_ns() + int(PATIENCE_S * NS)
    source = LiveSource(urls, stop=lambda: has(source, total) or system.monotonic_ns() > end_ns)
    clock.be_early(cast.reel.first_due_ns, 300 * MS)
    with source, playing(player, over):
        messages = [item for item in source.items() if isinstance(item, Message)]
    found: dict[str, list[bytes]] = defaultdict(list)
    for message in messages:
        if message.frame.type is FrameType.DATA:
            assert message.config is not None
            assert shape(message.config) == shapes[word(message.frame.data, 4)]
            by_stream = message.flow.transport == "tcp" or message.flow.source in served
            found[message.flow.source if by_stream else message.flow.destination].append(message.frame.data)
    assert sum(map(len, found.values())) == total
    flows = [sorted(frames) for frames in found.values()]
    assert len(flows) == 6
    assert all(frames == flows[0] for frames in flows)
    assert source.tally.skipped == {}


def shape(config: StreamConfig) -> list[tuple[Any, ...]]:
    """What a CFG-2 and a CFG-3 say alike."""
    return [(s.name, s.idcode, s.format, len(s.phasors), len(s.analogs), s.fnom, s.cfgcnt) for s in config.stations]


# --- pyc37

FRAMES = 8
INTERVAL_NS = 40 * MS
"""pyc37 takes one read for one frame: frames that come together are lost on it."""
BEYOND_PYC37 = {"fault-waveform.cfg": "cfg2", "C37.118_4in1PMU_TCP.pcap": "cfg2", "c37_1100_fullclean.pcap": "data"}
"""What it refuses (see its limits): DIGUNIT with a normal state, ANUNIT above 2, PMU_TQ in STAT."""


@pytest.fixture(scope="module")
def read_by_pyc37() -> dict[str, tuple[Cast, list[Object]]]:
    """The first stream of each recording, with values as whole numbers: pyc37 takes no float FREQ (see its limits)."""
    names = [name for name, path in RECORDINGS.items() if path.exists()]
    found = {}
    with ExitStack() as stack, ThreadPoolExecutor(len(names)) as pool:
        jobs = {}
        for name in names:
            cast = cast_of(name, "100", form=parse_form("rect,int"), interval_ns=INTERVAL_NS)
            over = threading.Event()
            options = Options(listen=[parse_endpoint("tcp://127.0.0.1:0")])
            player = Player(cast, options, EarlyClock(cast.reel.first_due_ns), stop=over.is_set)
            address = player.senders.local(0)
            assert address is not None
            stack.enter_context(playing(player, over))
            stack.callback(over.set)
            idcode = cast.parts[0].idcode
            jobs[name] = cast, pool.submit(run_pyc37_pdc, "127.0.0.1", address.port, idcode, FRAMES, 30.0)
        for name, (cast, job) in jobs.items():
            found[name] = cast, job.result()
    return found


@pytest.mark.parametrize("name", RECORDINGS)
def test_pyc37_reads_what_is_played(read_by_pyc37: dict[str, tuple[Cast, list[Object]]], name: str) -> None:
    existing(name)
    cast, answers = read_by_pyc37[name]
    kinds = ["header", "cfg2"] + ["data"] * FRAMES
    if name in BEYOND_PYC37:
        known = kinds.index(BEYOND_PYC37[name])
        assert [answer["type"] for answer in answers] == kinds[:known] + ["undecoded"] * (2 + FRAMES - known)
        return
    assert [answer["type"] for answer in answers] == kinds
    rows, config = cast.reel.rows, cast.config(0, int(cast.editions[0]))
    mine = [row for row in range(200) if row < len(rows) and rows.track[row] == 0][:FRAMES]
    for answer, row in zip(answers[2:], mine, strict=True):
        at = int(rows.at[row])
        frame = Frame(cast.reel.wire[at : at + config.frame_size].tobytes(), None, StampSource.CAPTURE, 0)
        expected = describe(Message(frame, cast.reel.tracks[0].flow, config))
        assert answer["fracsec"] == int.from_bytes(frame.data[11:14]) & 0x7FFFFF
        assert answer["idcode"] == config.idcode
        for told, station in zip(answer["stations"], expected["stations"], strict=True):
            assert (told["stat"], told["digitals"]) == (station["stat"], station["digitals"])
            assert told["frequency"] == pytest.approx(station["frequency"])
            assert told["dfreq"] / 100 == pytest.approx(station["rocof"])
            assert told["analogs"] == pytest.approx(station["analogs"])
            for polar, phasor in zip(told["phasors"], station["phasors"], strict=True):
                wanted = complex(phasor["re"], phasor["im"])
                assert cmath.rect(*polar) == pytest.approx(wanted, abs=1e-6 * abs(wanted) + 1e-6)


def test_the_command_itself_is_read_by_tshark(tmp_path: Path) -> None:
    """``pmu play`` as a user runs it, its ledger, and what tshark captured meanwhile."""
    import pyarrow.parquet as pq

    ledger, pcap, port = tmp_path / "ledger.parquet", tmp_path / "lo.pcapng", free_udp_port()
    sample = SAMPLE_DIR / "square-pulse-50fps.c37118"
    with capturing(pcap, [port]), listening(Ear("it", "udp", port)):
        arguments = ("play", sample, "--to", f"udp://127.0.0.1:{port}", "--end", 1, "--ledger", ledger, "--loss", "20%")
        done = subprocess.run(command_line(*arguments), capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, done.stderr
    objects = [told for told in dissect(pcap, decode_as=[f"udp.port=={port}"]) if told["type"] == "data"]
    rows = [row for row in pq.read_table(ledger).to_pylist() if row["fate"] == "sent"]
    assert 50 < len(rows) < 95
    idcodes = {"N1": 101, "S1": 201}
    assert [(told["idcode"], told["time_ns"]) for told in objects] == [
        (idcodes[row["stream"]], row["time_ns"]) for row in rows
    ]
    assert all(0 <= told["arrival_ns"] - row["scheduled_ns"] < NS for told, row in zip(objects, rows, strict=True))
