"""System calls through ctypes: what they return, and that the tools live without them."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from pmutools import linux
from pmutools.linux_columns import SendColumns
from pmutools.net.sockets import Address, pack_sockaddr, unpack_sockaddr

native = pytest.mark.skipif(not linux.NATIVE, reason="needs 64-bit Linux")


def run_python(code: str, **environment: str) -> str:
    """Output of ``code`` in a process of its own, so that its scheduling and locks are not ours."""
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=30,
        env={**os.environ, **environment},
        check=False,
    )
    assert not done.returncode, done.stderr
    return done.stdout.strip()


@native
@pytest.mark.realtime
def test_timer_slack_fifo_and_lock_either_work_or_say_why() -> None:
    out = run_python(
        "from pmutools import linux; import os\n"
        "print(linux.timer_slack(1000), linux.fifo(5), linux.lock_memory(), sep='|')\n"
        "print(open('/proc/self/timerslack_ns').read().strip(), os.sched_getscheduler(0) == os.SCHED_FIFO, sep='|')\n"
        "print([line.split()[1] for line in open('/proc/self/status') if line.startswith('VmLck')][0])"
    )
    told, seen, locked = out.splitlines()
    slack, fifo, lock = told.split("|")
    slack_ns, is_fifo = seen.split("|")
    assert slack == "None"
    assert (fifo == "None") == (is_fifo == "True"), out
    assert is_fifo == "True" or slack_ns == "1000"  # a real-time task has no slack
    assert (lock == "None") == (int(locked) > 0), out
    for reason in (fifo, lock):
        assert reason == "None" or "for it" in reason


@native
@pytest.mark.skipif(not hasattr(linux.libc, "malloc_trim"), reason="the C library has no malloc_trim")
def test_what_a_burst_left_free_below_the_heaps_top_is_given_back() -> None:
    out = run_python(
        "from pmutools import linux\n"
        "def mib(): return int(open('/proc/self/statm').read().split()[1]) * 4 / 1024\n"
        "burst = [bytearray(8192) for _ in range(8000)]\n"
        "kept = burst[-1]; burst.clear(); before = mib()\n"
        "linux.trim_heap(); print(before, mib())"
    )
    before, after = map(float, out.split())
    assert before - after > 30


@native
@pytest.mark.realtime
def test_memory_that_is_only_reserved_is_not_filled_by_the_lock() -> None:
    out = run_python(
        "import mmap; reserved = mmap.mmap(-1, 1 << 30)\n"
        "from pmutools import linux\n"
        "told = linux.lock_memory()\n"
        "sizes = dict(line.split()[:2] for line in open('/proc/self/status') if line.startswith('Vm'))\n"
        "print(told, sizes['VmRSS:'], sizes['VmLck:'], sep='|')"
    )
    told, resident, locked = out.split("|")
    if told != "None":
        pytest.skip(told)
    assert int(locked) > 1 << 20, "a GB and more, in kB"
    assert int(resident) < 1 << 19


@pytest.mark.skipif(sys.platform != "linux", reason="Linux's schedulers")
@pytest.mark.realtime
@pytest.mark.parametrize("portable", ["0", "1"])
def test_going_real_time_gets_what_it_may_and_says_what_it_did_not(portable: str) -> None:
    out = run_python(
        "from pmutools.realtime import go_realtime; import gc, os, resource\n"
        "os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))\n"  # it may have been inherited
        "resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))\n"
        "for fifo in (False, True):\n"
        "    missing = go_realtime(fifo=fifo, priority=5)\n"
        "    is_fifo = os.sched_getscheduler(0) == os.SCHED_FIFO\n"
        "    print(fifo, is_fifo, missing.fifo is None, gc.get_freeze_count() > 0, sep='|')\n"
        "    assert all(reason is None or ': ' in reason for reason in missing), missing",
        PMUTOOLS_PORTABLE=portable,
    )
    normal, asked = out.splitlines()
    assert normal == "False|False|True|True"
    assert asked in ("True|True|True|True", "True|False|False|True")


def test_portable_by_environment() -> None:
    out = run_python(
        "from pmutools import linux; from pmutools.clock import SystemClock; c = SystemClock()\n"
        "c.sleep_until(c.monotonic_ns() + 1_000_000)\n"
        "print(linux.NATIVE, linux.clock_status(), linux.timer_slack(), linux.lock_memory())",
        PMUTOOLS_PORTABLE="1",
    )
    assert out == "False None timer slack: only Linux has it memory lock: only Linux has it"


@native
def test_clock_status_is_plausible() -> None:
    status = linux.clock_status()
    assert status is not None
    assert 0 <= status.state <= 5
    assert 0 <= status.max_error_ns <= 17 * 10**9
    assert abs(status.frequency_ppm) <= 500
    assert abs(status.tai_s) < 100
    assert status.synchronised == (status.state != 5 and not status.status & 0x40)


@native
@pytest.mark.realtime
def test_absolute_sleep_wakes_for_signals_and_goes_on() -> None:
    """A handler that returns must not end the sleep; one that raises must."""
    out = run_python(
        "import signal, time; from pmutools import linux\n"
        "hits = []\n"
        "signal.signal(signal.SIGALRM, lambda *_: hits.append(1))\n"
        "signal.setitimer(signal.ITIMER_REAL, 0.01, 0.01)\n"
        "start = time.monotonic_ns()\n"
        "linux.sleep_until(start + 100_000_000)\n"
        "print(time.monotonic_ns() - start >= 100_000_000, len(hits) > 2)\n"
        "signal.setitimer(signal.ITIMER_REAL, 0)\n"
        "def stop(*_): raise KeyboardInterrupt\n"
        "try:\n"
        "    signal.signal(signal.SIGALRM, stop)\n"
        "    signal.setitimer(signal.ITIMER_REAL, 0.01)\n"
        "    linux.sleep_until(time.monotonic_ns() + 10_000_000_000)\n"
        "except KeyboardInterrupt: print('stopped', time.monotonic_ns() - start < 5_000_000_000)"
    )
    assert out.splitlines() == ["True True", "stopped True"]


def _pair(family: int, host: str) -> tuple[socket.socket, socket.socket]:
    receiver, sender = (socket.socket(family, socket.SOCK_DGRAM) for _ in range(2))
    receiver.bind((host, 0))
    receiver.setblocking(False)
    sender.bind((host, 0))
    return receiver, sender


@native
@pytest.mark.realtime
@pytest.mark.parametrize(("family", "host"), [(socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "::1")])
def test_batches_keep_order_bytes_senders_and_stamps(family: int, host: str) -> None:
    receiver, sender = _pair(family, host)
    receiver.setsockopt(socket.SOL_SOCKET, linux.SO_TIMESTAMPNS, 1)
    frames = [bytes([k % 256]) * (k % 90) for k in range(150)]
    where = linux.SockAddr(pack_sockaddr(Address(family, receiver.getsockname())))
    before_ns = time.time_ns()
    assert linux.SendBatch(size=64).send(sender.fileno(), frames, [where] * len(frames)) == []
    batch = linux.ReceiveBatch(size=40)
    got = [datagram for _ in range(5) for datagram in batch.receive(receiver.fileno())]
    after_ns = time.time_ns()
    assert [datagram.data for datagram in got] == frames
    assert {unpack_sockaddr(datagram.sockaddr) for datagram in got} == {Address(family, sender.getsockname())}
    stamps = [datagram.stamp.ns for datagram in got if datagram.stamp is not None]
    assert len(stamps) > 100  # the first may come before the kernel has switched stamping on
    assert all(before_ns <= stamp <= after_ns for stamp in stamps)
    assert stamps == sorted(stamps)
    receiver.close()
    sender.close()


@native
@pytest.mark.realtime
def test_one_batch_serves_sockets_of_both_families() -> None:
    """The kernel shortens the room for addresses to what the last one took; it must be given anew."""
    batch = linux.ReceiveBatch()
    for family, host in ((socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "::1")):
        receiver, sender = _pair(family, host)
        sender.sendto(b"x", receiver.getsockname())
        (datagram,) = batch.receive(receiver.fileno())
        assert unpack_sockaddr(datagram.sockaddr) == Address(family, sender.getsockname())
        receiver.close()
        sender.close()


@native
@pytest.mark.realtime
def test_a_failed_datagram_is_named_and_the_rest_go_out() -> None:
    receiver, sender = _pair(socket.AF_INET, "127.0.0.1")
    good = linux.SockAddr(pack_sockaddr(Address(socket.AF_INET, receiver.getsockname())))
    port_0 = linux.SockAddr(pack_sockaddr(Address(socket.AF_INET, ("127.0.0.1", 0))))
    frames = [b"0", b"1", b"x" * 70_000, b"3", b"4"]
    assert linux.SendBatch().send(sender.fileno(), frames, [good, port_0, good, good, port_0]) == [1, 2, 4]
    assert [datagram.data for datagram in linux.ReceiveBatch().receive(receiver.fileno())] == [b"0", b"3"]
    receiver.close()
    sender.close()


def _columns(frames: list[bytes], where: list[linux.SockAddr | None]) -> SendColumns:
    sizes = np.array([len(frame) for frame in frames])
    columns = SendColumns(4)
    columns.load(
        np.frombuffer(b"".join(frames), np.uint8),
        np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64),
        sizes,
        np.array([one.address if one else 0 for one in where], np.uint64),
        np.array([len(one.raw) if one else 0 for one in where], np.uint32),
    )
    return columns


@native
@pytest.mark.realtime
@pytest.mark.parametrize("connected", [False, True])
def test_columns_keep_order_and_bytes_whatever_the_portions(connected: bool) -> None:
    receiver, sender = _pair(socket.AF_INET, "127.0.0.1")
    receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
    address = linux.SockAddr(pack_sockaddr(Address(socket.AF_INET, receiver.getsockname())))
    if connected:
        sender.connect(receiver.getsockname())
    frames = [bytes([k % 256]) * (1 + k % 90) for k in range(3000)]
    columns, batch, got = _columns(frames, [None if connected else address] * len(frames)), linux.ReceiveBatch(), []
    for first, last in ((0, 1), (1, 1), (1, 4), (4, 64), (64, 200), (200, 400)):
        assert columns.send(sender.fileno(), first, last) == []
        for _ in range(4):
            got += [datagram.data for datagram in batch.receive(receiver.fileno())]
    assert got == frames[:400]
    assert columns.send(sender.fileno(), 400, 3000) == []  # three calls; what the receiver has no room for is lost
    while heard := batch.receive(receiver.fileno()):
        got += [datagram.data for datagram in heard]
    assert got == frames[: len(got)]
    with pytest.raises(IndexError):
        columns.send(sender.fileno(), 2999, 3001)
    receiver.close()
    sender.close()


@native
@pytest.mark.realtime
def test_a_failed_datagram_of_columns_is_named_and_the_rest_go_out() -> None:
    receiver, sender = _pair(socket.AF_INET, "127.0.0.1")
    good = linux.SockAddr(pack_sockaddr(Address(socket.AF_INET, receiver.getsockname())))
    port_0 = linux.SockAddr(pack_sockaddr(Address(socket.AF_INET, ("127.0.0.1", 0))))
    columns = _columns([b"0", b"1", b"x" * 70_000, b"3", b"4"], [good, port_0, good, good, port_0])
    assert columns.send(sender.fileno(), 0, 5) == [1, 2, 4]
    assert columns.send(sender.fileno(), 2, 4) == [2]
    assert [datagram.data for datagram in linux.ReceiveBatch().receive(receiver.fileno())] == [b"0", b"3", b"3"]
    receiver.close()
    sender.close()


@pytest.mark.parametrize(
    "address",
    [
        Address(socket.AF_INET, ("192.0.2.7", 4713)),
        Address(socket.AF_INET6, ("2001:db8::7", 4713, 0, 0)),
        Address(socket.AF_INET6, ("fe80::1", 65535, 0, 3)),
    ],
)
def test_kernel_addresses_there_and_back(address: Address) -> None:
    assert unpack_sockaddr(pack_sockaddr(address)) == address
