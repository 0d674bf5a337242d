"""Datagrams taken together are what they are one by one."""

from __future__ import annotations

import random
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from support.frames import random_stream

from pmutools.c37118.batch import Batch
from pmutools.c37118.demux import DataRun, Demux, Loss, Message
from pmutools.flow import Chunk, Flow, Train
from pmutools.formats import open_source
from pmutools.formats.capture import CaptureReader, CaptureWriter
from pmutools.formats.capture.plain import TRAIN
from pmutools.formats.source import Block, gather

T0 = 1_700_000_000 * 10**9
HUB = "192.0.2.1:54712"


def flow_of(number: int) -> Flow:
    return Flow("udp", f"198.51.100.{number + 1}:4713", HUB)


def clean(rng: random.Random, number: int) -> list[bytes]:
    stream = random_stream(rng, frames=400, idcode=number + 1)
    return [stream.config(), *stream.data]


def with_changes(rng: random.Random, number: int) -> list[bytes]:
    """Another configuration half way, large enough to travel in fragments."""
    first, second = (random_stream(rng, stations=4, frames=200, idcode=number + 1) for _ in range(2))
    return [first.config("cfg3"), *first.data, second.config("cfg3") * 3, *second.data]


def damaged(rng: random.Random, number: int) -> list[bytes]:
    frames = [bytearray(frame) for frame in clean(rng, number)]
    frames[200][rng.randrange(len(frames[200]))] ^= 1 << rng.randrange(8)
    return [bytes(frame) for frame in frames]


def unconfigured(rng: random.Random, number: int) -> list[bytes]:
    return clean(rng, number)[1:]


def foreign(rng: random.Random, number: int) -> list[bytes]:
    return [rng.randbytes(60) for _ in range(300)]


def few(rng: random.Random, number: int) -> list[bytes]:
    return clean(rng, number)[: TRAIN - 1]


@pytest.fixture(params=range(4))
def capture(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Six flows, their datagrams mixed at random, each flow's in order; read a few hundred packets at a time."""
    monkeypatch.setattr("pmutools.formats.capture.pcap.RUN", 500)
    rng = random.Random(request.param)
    kinds = (clean, with_changes, damaged, unconfigured, foreign, few)
    flows = {flow_of(number): kind(rng, number) for number, kind in enumerate(kinds)}
    turns = [flow for flow, datagrams in flows.items() for _ in datagrams]
    rng.shuffle(turns)
    waiting = {flow: iter(datagrams) for flow, datagrams in flows.items()}
    path = tmp_path / "mixed.pcap"
    with CaptureWriter(path) as writer:
        for number, flow in enumerate(turns):
            writer.write(Chunk(next(waiting[flow]), T0 + number * 10**6, flow))
    return path


def by_flow(chunks: Iterable[Chunk]) -> dict[Flow, list[Chunk]]:
    flows: dict[Flow, list[Chunk]] = defaultdict(list)
    for chunk in chunks:
        flows[chunk.flow].append(chunk)
    return flows


def test_trains_are_the_chunks_of_their_flow(capture: Path) -> None:
    plain, reader = CaptureReader(capture), CaptureReader(capture)
    expected = by_flow(plain)
    pieces = list(reader.trains())
    assert any(isinstance(piece, Train) for piece in pieces)
    parts = [piece.chunks() if isinstance(piece, Train) else [piece] for piece in pieces]
    assert by_flow(chunk for part in parts for chunk in part) == expected
    assert reader.tally == plain.tally


def columns(blocks: Iterable[object]) -> dict[tuple[Flow, int], list[np.ndarray]]:
    """Wire, arrivals and stamp sources of each stream, whatever its blocks."""
    batches: dict[tuple[Flow, int], list[Batch]] = defaultdict(list)
    for block in blocks:
        if isinstance(block, Block):
            batches[block.flow, block.batch.config.idcode].append(block.batch)
    return {
        stream: [
            np.concatenate([np.frombuffer(batch.wire.tobytes(), np.uint8) for batch in found]),  # type: ignore[union-attr]
            np.concatenate([batch.arrival_ns for batch in found]),
            np.concatenate([batch.stamp_source for batch in found]),
            np.concatenate([batch.time_ns for batch in found]),
        ]
        for stream, found in batches.items()
    }


def test_blocks_are_the_items_gathered(capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = []
    feed_train = Demux.feed_train

    def watched(demux: Demux, train: Train) -> list[Message | Loss | DataRun]:
        out = feed_train(demux, train)
        kept.append(isinstance(out[0], DataRun) if out else False)
        return out

    monkeypatch.setattr(Demux, "feed_train", watched)
    together, apart = open_source(capture), open_source(capture)
    blocks, items = list(together.blocks()), list(apart.items())
    assert any(kept)
    assert not all(kept)
    found, expected = columns(blocks), columns(gather(items))
    assert found.keys() == expected.keys()
    for stream, arrays in expected.items():
        for one, other in zip(found[stream], arrays, strict=True):
            np.testing.assert_array_equal(one, other)
    others = [item for item in blocks if not isinstance(item, Block)]
    assert sorted(map(repr, others)) == sorted(repr(item) for item in gather(items) if not isinstance(item, Block))
    assert together.tally == apart.tally
