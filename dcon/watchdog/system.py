"""Making the process fit for its rhythm, as far as the system lets it, by few lines of its own."""

from __future__ import annotations

import ctypes
import gc
import os
import sys

FIFO_PRIORITY = 20
"""Ahead of the controller, which it watches; behind the kernel's own threads."""


def go_realtime(*, fifo: bool) -> list[str]:
    """Collector frozen, memory locked, SCHED_FIFO with ``fifo``. Gives what could not be had, a line each."""
    gc.collect()
    gc.freeze()
    gc.disable()
    shortfalls = []
    if not sys.platform.startswith("linux"):
        return ["memory is not locked, the scheduling policy is the usual: only Linux has them"]
    libc = ctypes.CDLL(None, use_errno=True)
    pr_set_timerslack, mcl_current, mcl_onfault = 29, 1, 4
    libc.prctl(pr_set_timerslack, ctypes.c_ulong(1), 0, 0, 0)
    if libc.mlockall(mcl_current | mcl_onfault):
        shortfalls.append(f"memory is not locked: {os.strerror(ctypes.get_errno())}; raise RLIMIT_MEMLOCK for it")
    if fifo:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
        except OSError as error:
            shortfalls.append(f"SCHED_FIFO: {error.strerror}; run as root or with CAP_SYS_NICE for it")
    return shortfalls
