"""Logging that keeps nobody waiting."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Iterator
from typing import IO

import pytest

from pmutools.log_thread import ROOM, log_in_thread

LOG = logging.getLogger("tests.aside")
DEADLINE_S = 10.0


@pytest.fixture
def stuck() -> Iterator[tuple[int, IO[str]]]:
    """A pipe that nobody reads, and a logger that writes to it alone."""
    reader, writer = os.pipe()
    root = logging.getLogger()
    before, level = root.handlers[:], root.level
    with os.fdopen(writer, "w", buffering=1) as stream:
        root.handlers[:] = [logging.StreamHandler(stream)]
        root.setLevel(logging.INFO)
        try:
            yield reader, stream
        finally:
            root.handlers[:] = before
            root.setLevel(level)
            os.close(reader)


def test_a_pipe_that_nobody_reads_keeps_nobody_waiting(stuck: tuple[int, IO[str]]) -> None:
    reader, _ = stuck
    text = "x" * 4000  # 64 KiB of pipe are full after 16 lines
    found: list[bytes] = []

    def read_until(last: str) -> None:
        while last.encode() not in b"".join(found[-3:]):
            found.append(os.read(reader, 1 << 16))

    with log_in_thread():
        began = time.monotonic()
        for number in range(ROOM + 100):
            LOG.info("%d %s", number, text)
        assert time.monotonic() - began < DEADLINE_S  # without the thread it would never end
        reading = threading.Thread(target=read_until, args=("after all",), daemon=True)
        reading.start()
        until = time.monotonic() + DEADLINE_S
        while b"found no room" not in b"".join(found) and time.monotonic() < until:
            LOG.info("after all")
            time.sleep(0.01)  # there must be room again
        reading.join(DEADLINE_S)
    told = b"".join(found).decode()
    assert told.startswith(f"0 {text}\n1 {text}\n")
    assert "after all (" in told and "lines before it found no room" in told


def test_in_order_and_at_once_where_it_is_read(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    with log_in_thread():
        for number in range(100):
            LOG.info("%d", number)
    assert [record.getMessage() for record in caplog.records] == [str(number) for number in range(100)]


def test_levels_of_handlers_hold(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    caplog.handler.setLevel(logging.ERROR)
    with log_in_thread():
        LOG.warning("quiet")
        LOG.error("loud")
    assert [record.getMessage() for record in caplog.records] == ["loud"]
