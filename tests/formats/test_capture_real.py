"""The real recordings: packets and payload against tshark, frames against what the recordings are known to hold."""

from __future__ import annotations

import subprocess
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
from support.captures import REAL_CAPTURES, Contents, capture_path

from pmutools.c37118.demux import Demux, Message
from pmutools.formats.capture import CaptureReader, Fate


@pytest.mark.parametrize(("name", "contents"), REAL_CAPTURES.items())
def test_the_frames_are_those_of_the_list(name: str, contents: Contents) -> None:
    demux = Demux()
    types: Counter[int] = Counter()
    for chunk in CaptureReader(capture_path(name)):
        for message in demux.feed(chunk):
            assert isinstance(message, Message)
            types[message.frame.data[1] >> 4] += 1
    assert demux.close() == []
    assert types == {0: contents.data, 3: contents.config, 4: contents.command}


@pytest.mark.peer
@pytest.mark.parametrize("name", REAL_CAPTURES)
def test_packets_and_payload_are_tsharks(name: str, requires: Callable[[str], Path]) -> None:
    path = capture_path(name)
    fields = ["frame.time_epoch", "frame.cap_len", "tcp.len", "udp.length", "tcp.analysis.retransmission"]
    command = [str(requires("tshark")), "-n", "-r", str(path), "-Tfields", *(f"-e{field}" for field in fields)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    rows = [line.split("\t") for line in done.stdout.splitlines()]
    reader = CaptureReader(path)
    chunks = list(reader)
    tally = reader.tally
    assert tally.is_clean
    assert tally.total_packets == len(rows)
    assert sum(tally.nbytes.values()) == sum(int(row[1]) for row in rows)
    assert tally.packets[Fate.UDP] == sum(row[3] != "" for row in rows)
    assert tally.packets[Fate.TCP] == sum(row[2] not in ("", "0") and not row[4] for row in rows)
    sizes = [int(row[2] or int(row[3]) - 8) for row in rows]
    assert [(chunk.arrival_ns, len(chunk.data)) for chunk in chunks] == [
        (_ns(row[0]), size) for row, size in zip(rows, sizes, strict=True) if size
    ]


def _ns(epoch: str) -> int:
    seconds, _, fraction = epoch.partition(".")
    return int(seconds) * 10**9 + int(fraction.ljust(9, "0"))
