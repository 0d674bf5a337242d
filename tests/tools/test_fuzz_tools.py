"""Whatever a file or a network brings, the tools end in time, with an exit code, one line, and counts that add up."""

from __future__ import annotations

import random
import socket
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.commands import Result, run_here
from support.frames import random_stream
from support.playing import recording, stream
from support.recordings import messages_of, write

from pmutools.c37118 import Message
from pmutools.c37118.demux import Loss
from pmutools.clock import SystemClock
from pmutools.errors import PmuError
from pmutools.formats import open_sink, open_source
from pmutools.formats.source import gather
from pmutools.net.endpoint import parse_endpoint
from pmutools.tools.inventory import take_inventory
from pmutools.tools.live import LiveSource
from pmutools.tools.player.cast import as_recorded
from pmutools.tools.player.play import Options, Player
from pmutools.tools.player.reel import record
from pmutools.tools.reader import read

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")  # a user would see it on stderr

SUFFIXES = (".pcap", ".pcapng", ".c37118", ".csv", ".parquet", ".arrow", ".mcap", ".pcap.gz", ".csv.zst", ".c37118.gz")
OF_FRAMES = (".pcap", ".pcapng", ".c37118", ".mcap")
FUZZ = settings(
    max_examples=60, deadline=10_000, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large]
)


@cache
def whole(suffix: str) -> bytes:
    """A small recording of that format."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"whole{suffix}"
        write(path, messages_of(random_stream(random.Random(1), stations=2, frames=30, data_rate=50)))
        return path.read_bytes()


@st.composite
def damaged(draw: st.DrawFn, octets: bytes) -> bytes:
    """``octets`` with flipped bits, bytes put in or taken out, numbers that lie, the end cut off."""
    spoilt = bytearray(octets)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(len(spoilt) - 1, 0)))
        match draw(st.sampled_from(("flip", "lie", "insert", "remove", "cut", "repeat"))):
            case "flip":
                spoilt[at : at + 1] = bytes(value ^ draw(st.integers(1, 255)) for value in spoilt[at : at + 1])
            case "lie":
                lie = draw(
                    st.sampled_from(
                        (b"\0\0", b"\xff\xff", b"\xff\xff\xff\xff", b"\0\0\0\0", b"\x7f\xff\xff\xff", b"\xff" * 8)
                    )
                )
                spoilt[at : at + len(lie)] = lie
            case "insert":
                spoilt[at:at] = draw(st.binary(min_size=1, max_size=40))
            case "remove":
                del spoilt[at : at + draw(st.integers(1, 60))]
            case "cut":
                del spoilt[at:]
            case "repeat":
                spoilt[at:at] = spoilt[at : at + draw(st.integers(1, 200))]
    return bytes(spoilt)


@st.composite
def anything(draw: st.DrawFn) -> tuple[str, bytes]:
    """A suffix, and content that may have to do with it."""
    suffix = draw(st.sampled_from(SUFFIXES))
    if draw(st.integers(0, 9)) == 0:
        return suffix, draw(st.binary(max_size=500))
    content = whole(draw(st.sampled_from(SUFFIXES)) if draw(st.integers(0, 9)) == 0 else suffix)
    return suffix, draw(damaged(content))


@contextmanager
def file_of(suffix: str, content: bytes) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"fuzz{suffix}"
        path.write_bytes(content)
        yield path


def fair(result: Result, *, silent: bool = False) -> None:
    """A documented exit code; where it failed, one line says why, and nothing is internal to us."""
    assert result.code in (0, 1, 2, 3)
    assert "internal error" not in result.err
    assert "Traceback" not in result.err
    if result.code in (1, 2):
        assert result.complaint.startswith("pmu")
    elif silent:
        assert result.err == ""


@FUZZ
@given(anything())
def test_info_of_anything(case: tuple[str, bytes]) -> None:
    with file_of(*case) as path:
        result = run_here("info", path, "--json", "--quiet")
        fair(result, silent=True)
        if result.code in (0, 3) and result.out:
            told = result.json
            assert told["frames"] or told["skipped"]
            assert (result.code == 3) == bool(told["skipped"] or told["defects"])
        assert run_here("info", path, "--quiet").code == result.code


@FUZZ
@given(anything())
def test_dump_of_anything(case: tuple[str, bytes]) -> None:
    with file_of(*case) as path:
        result = run_here("dump", path, "--json", "--quiet")
        fair(result, silent=True)
        if result.code in (0, 3):
            skipped = [line for line in result.lines if line["type"] == "skipped"]
            assert not skipped or result.code == 3
        text = run_here("dump", path, "--quiet")
        assert text.code == result.code
        assert text.out.count("\n") == result.out.count("\n"), "one line a frame"


@FUZZ
@given(anything(), st.sampled_from((".csv", ".parquet", ".c37118", ".mcap", ".pcap")), st.booleans())
def test_convert_of_anything(case: tuple[str, bytes], to: str, cut: bool) -> None:
    with file_of(*case) as path:
        options = ("--start", "0.1", "--end", "0.4") if cut else ()
        out = path.with_name(f"out{to}")
        result = run_here("convert", path, out, "--json", "--quiet", *options)
        fair(result, silent=True)
        if result.code in (0, 3):
            told = result.json
            assert told["frames"] > 0
            assert (result.code == 3) == bool(told["losses"])
            again = run_here(
                "info", Path(told["paths"][0]).parent if len(told["paths"]) > 1 else told["paths"][0], "--json"
            )
            fair(again)


@FUZZ
@given(st.sampled_from(OF_FRAMES).flatmap(lambda suffix: st.tuples(st.just(suffix), damaged(whole(suffix)))))
def test_bytes_of_frames_are_framed_skipped_or_ignored(case: tuple[str, bytes]) -> None:
    with file_of(*case) as path:
        try:
            source = open_source(path)
            inventory = take_inventory(source)
        except PmuError:
            return
        tally = source.tally
        assert tally.fed == tally.framed + tally.skipped_bytes + tally.ignored
        assert inventory.bytes_in == tally.fed
        messages = [item for item in open_source(path).items() if isinstance(item, Message)]
        assert sum(len(message.frame.data) for message in messages) == tally.framed
        losses = [item for item in open_source(path).items() if isinstance(item, Loss)]
        assert sum(loss.skipped.nbytes for loss in losses) == tally.skipped_bytes


@FUZZ
@given(anything())
def test_playing_anything_begins_or_says_why_not(case: tuple[str, bytes]) -> None:
    with file_of(*case) as path:
        result = run_here("play", path, "--to", "udp://127.0.0.1:9", "--duration", "0.001", "--quiet")
        fair(result, silent=True)


# --- live


@st.composite
def traffic(draw: st.DrawFn) -> list[bytes]:
    """Pieces as a hostile network would bring them: frames, frames spoilt, frames cut and joined, noise."""
    frames = [message.frame.data for message in recording(stream(), 10)]
    others = [message.frame.data for message in recording(stream(8), 5)]
    pieces = []
    for _ in range(draw(st.integers(1, 25))):
        frame = draw(st.sampled_from(frames + others))
        match draw(st.sampled_from(("frame", "frame", "spoilt", "joined", "half", "noise"))):
            case "frame":
                pieces.append(frame)
            case "spoilt":
                pieces.append(draw(damaged(frame)))
            case "joined":
                pieces.append(frame + draw(st.sampled_from(frames)))
            case "half":
                pieces.append(frame[: draw(st.integers(0, len(frame)))])
            case "noise":
                pieces.append(draw(st.binary(max_size=60)))
    return pieces


def adds_up(source: LiveSource, received: int) -> None:
    tally = source.tally
    assert tally.fed == received
    assert tally.fed == tally.framed + tally.skipped_bytes + tally.ignored


@pytest.mark.realtime
@FUZZ
@given(traffic())
def test_any_datagrams_are_read_and_accounted_for(pieces: list[bytes]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        source = LiveSource(["udp://127.0.0.1:0"], stop=lambda: True)
        local = source.receivers.local(0)
        assert local is not None
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for piece in pieces:
                sender.sendto(piece, ("127.0.0.1", local.port))
            with source, open_sink(Path(folder) / "log.csv") as sink:
                reading = read(source, sink)
        adds_up(source, sum(map(len, pieces)))
        assert reading.frames == source.tally.frames.get(0, 0)


@pytest.mark.realtime
@settings(FUZZ, max_examples=25)
@given(traffic())
def test_anything_that_a_server_sends_is_read_and_accounted_for(pieces: list[bytes]) -> None:
    total = sum(map(len, pieces))
    with socket.create_server(("127.0.0.1", 0)) as server, tempfile.TemporaryDirectory() as folder:

        def serve() -> None:
            connection, _ = server.accept()
            with connection:
                for piece in pieces:
                    connection.sendall(piece)
                connection.settimeout(5)
                while connection.recv(1 << 12):  # until the reader hangs up: a reset would take what it has not read
                    pass

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        clock = SystemClock()
        end_ns = clock.monotonic_ns() + 5_000_000_000
        url = f"tcp://127.0.0.1:{server.getsockname()[1]}?idcode=7"
        source = LiveSource([url], stop=lambda: source.tally.fed >= total or clock.monotonic_ns() > end_ns)
        with source, open_sink(Path(folder) / "log.mcap") as sink:
            read(source, sink)
        thread.join(5)
        adds_up(source, total)


@pytest.mark.realtime
@settings(FUZZ, max_examples=25)
@given(pieces=traffic(), scheme=st.sampled_from(("tcp", "udp+cmd")))
def test_anything_that_a_client_sends_leaves_the_player_alone(pieces: list[bytes], scheme: str) -> None:
    messages: Any = recording(stream(), 3)
    options = Options(listen=[parse_endpoint(f"{scheme}://127.0.0.1:0")], duration_ns=30_000_000)
    with Player(as_recorded(record(gather(messages))), options, SystemClock()) as player:
        address = player.senders.local(0)
        assert address is not None
        kind = socket.SOCK_STREAM if scheme == "tcp" else socket.SOCK_DGRAM
        with socket.socket(socket.AF_INET, kind) as client:
            client.connect(("127.0.0.1", address.port))
            for piece in pieces:
                client.send(piece)
            player.play()
    assert sum(player.results[0].fates.values()) <= 3
