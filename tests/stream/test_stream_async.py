"""``async for``: the loop never waits for a socket, what it does not take is counted, and cancelling closes."""

from __future__ import annotations

import asyncio
import random
import socket
import threading
import time
from collections.abc import Callable, Coroutine, Generator, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.live import data_frame, free_udp_port
from support.playing import START_NS, number, recording, stream
from support.recordings import write
from support.serving import Device

from pmutools.c37118 import encode_config
from pmutools.errors import SourceError, StreamTimeout
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.stream import Stream, open_stream
from pmutools.stream.handover import Handover

ROOT = Path(__file__).parents[2]
EIGHT = ROOT / "captures" / "cjb-8pmu.pcap"
PATIENCE_S = 10


def running(make: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Run a coroutine function in a loop of its own, for some seconds at most."""

    async def main() -> None:
        async with asyncio.timeout(PATIENCE_S):
            await make()

    asyncio.run(main())


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    yield
    deadline = time.monotonic() + 5
    while any(thread.name == "pmutools-stream" for thread in threading.enumerate()):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def can_be_bound(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        try:
            sock.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


# --- reading


def test_a_recording_gives_the_same_with_and_without_a_loop() -> None:
    with open_stream(EIGHT, duration_s=3) as opened:
        expected = [(frame.idcode, frame.time_ns) for frame in opened]
    with open_stream(EIGHT, duration_s=3) as opened:
        pieces = [(batch.idcode, batch.time_ns.tolist()) for batch in opened.batches(seconds=1)]

    async def main() -> None:
        async with open_stream(EIGHT, duration_s=3) as opened:
            assert [(frame.idcode, frame.time_ns) async for frame in opened] == expected
            assert opened.configs.keys() == {101, 102, 103, 104, 201, 202, 203, 204}
        async with open_stream(EIGHT, duration_s=3) as opened:
            assert [(batch.idcode, batch.time_ns.tolist()) async for batch in opened.batches(seconds=1)] == pieces

    running(main)


def test_a_slow_reader_of_a_recording_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pmutools.stream.WAITING_FRAMES", 10)
    write(tmp_path / "x.c37118", recording(stream(), 300))
    seen: list[int] = []

    async def main() -> None:
        async with open_stream(tmp_path / "x.c37118") as opened:
            async for frame in opened:
                await asyncio.sleep(0)
                seen.append(number(frame.wire))
            assert opened.overflow == 0

    running(main)
    assert seen == list(range(300))


def test_live_frames_and_batches() -> None:
    port = free_udp_port()
    kinds: list[LinkKind] = []
    in_loop: list[bool] = []

    def tell(event: LinkEvent) -> None:
        kinds.append(event.kind)
        in_loop.append(threading.current_thread() is threading.main_thread())

    async def main() -> None:
        url = f"udp://127.0.0.1:{port}"
        async with open_stream(url, timeout_s=5, on_event=tell) as opened:
            found = []
            async for frame in opened:
                found.append(frame.idcode)
                if len(found) == 20:
                    break
            async for frame in opened:  # goes on
                found.append(frame.idcode)
                if set(found) == {7, 8} and LinkKind.STREAMING in kinds:
                    break
        async with open_stream(url, timeout_s=5) as opened:
            seen: dict[int, int] = {}
            async for batch in opened.batches(seconds=0.1):
                seen[batch.idcode] = seen.get(batch.idcode, 0) + len(batch)
                if len(seen) == 2 and min(seen.values()) > 10:
                    break

    with Device([stream(7), stream(8)], to=f"udp://127.0.0.1:{port}"):
        running(main)
    assert {LinkKind.BOUND, LinkKind.CONFIGURED, LinkKind.STREAMING} <= set(kinds)
    assert all(in_loop)


def test_the_loop_goes_on_while_a_stream_is_waited_for() -> None:
    turns = 0

    async def count() -> None:
        nonlocal turns
        while True:
            turns += 1
            await asyncio.sleep(0)

    async def main() -> None:
        counting = asyncio.create_task(count())
        async with open_stream(f"udp://127.0.0.1:{free_udp_port()}", duration_s=0.3) as opened:
            assert [frame async for frame in opened] == []
        counting.cancel()

    running(main)
    assert turns > 100


def test_several_streams_at_once() -> None:
    ports = sorted({free_udp_port() for _ in range(3)})

    async def first(port: int) -> int:
        async with open_stream(f"udp://127.0.0.1:{port}", timeout_s=5) as opened:
            return (await anext(aiter(opened))).idcode

    async def main() -> None:
        assert await asyncio.gather(*map(first, ports)) == [7] * len(ports)

    devices = [Device([stream(7)], to=f"udp://127.0.0.1:{port}") for port in ports]
    for device in devices:
        device.__enter__()
    try:
        running(main)
    finally:
        for device in devices:
            device.close()


# --- ending


def test_cancelling_closes_the_sockets() -> None:
    port = free_udp_port()
    opened: list[Stream] = []

    async def read() -> None:
        async with open_stream(f"udp://127.0.0.1:{port}") as one:
            opened.append(one)
            async for _ in one:
                pass

    async def main() -> None:
        task = asyncio.create_task(read())
        await asyncio.sleep(0.05)
        assert not can_be_bound(port)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert can_be_bound(port)

    running(main)


def test_breaking_out_and_leaving_closes_the_sockets() -> None:
    port = free_udp_port()

    async def main() -> None:
        async with open_stream(f"udp://127.0.0.1:{port}", timeout_s=5) as opened:
            async for _ in opened:
                break
            assert not can_be_bound(port)
        assert can_be_bound(port)
        await opened.aclose()
        assert [frame async for frame in opened] == []

    with Device([stream(7)], to=f"udp://127.0.0.1:{port}"):
        running(main)


def test_a_stream_that_was_never_read_is_closed_too() -> None:
    port = free_udp_port()

    async def main() -> None:
        async with open_stream(f"udp://127.0.0.1:{port}"):
            assert not can_be_bound(port)
        assert can_be_bound(port)
        async with open_stream(f"udp://127.0.0.1:{port}") as opened:
            aiter(opened)
        assert can_be_bound(port)

    running(main)


def test_a_plain_with_in_a_loop_closes_soon_after() -> None:
    port = free_udp_port()

    async def main() -> None:
        with open_stream(f"udp://127.0.0.1:{port}", timeout_s=5) as opened:
            async for _ in opened:
                break
        while not can_be_bound(port):
            await asyncio.sleep(0.01)

    with Device([stream(7)], to=f"udp://127.0.0.1:{port}"):
        running(main)


def test_errors_come_out_of_the_loop() -> None:
    async def main() -> None:
        url = f"udp://127.0.0.1:{free_udp_port()}"
        async with open_stream(url, timeout_s=0.2) as opened:
            with pytest.raises(StreamTimeout, match="nothing came"):
                async for _ in opened:
                    pass
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
            taken.bind(("127.0.0.1", 0))
            with pytest.raises(SourceError, match="already in use"):
                open_stream(f"udp://127.0.0.1:{taken.getsockname()[1]}")

    running(main)


def test_stopped_from_elsewhere_it_ends() -> None:
    async def main() -> None:
        async with open_stream(f"udp://127.0.0.1:{free_udp_port()}") as opened:
            asyncio.get_running_loop().call_later(0.05, opened.stop)
            assert [frame async for frame in opened] == []

    running(main)


# --- a reader that is too slow


def test_frames_that_are_not_taken_are_dropped_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """The oldest go; what is kept is the latest."""
    monkeypatch.setattr("pmutools.stream.WAITING_FRAMES", 10)
    port = free_udp_port()

    async def main() -> None:
        async with open_stream(f"udp://127.0.0.1:{port}", timeout_s=5) as opened:
            frames = aiter(opened)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                sender.connect(("127.0.0.1", port))
                sender.send(encode_config(stream()))
                sender.send(data_frame(stream(), START_NS, value=1000))
                assert number((await anext(frames)).wire) == 1000
                for k in range(100):
                    sender.send(data_frame(stream(), START_NS, value=k))
            while opened.overflow < 90:
                await asyncio.sleep(0.01)
            assert [number((await anext(frames)).wire) for _ in range(10)] == list(range(90, 100))
            assert opened.overflow == 90

    running(main)


def portions(parts: list[list[int]], closed: list[bool]) -> Generator[list[int], None, None]:
    try:
        yield from parts
    finally:
        closed.append(True)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.lists(st.integers(1, 5), max_size=5), max_size=8), st.integers(1, 12), st.booleans(), st.integers())
def test_what_is_handed_over_is_in_order_and_accounted_for(
    parts: list[list[int]], limit: int, lossy: bool, seed: int
) -> None:
    """Items weigh what they are; nothing is lost unless it may be."""
    made = [item for part in parts for item in part]
    closed: list[bool] = []
    chance = random.Random(seed)

    async def main() -> None:
        handover = Handover(portions(parts, closed), limit=limit, lossy=lossy, weigh=lambda item: item)
        taken: list[int] = []
        while True:
            if chance.random() < 0.3:
                await asyncio.sleep(0)
            try:
                taken.append(await handover.take())
            except StopAsyncIteration:
                break
        assert sum(taken) + handover.dropped == sum(made)
        if lossy:
            rest = iter(made)
            assert all(item in rest for item in taken), "in order"
        else:
            assert taken == made
        await handover.close()

    running(main)
    assert closed == [True]


def test_a_failing_thread_hands_its_error_over_after_what_it_made() -> None:
    def failing() -> Generator[list[int], None, None]:
        yield [1, 2]
        raise ZeroDivisionError

    async def main() -> None:
        handover = Handover(failing(), limit=10, lossy=True)
        assert [await handover.take(), await handover.take()] == [1, 2]
        with pytest.raises(ZeroDivisionError):
            await handover.take()
        await handover.close()

    running(main)


def test_a_loop_that_has_gone_without_closing_leaves_no_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pmutools.stream.handover.LOOK_S", 0.01)
    closed: list[bool] = []

    async def main() -> None:
        Handover(portions([[k] for k in range(1000)], closed), limit=2, lossy=False)

    running(main)
    deadline = time.monotonic() + 5
    while not closed and time.monotonic() < deadline:
        time.sleep(0.01)
    assert closed == [True]


def test_closing_does_not_wait_for_what_nobody_takes() -> None:
    closed: list[bool] = []

    async def main() -> None:
        handover = Handover(portions([[k] for k in range(1000)], closed), limit=2, lossy=False)
        assert await handover.take() == 0
        await handover.close()

    running(main)
    assert closed == [True]
