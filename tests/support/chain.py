"""A recording played and read back in one process, over any transport; and what both ends made of its values."""

from __future__ import annotations

import contextlib
import random
import select
import socket
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import numpy as np
import numpy.typing as npt
from support.live import free_udp_port
from support.recordings import blocks_of

from pmutools.c37118 import FrameType
from pmutools.c37118.batch import Batch
from pmutools.c37118.config import StreamConfig
from pmutools.clock import SystemClock
from pmutools.formats import open_sink, open_source
from pmutools.net.endpoint import parse_endpoint
from pmutools.timebase import NS
from pmutools.tools.live import LiveSource
from pmutools.tools.player.cast import as_recorded
from pmutools.tools.player.ledger import LedgerWriter
from pmutools.tools.player.play import Options, Player
from pmutools.tools.player.reel import record
from pmutools.tools.reader import Reading, read

TRANSPORTS = ("udp", "udp+cmd", "tcp", "tcp+udp", "tcp, cut anew")
PATIENCE_S = 20.0
LOOPBACK = "127.0.0.1"
_LEAD_NS = 30_000_000


class EarlyClock(SystemClock):
    """UTC moved by less than a second, so that a reel's first frame is due at once and tests wait for nothing."""

    def __init__(self, first_due_ns: int) -> None:
        super().__init__()
        self.moved_ns = 0
        self.be_early(first_due_ns, _LEAD_NS)

    def be_early(self, first_due_ns: int, lead_ns: int) -> None:
        """Move UTC so that what is due at ``first_due_ns``, give or take whole seconds, is due in ``lead_ns``."""
        self.moved_ns = (first_due_ns - lead_ns - super().realtime_ns()) % NS

    def realtime_ns(self) -> int:
        return super().realtime_ns() + self.moved_ns


@contextmanager
def playing(player: Player, over: threading.Event, ledger: LedgerWriter | None = None) -> Iterator[threading.Thread]:
    """Play in a thread of its own; what goes wrong there fails the test. ``over`` is what tells the player to stop."""
    errors: list[BaseException] = []

    def run() -> None:
        try:
            with ledger or contextlib.nullcontext():
                player.play(ledger)
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=run, daemon=True)
    with player:
        thread.start()
        try:
            yield thread
        except BaseException:
            over.set()
            raise
        finally:
            thread.join(PATIENCE_S)
            over.set()
    assert not thread.is_alive(), "the player did not end"
    if errors:
        raise errors[0]


@dataclass
class Chain:
    """One pass: what was played, and what the reader said of it."""

    player: Player
    reading: Reading
    paths: list[Path] = field(default_factory=list)


def pass_through(path: Path, transport: str, out: Path, *, frames_per_s: int = 1500, seed: int = 1) -> Chain:
    """Play ``path`` faster than it was recorded and read it into ``out``, until all frames have come."""
    reel = record(open_source(path).blocks())
    total = len(reel.rows)
    span_s = Fraction(reel.length_ns, NS)
    speed = max(span_s * frames_per_s / total, Fraction(1)).limit_denominator(1000)
    clock = EarlyClock(reel.first_due_ns)
    over = threading.Event()
    patience_ns = SystemClock().monotonic_ns() + round(PATIENCE_S * NS)

    def player(**endpoints: Sequence[str]) -> Player:
        chosen = {name: tuple(map(parse_endpoint, urls)) for name, urls in endpoints.items()}
        options = Options(speed=speed, **chosen)  # type: ignore[arg-type]
        return Player(as_recorded(reel), options, clock, stop=over.is_set)

    def reader(url: str) -> LiveSource:
        source = LiveSource([url], stop=lambda: has(source, total) or clock.monotonic_ns() > patience_ns)
        return source

    def run(source: LiveSource) -> tuple[Reading, list[Path]]:
        with open_sink(out) as sink:
            return read(source, sink), sink.paths

    if transport == "udp":
        with reader(f"udp://{LOOPBACK}:0") as source:
            local = source.receivers.local(0)
            assert local is not None
            sender = player(to=[f"udp://{local}"])
            with playing(sender, over):
                return Chain(sender, *run(source))
    scheme, _, cut = transport.partition(",")
    data = f"&data={free_udp_port()}" if scheme == "tcp+udp" else ""
    query = f"?idcode={reel.tracks[0].config.idcode}{data}"
    sender = player(listen=[f"{scheme}://{LOOPBACK}:0{query}"])
    address = sender.senders.local(0)
    assert address is not None
    between: AbstractContextManager[int] = (
        relay(address.port, random.Random(seed)) if cut else contextlib.nullcontext(address.port)
    )
    with between as port, playing(sender, over), reader(f"{scheme}://{LOOPBACK}:{port}{query}") as source:
        return Chain(sender, *run(source))


def has(source: LiveSource, frames: int) -> bool:
    return source.tally.frames.get(FrameType.DATA, 0) >= frames


@contextmanager
def relay(port: int, rng: random.Random) -> Iterator[int]:
    """A TCP relay to ``port`` that cuts what the server sends anew at random; gives its own port."""
    with socket.create_server((LOOPBACK, 0)) as server:
        over = threading.Event()
        thread = threading.Thread(target=_relay, args=(server, port, rng, over.is_set), daemon=True)
        thread.start()
        try:
            yield int(server.getsockname()[1])
        finally:
            over.set()
            thread.join(PATIENCE_S)


def _relay(server: socket.socket, port: int, rng: random.Random, over: Callable[[], bool]) -> None:
    server.settimeout(PATIENCE_S)
    client, _ = server.accept()
    upstream = socket.create_connection((LOOPBACK, port), timeout=PATIENCE_S)
    for end in (client, upstream):
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    waiting = b""
    with client, upstream, contextlib.suppress(OSError):
        while not over():
            ready, _, _ = select.select([client, upstream], [], [], 0.002)
            if client in ready:
                if not (command := client.recv(1 << 16)):
                    return
                upstream.sendall(command)
            if upstream in ready:
                more = upstream.recv(1 << 16)
                waiting += more
                if not more:
                    client.sendall(waiting)
                    return
            piece = _piece(rng)
            while len(waiting) >= piece or (waiting and not ready):  # what is too little waits for the next round
                client.sendall(waiting[:piece])
                waiting = waiting[piece:]
                piece = _piece(rng)


def _piece(rng: random.Random) -> int:
    """Bytes of the next segment: a few, about a frame, or many."""
    return rng.choice((rng.randint(1, 16), rng.randint(17, 500), rng.randint(501, 4000)))


# --- values


def batches_of(path: Path, configs: Iterable[StreamConfig] = ()) -> list[Batch]:
    """A recording of one stream, decoded; it must have no defects."""
    source = open_source(path, configs=configs)
    batches = [block.batch for block in blocks_of(source)]
    assert source.defects() == {}
    return batches


def column(batches: Sequence[Batch], name: str) -> npt.NDArray[np.generic]:
    return np.concatenate([getattr(batch, name) for batch in batches])


def assert_same_values(played: Sequence[Batch], logged: Sequence[Batch]) -> None:
    """Equal SI values, flags and count; stamps moved by one number of whole seconds, so with FRACSEC bit for bit."""
    assert sum(map(len, logged)) == sum(map(len, played))
    moved = column(logged, "time_ns") - column(played, "time_ns")  # type: ignore[operator]
    assert len(set(moved.tolist())) == 1
    assert int(moved[0]) % NS == 0, "ticks are longer than 59 ns: whole seconds mean the same FRACSEC"
    for name in ("stat", "time_quality", "digitals", "valid"):
        np.testing.assert_array_equal(column(logged, name), column(played, name), err_msg=name)
    for name in ("phasors", "frequency", "rocof", "analogs"):
        np.testing.assert_allclose(column(logged, name), column(played, name), rtol=1e-14, atol=0, err_msg=name)  # type: ignore[arg-type]
