"""``pmu play`` and ``pmu read`` as processes: bound in time, ended cleanly, nothing lost, told in one line."""

from __future__ import annotations

import json
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support.commands import ended, run_pmu, started, wait_for_tcp, wait_for_udp
from support.live import free_udp_port
from support.peers import free_port
from support.playing import recording, stream
from support.recordings import blocks_of, write

from pmutools.formats import open_source

pytestmark = pytest.mark.realtime


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """Six seconds of one stream, whose configuration comes first."""
    path = tmp_path / "source.c37118"
    write(path, recording(stream(7, name="ALPHA"), 300))
    return path


def frames_in(path: Path) -> int:
    return sum(len(block.batch) for block in blocks_of(open_source(path)))


def send(port: int, frames: list[bytes], *, source_port: int = 0) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind(("127.0.0.1", source_port))
        for frame in frames:
            sender.sendto(frame, ("127.0.0.1", port))


# --- starting


def test_a_datagram_sent_one_second_after_the_start_is_logged(tmp_path: Path) -> None:
    """Also on a busy machine: what has to be imported before binding is little."""
    port, out = free_udp_port(), tmp_path / "log.csv"
    frames = [message.frame.data for message in recording(stream(), 10)]
    began = time.monotonic()
    with started("read", f"udp://127.0.0.1:{port}", "--out", out, "--duration", 3) as reader:
        time.sleep(max(0.0, began + 1 - time.monotonic()))
        send(port, frames)
        result = ended(reader)
    assert result.code == 0, result.err
    assert frames_in(out) == 10


def test_a_reader_binds_before_it_imports_what_is_slow() -> None:
    """Judged by processor time, beside a start that does nothing; the wall's is others' too on a busy machine."""
    port = free_udp_port()
    with started("read", f"udp://127.0.0.1:{port}", "--out", "-", "--duration", 1.2) as reader:
        wait_for_udp(port, reader)
        ticks = Path(f"/proc/{reader.pid}/stat").read_text().rpartition(")")[2].split()[11:13]
        bound_s = sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")
        reader.send_signal(signal.SIGINT)
        ended(reader)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    run_pmu("--version")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    plain_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    assert bound_s < plain_s + 0.4


AT_THE_BIND = """
import os, sys

def look(event, given):
    if event == "socket.bind":
        slow = ("numpy", "pyarrow", "scapy", "mcap", "google", "rich", "scipy", "matplotlib", "plotly", "zstandard")
        os.write(1, " ".join(name for name in slow if name in sys.modules).encode() + b"bound")
        os._exit(0)

sys.addaudithook(look)
from pmutools.cli import main
main()
"""


@pytest.mark.parametrize(
    "options",
    [
        "read --out x.parquet",
        "read --out x.pcapng --live",
        "read --out x.csv --fields time --split 1h",
        "read --out x.csv --long --trigger freq<59.95",
        "characterize --out run --live",
        "characterize --out run --ledger x.parquet --require loss<=1%",
    ],
)
@pytest.mark.parametrize("named", [False, True])
def test_nothing_slow_is_imported_before_the_sockets_are_bound(options: str, named: bool, tmp_path: Path) -> None:
    (tmp_path / "pmus.ini").write_text("[pmu N1]\nurl = udp://127.0.0.1:0\nidcode = 7\n")
    where = ["--ini", "pmus.ini"] if named else ["udp://127.0.0.1:0"]
    done = subprocess.run(
        [sys.executable, "-c", AT_THE_BIND, *options.split(), *where],
        capture_output=True,
        text=True,
        timeout=60,
        cwd=tmp_path,
        check=False,
    )
    assert (done.stdout, done.stderr) == ("bound", "")


def test_duration_counts_from_the_start(tmp_path: Path) -> None:
    port, out = free_udp_port(), tmp_path / "log.parquet"
    frames = [message.frame.data for message in recording(stream(), 10)]
    began = time.monotonic()
    with started("read", f"udp://127.0.0.1:{port}", "--out", out, "--duration", 1.5, "--json") as reader:
        wait_for_udp(port, reader)
        send(port, frames)
        result = ended(reader)
    took = time.monotonic() - began
    assert 1.5 <= took < 4
    assert result.json["frames"] == 10


# --- ending


@pytest.mark.parametrize(
    ("suffix", "number"),
    [
        (".csv", signal.SIGINT),
        (".parquet", signal.SIGTERM),
        (".mcap", signal.SIGINT),
        (".pcap", signal.SIGTERM),
        (".arrow", signal.SIGINT),
    ],
)
def test_an_interrupted_reader_keeps_what_has_come(suffix: str, number: signal.Signals, tmp_path: Path) -> None:
    port, out = free_udp_port(), tmp_path / f"log{suffix}"
    frames = [message.frame.data for message in recording(stream(), 40)]
    with started("read", f"udp://127.0.0.1:{port}", "--out", out) as reader:
        wait_for_udp(port, reader)
        send(port, frames)
        time.sleep(0.3)  # for what is in the kernel to be taken; how long it takes is not judged
        reader.send_signal(number)
        result = ended(reader)
    assert result.code == 130, result.err
    assert "40 frames of 1 streams" in result.err
    assert "Traceback" not in result.err
    assert frames_in(out) == 40


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_player_leaves_a_readable_ledger(number: signal.Signals, source: Path, tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    ledger = tmp_path / "ledger.parquet"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sink:
        sink.bind(("127.0.0.1", 0))
        sink.settimeout(15)
        url = f"udp://127.0.0.1:{sink.getsockname()[1]}"
        with started("play", source, "--to", url, "--ledger", ledger, "--loop", 0, "--json") as player:
            heard = [sink.recv(1 << 16)[1] >> 4 for _ in range(6)]  # configurations, and some data
            player.send_signal(number)
            result = ended(player)
    assert result.code == 130, result.err
    rows = pq.read_table(ledger).to_pylist()
    assert len(rows) >= heard.count(0) > 0
    assert [row["index"] for row in rows] == [*range(len(rows))]
    assert result.json["streams"][0]["fates"] == {"sent": len(rows)}


def test_a_player_that_waits_for_clients_can_be_interrupted(source: Path) -> None:
    port = free_port()
    with started("play", source, "--listen", f"tcp://127.0.0.1:{port}") as player:
        wait_for_tcp(port, player)
        player.send_signal(signal.SIGINT)
        result = ended(player)
    assert result.code == 130
    assert "nothing due" in result.err


# --- the two together


@pytest.mark.parametrize("scheme", ["udp", "tcp"])
def test_player_and_reader_over(scheme: str, source: Path, tmp_path: Path) -> None:
    port, out = (free_port() if scheme == "tcp" else free_udp_port()), tmp_path / "log.csv"
    url = f"{scheme}://127.0.0.1:{port}" + ("" if scheme == "udp" else "?idcode=7")
    with started("read", url, "--out", out, "--duration", 3, "--json") as reader:
        if scheme == "udp":
            wait_for_udp(port, reader)
        played = run_pmu("play", source, "--to" if scheme == "udp" else "--listen", url, "--speed", 20, "--json")
        result = ended(reader)
    assert played.code == 0, played.err
    assert played.json["streams"][0]["fates"] == {"sent": 300}
    assert result.code == 0, result.err
    assert json.loads(result.out)["frames"] == frames_in(out) == 300


def test_several_addresses_become_a_folder_of_tables(tmp_path: Path) -> None:
    ports = sorted({free_udp_port() for _ in range(3)})
    out = tmp_path / "logs.csv"
    urls = [f"udp://127.0.0.1:{port}" for port in ports]
    with started("read", *urls, "--out", out, "--duration", 1.5, "--json") as reader:
        for number, port in enumerate(ports):
            wait_for_udp(port, reader)
            config = stream(10 + number, name=f"PMU{number}")
            send(port, [message.frame.data for message in recording(config, 20 + number)])
        result = ended(reader)
    assert result.code == 0, result.err
    assert [each["frames"] for each in result.json["streams"]] == [20 + k for k in range(len(ports))]
    written = sorted(Path(path) for path in result.json["paths"])
    assert [path.name for path in written] == [f"PMU{k}-{10 + k}.csv" for k in range(len(ports))]
    assert {path.parent for path in written} == {tmp_path / "logs"}
    assert [frames_in(path) for path in written] == [20 + k for k in range(len(ports))]


def test_one_address_brings_several_streams_and_an_idcode_picks_one(tmp_path: Path) -> None:
    port = free_udp_port()
    with started("read", f"udp://127.0.0.1:{port}?idcode=2", "--out", tmp_path / "x.csv", "--duration", 1.2) as reader:
        wait_for_udp(port, reader)
        for idcode in (1, 2, 3):
            send(port, [message.frame.data for message in recording(stream(idcode), 10)])
        result = ended(reader)
    assert result.code == 0, result.err
    assert "10 frames of 1 streams" in result.err
    assert "IDCODE 1 comes from 127.0.0.1" in result.err


def test_csv_goes_to_standard_output_as_it_comes() -> None:
    port = free_udp_port()
    with started("read", f"udp://127.0.0.1:{port}", "--out", "-") as reader:
        wait_for_udp(port, reader)
        send(port, [message.frame.data for message in recording(stream(), 5)])
        assert reader.stdout is not None
        lines = [reader.stdout.readline() for _ in range(6)]
        reader.send_signal(signal.SIGINT)
        assert ended(reader).code == 130
    assert lines[0].startswith("time,arrival_ns,stamp_source")
    assert lines[5].startswith("2016-09-08T17:05:11.080000000Z")


# --- what can be wrong


def test_a_reader_that_nothing_came_to_fails_and_says_what_to_look_at(tmp_path: Path) -> None:
    url = f"udp://127.0.0.1:{free_udp_port()}"
    result = run_pmu("read", url, "--out", tmp_path / "x.csv", "--duration", 0.5, "--quiet")
    assert result.code == 1
    assert result.complaint.startswith(f"pmu: no data from {url}: nothing came; is the sender on, and sending to this")


def test_bytes_that_are_no_frames_are_exit_code_3(tmp_path: Path) -> None:
    port, out = free_udp_port(), tmp_path / "x.csv"
    frames = [message.frame.data for message in recording(stream(), 10)]
    with started("read", f"udp://127.0.0.1:{port}", "--out", out, "--duration", 1.2, "--json") as reader:
        wait_for_udp(port, reader)
        send(port, [*frames[:5], b"\xaa\x01 garbage", *frames[5:]], source_port=free_udp_port())
        result = ended(reader)
    assert result.code == 3
    assert (result.json["frames"], sum(result.json["skipped"].values())) == (10, 10)
    assert frames_in(out) == 10


def test_a_strangers_noise_is_exit_code_3_too(tmp_path: Path) -> None:
    port, out = free_udp_port(), tmp_path / "x.csv"
    with started("read", f"udp://127.0.0.1:{port}", "--out", out, "--duration", 1.2, "--json") as reader:
        wait_for_udp(port, reader)
        send(port, [message.frame.data for message in recording(stream(), 10)], source_port=free_udp_port())
        send(port, [b"no frame"] * 5, source_port=free_udp_port())
        result = ended(reader)
    assert result.code == 3
    told = result.json
    assert (told["frames"], told["skipped"], told["ignored_bytes"], told["ignored_flows"]) == (10, {}, 40, 1)
    assert "40 bytes of 1 sender without a single frame" in result.err


def test_data_without_a_configuration_are_told_and_are_exit_code_3(tmp_path: Path) -> None:
    port = free_udp_port()
    with started("read", f"udp://127.0.0.1:{port}", "--out", tmp_path / "x.csv", "--duration", 1.2) as reader:
        wait_for_udp(port, reader)
        send(port, [message.frame.data for message in recording(stream(), 10, announced=False)])
        result = ended(reader)
    assert result.code == 3
    assert "held until one comes" in result.err
    assert "260 bytes skipped: no-config: no configuration came for 10 frames: not kept; a capture" in result.err


@pytest.mark.parametrize("suffix", ["pcapng", "c37118", "mcap"])
def test_captures_keep_data_without_a_configuration(suffix: str, tmp_path: Path) -> None:
    port, out = free_udp_port(), tmp_path / f"x.{suffix}"
    with started("read", f"udp://127.0.0.1:{port}", "--out", out, "--duration", 1.2, "--json") as reader:
        wait_for_udp(port, reader)
        send(port, [message.frame.data for message in recording(stream(), 10, announced=False)])
        result = ended(reader)
    assert result.code == 3
    assert "260 bytes undecoded: no-config: no configuration came for 10 frames: kept undecoded" in result.err
    told = result.json
    assert (told["frames"], told["undecoded_frames"], told["kept_undecoded"]) == (0, 10, 10)
    found = run_pmu("dump", out, "--json")
    assert [(each["reason"], each["nbytes"]) for each in found.lines] == [("no-config", 26)] * 10


@pytest.mark.slow
def test_a_wrong_idcode_is_told_with_what_was_asked_for(source: Path, tmp_path: Path) -> None:
    port = free_port()
    with started("play", source, "--listen", f"tcp://127.0.0.1:{port}") as player:
        wait_for_tcp(port, player)
        url = f"tcp://127.0.0.1:{port}?idcode=9"
        result = run_pmu("read", url, "--out", tmp_path / "x.csv", "--duration", 10)
        assert result.code == 1
        assert "a device answers its own IDCODE only, IDCODE 9 was asked for" in result.err
        player.send_signal(signal.SIGINT)
        ended(player)


def refused() -> tuple[str, str]:
    """A URL that nothing serves, and what is said of it."""
    url = f"tcp://127.0.0.1:{free_port()}"
    return url, f"{url}: refused: nothing serves this port; is the device on, and the port right?"


def test_info_of_a_port_that_nothing_serves_says_so() -> None:
    url, reason = refused()
    result = run_pmu("info", url, "--duration", 0.3)
    assert result.code == 1
    assert result.out == ""
    assert result.err.splitlines() == [reason.replace(": refused", ": failed: refused"), f"pmu info: {reason}"]
    assert run_pmu("info", url, "--duration", 0.3, "--quiet").complaint == f"pmu info: {reason}"


def test_dump_of_a_port_that_nothing_serves_says_so_once() -> None:
    """It is tried again meanwhile, and the same news are no news."""
    url, reason = refused()
    result = run_pmu("dump", url, "--duration", 1.2)
    assert result.code == 1
    assert result.err.splitlines() == [reason.replace(": refused", ": failed: refused"), f"pmu dump: {reason}"]
    told = run_pmu("dump", url, "--duration", 1.2, "-v").err.splitlines()
    assert len(told) > 2 and set(told[:-1]) == {result.err.splitlines()[0]}


def test_info_that_is_interrupted_tells_what_it_has_seen() -> None:
    port = free_udp_port()
    url = f"udp://127.0.0.1:{port}"
    with started("info", url, "--duration", 60, "-v") as info:
        wait_for_udp(port, info)
        assert info.stderr is not None
        assert "bound: receive buffer" in info.stderr.readline()
        send(port, [message.frame.data for message in recording(stream(7, name="ALPHA"), 10)])
        while "streaming" not in (line := info.stderr.readline()):
            assert line
        info.send_signal(signal.SIGINT)
        result = ended(info)
    assert result.code == 130, result.err
    assert result.out.startswith(f"{url}  live, ")
    assert "ALPHA" in result.out


def test_dump_of_a_live_stream_shows_frames_as_they_come() -> None:
    port = free_udp_port()
    with started("dump", f"udp://127.0.0.1:{port}") as dump:
        wait_for_udp(port, dump)
        send(port, [message.frame.data for message in recording(stream(), 3)])
        assert dump.stdout is not None
        kinds = [dump.stdout.readline().split()[2] for _ in range(4)]
        dump.send_signal(signal.SIGINT)
        result = ended(dump)
    assert kinds == ["cfg2", "data", "data", "data"]
    assert (result.code, result.err) == (130, "")


def test_info_and_dump_of_a_live_stream(source: Path) -> None:
    port = free_port()
    with started("play", source, "--listen", f"tcp://127.0.0.1:{port}", "--loop", 0, "--speed", 5) as player:
        wait_for_tcp(port, player)
        url = f"tcp://127.0.0.1:{port}?idcode=7"
        told = run_pmu("info", url, "--duration", 1, "--json")
        assert told.code == 0, told.err
        assert told.json["path"] == url
        assert told.json["streams"][0]["frames"] > 20
        lines = run_pmu("dump", url, "--duration", 1, "--json")
        assert lines.code == 0, lines.err
        assert {"cfg3", "data"} <= {line["type"] for line in lines.lines}
        player.send_signal(signal.SIGINT)
        ended(player)
