"""The pair between front and control: what finds no room waits or is counted, and what is taken is bounded."""

from __future__ import annotations

import sys
from contextlib import suppress

import pytest

from dcon.control.linked import ITEMS_A_TICK, PairFrames, pair
from dcon.front.front import KEPT, Outlet
from dcon.link.counts import FrontCounts
from dcon.link.crossing import Item, PmuFrameIn, decode, encode
from pmutools.c37118 import Frame
from pmutools.clock import SystemClock
from pmutools.flow import StampSource
from pmutools.net.dialogue import LinkEvent, LinkKind

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="sequenced packets are Linux's")
CLOCK = SystemClock()
SMALL_BYTES = 1 << 17


def test_what_a_tick_takes_from_the_pair_is_bounded_and_the_rest_comes_with_the_next() -> None:
    ours, theirs = pair()
    frames = PairFrames(ours, CLOCK)
    with ours, theirs:
        theirs.setblocking(False)
        items = [PmuFrameIn(0, Frame(number.to_bytes(4, "big"), 1, StampSource.KERNEL, 0)) for number in range(30_000)]
        largest = 0
        for message, inside in encode(items):
            theirs.send(message)
            largest = max(largest, len(inside))
        taken = list[Item]()
        while found := frames.take():
            assert len(found) < ITEMS_A_TICK + largest
            taken += found
    assert taken == items


def config(pmu: int, mark: int, nbytes: int = 60_000) -> PmuFrameIn:
    return PmuFrameIn(pmu, Frame(bytes([mark]) * nbytes, 1, StampSource.KERNEL, 0), is_config=True)


def test_data_never_overtake_a_configuration_that_found_no_room() -> None:
    """There is room for small messages, and for no large one."""
    ours, theirs = pair(SMALL_BYTES)
    with ours, theirs:
        ours.setblocking(False)
        outlet = Outlet(theirs, FrontCounts())
        big, data = Frame(bytes(60_000), 1, StampSource.KERNEL, 0), Frame(b"d", 1, StampSource.KERNEL, 0)
        sent = 0
        while outlet._counts.crowded == 0:
            outlet.add(PmuFrameIn(0, big))
            outlet.flush()
            sent += 1
            assert sent < 1000
        for item in (config(1, 7), PmuFrameIn(1, data), config(1, 8), PmuFrameIn(1, data), PmuFrameIn(0, big)):
            outlet.add(item)
        outlet.flush()
        outlet.add(PmuFrameIn(1, data))
        outlet.flush()
        found: list[Item] = []
        for _ in range(sent + 5):
            try:
                found += decode(ours.recv(1 << 18))
            except BlockingIOError:
                outlet.flush()
        frames = [item for item in found if isinstance(item, PmuFrameIn) and item.pmu == 1]
        assert frames == [config(1, 8)], "the newest, and none of the data before it"
        assert outlet._counts.crowded == 1 + 4


def test_news_without_end_push_no_configuration_out() -> None:
    ours, theirs = pair(SMALL_BYTES)
    with ours, theirs:
        ours.setblocking(False)
        outlet = Outlet(theirs, FrontCounts())
        while not outlet._counts.crowded:
            outlet.add(PmuFrameIn(0, Frame(bytes(60_000), 1, StampSource.KERNEL, 0)))
            outlet.flush()
        for pmu in range(3):
            outlet.add(config(pmu, pmu))
        for number in range(3 * KEPT):
            outlet.add(LinkEvent(LinkKind.FOREIGN, f"{number}" + 1000 * "x", ()))
            outlet.flush()
        found: list[Item] = []
        for _ in range(100):
            with suppress(BlockingIOError):
                found += decode(ours.recv(1 << 18))
            outlet.flush()
        assert [item for item in found if isinstance(item, PmuFrameIn) and item.is_config] == [
            config(pmu, pmu) for pmu in range(3)
        ]
        assert sum(isinstance(item, LinkEvent) for item in found) <= KEPT + 200


def test_news_that_wait_are_bounded() -> None:
    ours, theirs = pair(SMALL_BYTES)
    with ours, theirs:
        outlet = Outlet(theirs, FrontCounts())
        for number in range(5 * KEPT):
            outlet.add(LinkEvent(LinkKind.FOREIGN, f"{number}", ()))
            if number % 100 == 0 or number < KEPT:
                outlet.flush()
        outlet.flush()
        assert len(outlet._news) == KEPT
        assert outlet.is_open


def test_a_frame_of_a_capture_keeps_its_source() -> None:
    """Stamps of all sources cross the pair."""
    ours, theirs = pair()
    with ours, theirs:
        outlet = Outlet(theirs, FrontCounts())
        frames = [PmuFrameIn(3, Frame(b"x", 5, source, 0)) for source in StampSource]
        for item in frames:
            outlet.add(item)
        outlet.flush()
        assert list(decode(ours.recv(1 << 17))) == frames
