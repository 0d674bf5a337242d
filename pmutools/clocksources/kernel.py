"""The kernel's own account of UTC: ``adjtimex``."""

from __future__ import annotations

from pmutools import linux
from pmutools.clocksources.asking import NoAnswer
from pmutools.measure.clocks import KernelClock, TimeStatus


def ask_kernel() -> KernelClock:
    """A system call of a microsecond, without privilege. Raises NoAnswer where there is none."""
    status = linux.clock_status()
    if status is None:
        raise NoAnswer("this system has no adjtimex")
    return kernel_clock(status)


def kernel_clock(status: linux.ClockStatus) -> KernelClock:
    """What the kernel said, in its own units; a clock in the state TIME_ERROR is not synchronised."""
    return KernelClock(
        offset_ns=status.offset_ns,
        frequency_ppm=status.frequency_ppm,
        maxerror_us=status.max_error_ns // 1000,
        esterror_us=status.estimated_error_ns // 1000,
        status=status.status | (0 if status.synchronised else TimeStatus.UNSYNCHRONISED.value),
        tai_offset_s=status.tai_s,
    )
