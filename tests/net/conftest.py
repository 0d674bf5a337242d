"""For all tests of live endpoints: the kernel stamps arrivals from the start."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from pmutools.flow import StampSource
from pmutools.net.udp import UdpSocket, target


@pytest.fixture(scope="package", autouse=True)
def stamping() -> Iterator[None]:
    """The first socket that asks switches stamping on for the whole kernel, a little later; this one asked before."""
    with UdpSocket("127.0.0.1", 0) as sock:
        end = time.monotonic() + 2
        while sock.stamps and time.monotonic() < end:
            sock.send([b"x"], [target(sock.address)])
            if any(chunk.stamp_source is StampSource.KERNEL for chunk in sock.read()):
                break
            time.sleep(0.001)
        yield
