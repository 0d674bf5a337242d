"""However a reader ends, what it had flushed can be read: kill -9, a full disk, a reader of its output that leaves."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from support.commands import Pmu, command, ended, run_pmu, started, wait_for_udp
from support.live import free_udp_port
from support.playing import START_NS, recording, stream
from support.recordings import blocks_of

from pmutools.errors import PmuError
from pmutools.formats import open_source
from pmutools.timebase import NS

pytestmark = pytest.mark.realtime
PATIENCE_S = 20.0
SUFFIXES = (
    ".csv",
    ".csv.gz",
    ".csv.zst",
    ".jsonl",
    ".parquet",
    ".arrow",
    ".mcap",
    ".pcapng",
    ".c37118.zst",
)
DISK_SUFFIXES = (".csv", ".csv.gz", ".parquet", ".arrow", ".mcap", ".pcapng")


def frames_of(idcode: int, count: int) -> list[bytes]:
    return [message.frame.data for message in recording(stream(idcode), count)]


def send(sockets: Sequence[socket.socket], frames: Sequence[bytes]) -> None:
    """To readers that may have gone."""
    for sender in sockets:
        with suppress(ConnectionRefusedError):
            for frame in frames:
                sender.send(frame)


def stamps_in(path: Path) -> dict[int, list[int]]:
    """Stamps by IDCODE of what can be read, whose values must be those sent; of a file that cannot be read, none."""
    found: dict[int, list[int]] = {}
    try:
        blocks = blocks_of(open_source(path))
    except (PmuError, OSError):
        return found
    for block in blocks:
        slots = np.rint((block.batch.time_ns - START_NS) * 50 / NS)
        assert np.allclose(block.batch.frequency[:, 0], 60 + slots / 1000, atol=1e-6), "frame k is 60 Hz + k mHz"
        found.setdefault(block.batch.config.idcode, []).extend(block.batch.time_ns.tolist())
    return found


@contextmanager
def senders(port: int, count: int) -> Iterator[list[socket.socket]]:
    sockets = []
    try:
        for _ in range(count):
            sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            sockets.append(sender)
            sender.bind(("127.0.0.1", 0))
            sender.connect(("127.0.0.1", port))
        yield sockets
    finally:
        for sender in sockets:
            sender.close()


def wait_until(condition: object, what: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < deadline, what
        time.sleep(0.05)


# --- kill -9


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """What readers in every format have left: fifty frames that were flushed, and any number of thirty more."""
    folder, frames = tmp_path_factory.mktemp("killed"), frames_of(7, 80)
    outs = {suffix: folder / suffix[1:] / f"log{suffix}" for suffix in SUFFIXES}
    with ExitStack() as stack:
        readers, sockets = [], []
        for out in outs.values():
            out.parent.mkdir()
            port = free_udp_port()
            readers.append((port, stack.enter_context(started("read", f"udp://127.0.0.1:{port}", "--out", out))))
            sockets += stack.enter_context(senders(port, 1))
        for port, reader in readers:
            wait_for_udp(port, reader)
        send(sockets, frames[:51])
        for out in outs.values():
            wait_until(lambda out=out: len(stamps_in(out).get(7, ())) == 50, f"{out} was never flushed")
        send(sockets, frames[51:])
        for _, reader in readers:
            reader.kill()
            assert ended(reader).code == -signal.SIGKILL
    return outs


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_killed_reader_leaves_what_it_had_flushed(suffix: str, killed: dict[str, Path], pmu: Pmu) -> None:
    stamps = stamps_in(killed[suffix])[7]
    assert 50 <= len(stamps) <= 80
    assert stamps == sorted(stamps)
    told = pmu("info", killed[suffix], "--json")
    assert told.code in (0, 3), told.err
    assert told.json["streams"][0]["frames"] == len(stamps)


@pytest.mark.parametrize("suffix", [".parquet", ".arrow"])
def test_what_a_killed_reader_left_is_played(suffix: str, killed: dict[str, Path]) -> None:
    out, port = killed[suffix], free_udp_port()
    played = run_pmu("play", out, "--to", f"udp://127.0.0.1:{port}", "--speed", 100, "--json", "--quiet")
    assert played.code in (0, 3), played.err
    assert played.json["streams"][0]["fates"] == {"sent": len(stamps_in(out)[7])}


@pytest.mark.parametrize("options", [(), ("--per-stream",), ("--long",)], ids=str)
def test_a_killed_reader_of_several_streams_leaves_its_frames(options: tuple[str, ...], tmp_path: Path) -> None:
    """Those of long form too, which itself does not play back."""
    port, out = free_udp_port(), tmp_path / "log.parquet"
    place = out if "--long" in options else tmp_path / "log"
    streams = [frames_of(idcode, 30) for idcode in (7, 8, 9)]
    with started("read", f"udp://127.0.0.1:{port}", "--out", out, *options) as reader, senders(port, 3) as sockets:
        wait_for_udp(port, reader)
        for sender, frames in zip(sockets, streams, strict=True):
            send([sender], frames)
        wait_until(lambda: sum(map(len, stamps_in(place).values())) == 90, "never flushed")
        reader.kill()
        ended(reader)
    assert {idcode: len(stamps) for idcode, stamps in stamps_in(place).items()} == {7: 30, 8: 30, 9: 30}


# --- a full disk


@pytest.fixture
def small_disks(tmp_path: Path) -> Iterator[dict[str, Path]]:
    """A file system of 100 kB for each format."""
    if not hasattr(os, "geteuid") or os.geteuid() or shutil.which("mount") is None:
        pytest.skip("only root can mount a small file system")
    with ExitStack() as stack:
        places = {}
        for suffix in DISK_SUFFIXES:
            places[suffix] = place = tmp_path / suffix[1:]
            place.mkdir()
            mount = ["mount", "-t", "tmpfs", "-o", "size=100k", "tmpfs", place]
            done = subprocess.run(mount, capture_output=True, text=True)
            if done.returncode:
                pytest.skip(f"no small file system can be mounted: {done.stderr.strip()}")
            stack.callback(subprocess.run, ["umount", place], check=True)
        yield places


@pytest.mark.slow
def test_a_full_disk_is_one_line_and_keeps_what_was_flushed(small_disks: dict[str, Path]) -> None:
    frames = frames_of(7, 12_000)
    with ExitStack() as stack:
        readers = {}
        for suffix, disk in small_disks.items():
            port = free_udp_port()
            reader = stack.enter_context(started("read", f"udp://127.0.0.1:{port}", "--out", disk / f"log{suffix}"))
            readers[suffix] = port, reader, stack.enter_context(senders(port, 1))
        for port, reader, sockets in readers.values():
            wait_for_udp(port, reader)
            send(sockets, frames[:101])
        for suffix, disk in small_disks.items():
            path = disk / f"log{suffix}"
            wait_until(lambda path=path: len(stamps_in(path).get(7, ())) == 100, f"{path} was never flushed")
        at = 101
        deadline = time.monotonic() + 3 * PATIENCE_S
        while any(reader.poll() is None for _, reader, _ in readers.values()) and time.monotonic() < deadline:
            for _, _, sockets in readers.values():
                send(sockets, frames[at : at + 100])
            at = at + 100 if at + 100 < len(frames) else 101
            time.sleep(0.02)
        results = {suffix: ended(reader) for suffix, (_, reader, _) in readers.items()}
    for suffix, result in results.items():
        assert result.code == 1, (suffix, result.err)
        (line,) = [line for line in result.err.splitlines() if "No space left" in line]
        assert line.startswith("pmu: ")
        assert "Traceback" not in result.err
        kept = int(re.findall(r"; (\d+) frames are kept, up to 2016-09-08T17:", line)[0])
        assert len(stamps_in(small_disks[suffix] / f"log{suffix}")[7]) >= kept >= 100, (suffix, line)


# --- places that cannot be written


@pytest.mark.parametrize("options", [(), ("--split", "1s"), ("--trigger", "loss"), ("--per-stream",)], ids=str)
@pytest.mark.parametrize("place", ["missing/log.csv", "file/log.csv"])
def test_what_cannot_be_written_is_told_before_anything_is_received(
    options: tuple[str, ...], place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pmu: Pmu
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("a file")
    result = pmu("read", f"udp://127.0.0.1:{free_udp_port()}", "--out", place, *options)
    assert result.code == 1
    assert "missing/log" in result.complaint or "file/log" in result.complaint
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_folder_is_no_file(tmp_path: Path, pmu: Pmu) -> None:
    (tmp_path / "log.csv").mkdir()
    result = pmu("read", f"udp://127.0.0.1:{free_udp_port()}", "--out", tmp_path / "log.csv")
    assert result.code == 1
    assert "log.csv: Is a directory" in result.complaint


# --- standard output


def test_a_reader_of_the_output_that_has_seen_enough_is_no_error() -> None:
    port = free_udp_port()
    arguments = command("read", f"udp://127.0.0.1:{port}", "--out", "-", "--quiet")
    reader = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        with senders(port, 1) as (sender,):
            wait_for_udp(port, reader)
            send([sender], frames_of(7, 20))
            assert reader.stdout is not None
            assert reader.stdout.readline().startswith("time,")
            reader.stdout.close()
            deadline = time.monotonic() + PATIENCE_S
            while reader.poll() is None and time.monotonic() < deadline:
                send([sender], frames_of(7, 20))
                time.sleep(0.05)
            assert reader.poll() == 0
            assert reader.stderr is not None
            assert reader.stderr.read() == ""
    finally:
        if reader.poll() is None:
            reader.kill()
        reader.wait(PATIENCE_S)
        if reader.stderr is not None:
            reader.stderr.close()
