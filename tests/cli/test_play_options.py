"""Every option of ``pmu play``: that it does something, and what is wrong with it where it cannot."""

from __future__ import annotations

import errno
import json
import os
import re
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from support.commands import Pmu, Result, ended, started, wait_for_tcp
from support.peers import free_port
from support.playing import START_NS, interleaved, number, recording, stamp_ns, stream
from support.recordings import write

from pmutools.c37118 import FrameType, StreamConfig, decode_config, decode_prefix
from pmutools.timebase import NS

pytestmark = pytest.mark.realtime

NOWHERE = "udp://127.0.0.1:9"
FAST = ("--stamp", "keep", "--speed", "200")
"""Without a wait for the stamps' second, two seconds in ten milliseconds."""


@pytest.fixture(autouse=True)
def sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """``two.c37118``: 100 frames of N1 (IDCODE 7) and S1 (8). ``gap.c37118``: half of N1's, a minute later the rest."""
    monkeypatch.chdir(tmp_path)
    write(Path("two.c37118"), interleaved(recording(stream(7, name="N1"), 100), recording(stream(8, name="S1"), 100)))
    write(Path("gap.c37118"), recording(stream(7, name="N1"), 100, slots=[*range(50), *range(3000, 3050)]))
    write(Path("one.c37118"), recording(stream(7, name="N1"), 50))
    late = recording(stream(7, name="N1"), 100, latency_ns=30_000_000)
    write(Path("late.pcap"), late)


class Heard(NamedTuple):
    """What was sent to the sink, and how the command ended."""

    result: Result
    frames: list[bytes]

    @property
    def data(self) -> list[bytes]:
        return [frame for frame in self.frames if decode_prefix(frame).type is FrameType.DATA]

    @property
    def configs(self) -> dict[int, StreamConfig]:
        """The last CFG-2 of each IDCODE."""
        found = [frame for frame in self.frames if decode_prefix(frame).type is FrameType.CFG2]
        return {decode_prefix(frame).idcode: decode_config(frame)[1] for frame in found}

    @property
    def counts(self) -> dict[int, int]:
        idcodes = [decode_prefix(frame).idcode for frame in self.data]
        return {idcode: idcodes.count(idcode) for idcode in sorted(set(idcodes))}

    def stamps(self, idcode: int = 7) -> list[int]:
        mine = [frame for frame in self.data if decode_prefix(frame).idcode == idcode]
        return [stamp_ns(frame, self.configs[idcode]) for frame in mine]

    def numbers(self, idcode: int = 7) -> list[int]:
        return [number(frame) for frame in self.data if decode_prefix(frame).idcode == idcode]


class Sink:
    """A UDP port to play to."""

    def __init__(self, pmu: Pmu) -> None:
        self._pmu = pmu
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self.url = f"udp://127.0.0.1:{self._socket.getsockname()[1]}"

    def play(self, *arguments: object, code: int = 0) -> Heard:
        result = self._pmu("play", *arguments, "--to", self.url)
        assert result.code == code, result.err
        frames = []
        try:
            while True:
                frames.append(self._socket.recv(1 << 16))
        except BlockingIOError:
            return Heard(result, frames)

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def sink(pmu: Pmu) -> Iterator[Sink]:
    made = Sink(pmu)
    yield made
    made.close()


# --- what is played


def test_two_streams_as_they_are(sink: Sink) -> None:
    heard = sink.play("two.c37118", *FAST)
    assert heard.counts == {7: 100, 8: 100}
    assert {config.stations[0].name for config in heard.configs.values()} == {"N1", "S1"}
    assert "2 streams, 200 data frames" in heard.result.err


def test_the_plant_its_scenario_and_its_pmus(sink: Sink) -> None:
    more = ("--plant", "modal", "--duration", 1.2)
    assert len(sink.play(*more).counts) == 8
    heard = sink.play(*more, "--pmus", 3, "--scenario", "ambient", "--fps", 30)
    assert len(heard.counts) == 3
    assert {config.data_rate for config in heard.configs.values()} == {30}


@pytest.mark.parametrize("option", [("--select", "S1"), ("--select", "8"), ("--exclude", "N1"), ("--exclude", "7")])
def test_select_and_exclude(sink: Sink, option: tuple[str, str]) -> None:
    assert sink.play("two.c37118", *FAST, *option).counts == {8: 100}


def test_start_and_end(sink: Sink) -> None:
    heard = sink.play("one.c37118", *FAST, "--start", 0.2, "--end", "2016-09-08T17:05:11.6Z")
    assert heard.numbers() == [*range(10, 30)]


def test_skip_gaps(sink: Sink) -> None:
    heard = sink.play("gap.c37118", "--stamp", "now", "--speed", 100, "--skip-gaps", 0.5)
    assert heard.counts == {7: 100}
    assert heard.stamps()[-1] - heard.stamps()[0] < NS // 10
    assert "1 gap longer than 0.5 s cut down to it" in heard.result.err


def test_idcode_and_station(sink: Sink) -> None:
    heard = sink.play("two.c37118", *FAST, "--idcode", "7=700", "--station", "S1=SOUTH")
    assert heard.counts == {8: 100, 700: 100}
    assert {idcode: config.stations[0].name for idcode, config in heard.configs.items()} == {700: "N1", 8: "SOUTH"}


def test_what_is_not_there_to_be_renamed_is_told(sink: Sink) -> None:
    heard = sink.play("one.c37118", *FAST, "--idcode", "99=1", "--station", "X9=A")
    assert "IDCODE 99: not in the source, so nothing was changed" in heard.result.err
    assert "X9" in heard.result.err


def test_format(sink: Sink) -> None:
    heard = sink.play("one.c37118", *FAST, "--format", "polar,float")
    assert int(heard.configs[7].stations[0].format) == 15
    assert {len(frame) for frame in heard.data} == {heard.configs[7].frame_size}


def test_pdc(sink: Sink) -> None:
    heard = sink.play("two.c37118", *FAST, "--pdc", 99)
    assert heard.counts == {99: 100}
    assert [station.name for station in heard.configs[99].stations] == ["N1", "S1"]


def test_emulate_spread_and_together(sink: Sink) -> None:
    heard = sink.play("one.c37118", *FAST, "--emulate", 20)
    assert heard.counts == {7 + k: 50 for k in range(20)}
    assert heard.configs[26].stations[0].name == "N1-20"
    order = [decode_prefix(frame).idcode for frame in heard.data]
    assert order[:20] == [*range(7, 27)]
    same = {frame[16:20] for frame in heard.data}
    assert (
        len({frame[16:20] for frame in sink.play("one.c37118", *FAST, "--emulate", 20, "--spread", "mag=9").data}) > 9
    )
    assert len(same) == 1
    ledger = Path("x.parquet")
    for option, distinct in (((), 20), (("--together",), 1)):
        sink.play("one.c37118", *FAST, "--emulate", 20, "--ledger", ledger, *option)
        rows = [row for row in rows_of(ledger) if row["index"] == 3]
        assert len({row["offset_ns"] for row in rows}) == distinct


def test_data_rate_and_nominal_of_a_table_that_does_not_say(sink: Sink) -> None:
    lines = [f"2016-09-08T17:05:11.{k * 100:03d}Z,60.0{k}" for k in range(10)]
    Path("bare.csv").write_text("\n".join(["time,N1.freq_hz", *lines, ""]))
    heard = sink.play("bare.csv", *FAST, "--data-rate", 10, "--nominal", 50)
    (config,) = heard.configs.values()
    assert (config.data_rate, config.stations[0].fnom_hz) == (10, 50)


# --- when, with which stamp


@pytest.mark.parametrize("policy", ["shift", "keep", "now-grid", "now"])
def test_stamp(sink: Sink, policy: str) -> None:
    began_ns = time.time_ns()
    stamps = sink.play("one.c37118", "--stamp", policy).stamps()
    assert len(stamps) == 50
    if policy == "keep":
        assert stamps[0] == START_NS
        return
    assert 0 <= stamps[0] - began_ns + NS // 50 < 3 * NS
    grid = {stamp % (NS // 50) for stamp in stamps}
    assert (grid == {0}) == (policy != "now")


def test_timing(sink: Sink) -> None:
    offsets = {}
    for timing in ("stamp", "arrival"):
        sink.play("late.pcap", "--stamp", "shift", "--speed", 100, "--timing", timing, "--ledger", "x.parquet")
        row = rows_of(Path("x.parquet"))[0]
        offsets[timing] = (row["scheduled_ns"] - row["time_ns"]) // 1_000_000
    assert offsets == {"stamp": 0, "arrival": 30}


@pytest.mark.parametrize(
    ("options", "last_ms"),
    [
        (("--speed", "100"), 9.8),
        (("--speed", "100", "--interval", "10"), 4.9),
        (("--speed", "100", "--fps", "100"), 4.9),
        (("--speed", "100", "--loop", "3"), 29.8),
    ],
)
def test_what_sets_the_pace(sink: Sink, options: tuple[str, ...], last_ms: float) -> None:
    stamp = "now" if "--fps" in options else "keep"
    heard = sink.play("one.c37118", "--stamp", stamp, "--ledger", "x.parquet", *options)
    assert rows_of(Path("x.parquet"))[-1]["offset_ns"] == pytest.approx(last_ms * 1e6, abs=1)
    assert heard.configs[7].data_rate == (100 if "--fps" in options else 50)


def test_at(sink: Sink) -> None:
    begin_ns = (time.time_ns() // NS + 2) * NS
    said = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(begin_ns // NS))
    sink.play("one.c37118", "--speed", 100, "--at", said, "--ledger", "x.parquet")
    assert rows_of(Path("x.parquet"))[0]["scheduled_ns"] == begin_ns


def test_cfg_period(sink: Sink) -> None:
    def announced(period: object) -> int:
        frames = sink.play("one.c37118", "--stamp", "keep", "--cfg-period", period).frames
        return sum(decode_prefix(frame).type is FrameType.CFG2 for frame in frames)

    assert announced(0) == 1
    assert announced(0.25) >= 3


def test_duration(sink: Sink) -> None:
    began = time.monotonic()
    heard = sink.play("one.c37118", "--stamp", "keep", "--loop", 0, "--duration", 0.5)
    assert 0.5 <= time.monotonic() - began < 5
    assert len(heard.data) <= 26


def test_paused_and_duration(sink: Sink) -> None:
    assert sink.play("one.c37118", *FAST, "--paused", "--duration", 0.3).data == []


# --- faults


def rows_of(path: Path) -> list[dict[str, Any]]:
    import pyarrow.parquet as pq

    return list(pq.read_table(path).to_pylist())


FAULTS = {
    "corrupt": ("100%", lambda row: "corrupt" in row["faults"] or "bits" in row["faults"]),
    "config": ("count()", None),
    "disable": ("N1@0..1", lambda row: row["fate"] == "disabled"),
    "drop": ("every 2", lambda row: row["fate"] == "dropped"),
    "loss": ("100%", lambda row: row["fate"] == "lost"),
    "duplicate": ("100%", lambda row: row["copy"] == 1),
    "delay": ("constant(16)", lambda row: "delay:16ms" in row["faults"]),
    "reorder": ("50%", None),
    "rate": ("64k", None),
    "slot": ("constant(40)", None),
    "segment": ("100% split(parts=2)", None),
}


@pytest.mark.parametrize("option", FAULTS)
def test_each_fault_is_an_option_and_in_the_ledger(sink: Sink, option: str) -> None:
    value, marked = FAULTS[option]
    sink.play("one.c37118", *FAST, "--ledger", "plain.parquet")
    heard = sink.play("one.c37118", *FAST, "--ledger", "x.parquet", f"--{option}", value, "--seed", 3)
    plain, rows = rows_of(Path("plain.parquet")), rows_of(Path("x.parquet"))
    if marked is not None:
        assert any(map(marked, rows))
        assert not any(map(marked, plain))
    elif option == "config":
        assert heard.configs[7].stations[0].cfgcnt == 1
    elif option != "segment":  # which is seen over TCP only
        assert [row["offset_ns"] for row in rows] != [row["offset_ns"] for row in plain]


def test_impair_and_seed(sink: Sink) -> None:
    Path("p.ini").write_text("[run]\nseed = 5\n[stream N*]\nloss = 50%\n[at 1]\ndo = speed 400\n")

    def numbers(*options: object) -> list[int]:
        return sink.play("two.c37118", *FAST, "--impair", "p.ini", *options).numbers()

    first = numbers()
    assert 20 < len(first) < 80
    assert numbers() == first
    assert numbers("--seed", 6) != first
    assert numbers("--loss", "none") == [*range(100)]


def test_a_ready_profile(sink: Sink) -> None:
    sink.play("one.c37118", *FAST, "--impair", "table1", "--ledger", "x.parquet")
    delays = [float(row["faults"].removeprefix("delay:").removesuffix("ms")) for row in rows_of(Path("x.parquet"))]
    assert all(55 <= delay <= 88 for delay in delays)


# --- how it is done


def test_portable_runs_end_to_end(sink: Sink) -> None:
    heard = sink.play("two.c37118", *FAST, "--portable", "--ledger", "x.parquet", "--emulate", 10)
    assert heard.counts == {7 + k: 100 for k in range(10)}
    rows = rows_of(Path("x.parquet"))
    assert {row["fate"] for row in rows} == {"sent"}
    assert {row["tx_stamp_ns"] for row in rows} == {None}


def test_departures_are_stamped_by_the_kernel_into_the_ledger(sink: Sink) -> None:
    from pmutools import linux

    if not linux.NATIVE:
        pytest.skip("Linux's stamps")
    sink.play("one.c37118", *FAST, "--ledger", "x.parquet", "--speed", 20)
    rows = rows_of(Path("x.parquet"))
    stamped = [row for row in rows if row["tx_stamp_ns"] is not None]
    assert len(stamped) >= len(rows) - 5
    assert all(-50_000 < row["tx_stamp_ns"] - row["scheduled_ns"] < NS for row in stamped)


def test_fifo_without_privilege_is_told_and_the_player_goes_on(sink: Sink, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    heard = sink.play("one.c37118", *FAST, "--fifo")
    assert heard.counts == {7: 50}
    assert "SCHED_FIFO: Operation not permitted; run as root or with CAP_SYS_NICE for it" in heard.result.err


def test_json_quiet_and_verbose(sink: Sink) -> None:
    heard = sink.play("two.c37118", *FAST, "--json", "--quiet")
    (first, second) = json.loads(heard.result.out)["streams"]
    assert (first["name"], first["fates"], second["idcode"]) == ("N1", {"sent": 100}, 8)
    assert heard.result.err == ""
    many = ("one.c37118", *FAST, "--emulate", 30)
    assert sink.play(*many).result.err.count("late p50") == 6
    assert sink.play(*many, "-v").result.err.count("late p50") == 30


def test_listen(pmu: Pmu) -> None:
    port = free_port()
    with started("play", "two.c37118", "--listen", f"tcp://127.0.0.1:{port}", "--loop", 0) as player:
        wait_for_tcp(port, player)
        told = pmu("info", f"tcp://127.0.0.1:{port}?idcode=8", "--duration", 1.5, "--json")
        assert told.json["streams"][0]["frames"] > 5
        player.send_signal(2)
        assert ended(player).code == 130


def test_every_option_has_a_test(pmu: Pmu) -> None:
    """Here, or (the screen and the orders) in test_play_live."""
    known = set(re.findall(r"--[a-z-]+", pmu("play", "--help").out))
    written = Path(__file__).read_text() + Path(__file__).with_name("test_play_live.py").read_text()
    general = {"--help", "--debug", "--verbose"}
    faults = {f"--{option}" for option in FAULTS}
    assert {option for option in known - general - faults if f'"{option}"' not in written} == set()
    assert faults <= known


# --- mistakes


MISTAKES = [
    ("--plant modal one.c37118", 2, "--plant and one.c37118: play one or the other"),
    ("", 2, "what is to be played? name a recording, or give --plant NAME"),
    ("one.c37118 --pmus 3", 2, "--pmus is of a simulated grid; give --plant NAME too"),
    ("one.c37118 --scenario cjb", 2, "--scenario is of a simulated grid; give --plant NAME too"),
    ("one.c37118 --spread mag=1", 2, "--spread makes emulated PMUs differ; give --emulate N too"),
    ("one.c37118 --emulate 5 --spread volts=1", 2, "--spread"),
    ("one.c37118 --emulate 70000", 2, "--emulate"),
    ("one.c37118 --format cubic", 2, "--format"),
    ("two.c37118 --idcode 7=8", 2, "8"),
    ("two.c37118 --idcode 7=1 --idcode 7=2", 2, "--idcode 7: given twice, once as 1 and once as 2"),
    ("one.c37118 --at tomorrow", 2, "--at"),
    ("one.c37118 --impair bad.ini", 2, "bad.ini:3: [stream N*] losss"),
    ("one.c37118 --impair late.ini", 2, "late.ini:2"),
    ("one.c37118 --interactive", 2, "--interactive"),
    ("one.c37118 --control one.c37118", 2, "one.c37118: a file is there that is no socket"),
    ("one.c37118 --control nodir/x.sock", 1, "no such folder; make it first"),
    ("one.c37118 --ledger one.c37118", 2, "one.c37118 is an input"),
    ("empty.c37118", 1, "empty.c37118"),
    ("two.c37118 one.c37118 --listen tcp://127.0.0.1:0", 2, "both have IDCODE 7"),
    ("one.c37118 --corrupt bits(1)_field=analogs", 2, "corrupt"),
]


@pytest.mark.parametrize(("line", "code", "why"), MISTAKES, ids=[line for line, _, _ in MISTAKES])
def test_mistakes(pmu: Pmu, line: str, code: int, why: str) -> None:
    Path("bad.ini").write_text("[run]\n[stream N*]\nlosss = 5%\n")
    Path("late.ini").write_text("[at 5]\ndo = resume\n")
    Path("empty.c37118").touch()
    result = pmu("play", *(word.replace("_", " ") for word in line.split()), "--to", NOWHERE, "-q")
    assert result.code == code, result.err
    assert why in result.complaint


def test_an_unreadable_file_and_busy_places(pmu: Pmu) -> None:
    Path("nothing").mkdir()
    result = pmu("play", "nothing", "--to", NOWHERE)
    assert result.code == 1
    assert result.complaint.startswith("pmu: nothing is a folder without recordings")
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        port = listener.getsockname()[1]
        result = pmu("play", "one.c37118", "--listen", f"tcp://127.0.0.1:{port}")
        assert result.code == 1
        assert f"127.0.0.1:{port}" in result.complaint
        result = pmu("play", "one.c37118", "--to", NOWHERE, "--control", f"127.0.0.1:{port}")
        assert result.code == 1
        assert "--control" in result.complaint
    with socket.socket(socket.AF_UNIX) as other:
        other.bind("busy.sock")
        other.listen()
        result = pmu("play", "one.c37118", "--to", NOWHERE, "--control", "./busy.sock")
        assert (result.code, "another player is controlled there" in result.complaint) == (1, True)
