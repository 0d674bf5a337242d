"""Whether this machine's clock has its GPS lock, by whose word, and since when not. Functions of answers and time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from pmutools.measure.clockquality import ClockQuality
from pmutools.measure.clocks import GpsClock
from pmutools.timebase import NS

FRESH_NS = 5 * NS
"""A lock that nobody has confirmed for so long is one no more. Sources are asked each second and may take 3 s."""


class Verdict(NamedTuple):
    """What one source makes of the clock."""

    locked: bool
    source: str
    detail: str


def judge(source: str, quality: ClockQuality, silent: Mapping[str, str], limit_ns: int) -> Verdict | None:
    """The word of ``source`` (of ``[platform] time_source``); None where nobody gives one.

    ``silent`` says why a source has no answer, by field of ``quality``.
    """
    if source == "auto":
        bound_ns = quality.bound_ns
        return None if bound_ns is None else _by_bound(quality.source, bound_ns, limit_ns)
    part = "gps" if source == "gpsd" else source
    if source == "none":
        return None
    if getattr(quality, part) is None:
        return Verdict(False, source, silent.get(part, "not asked yet"))
    if source == "kernel" and (kernel := quality.kernel) is not None:
        if not kernel.synchronised:
            return Verdict(False, source, "the kernel calls its clock not synchronised")
        if kernel.bound_ns is None:
            return Verdict(True, source, "synchronised, by a program that does not say how well")
        return _by_bound(source, kernel.bound_ns, limit_ns)
    if source == "gpsd" and (gps := quality.gps) is not None:
        return _by_receiver(gps, limit_ns)
    if source == "ptp" and (ptp := quality.ptp) is not None and ptp.bound_ns is None:
        return Verdict(False, source, ptp.why_not)
    bound_ns = getattr(quality, part).bound_ns
    if bound_ns is None:
        return Verdict(False, source, f"{source} calls the clock not synchronised, or follows only itself")
    return _by_bound(source, bound_ns, limit_ns)


def _by_bound(source: str, bound_ns: int, limit_ns: int) -> Verdict:
    return Verdict(bound_ns <= limit_ns, source, f"within {bound_ns / 1e6:.3g} ms of UTC")


def _by_receiver(gps: GpsClock, limit_ns: int) -> Verdict:
    """gpsd knows the receiver. How far the clock is from it: by the pulse, else by when its messages come, to 1 s."""
    if not gps.fix:
        return Verdict(False, "gpsd", "the receiver has no fix")
    if gps.bound_ns is not None:
        return _by_bound("gpsd", gps.bound_ns, limit_ns)
    if gps.serial_offset_ns is None:
        return Verdict(False, "gpsd", "a fix, but nothing to compare the clock with: no pulse, no TOFF")
    apart_s = gps.serial_offset_ns / NS
    return Verdict(abs(apart_s) < 1, "gpsd", f"a fix, no pulse; its messages and the clock are {apart_s:+.1f} s apart")


class Lock:
    """How long ago the clock last had its lock."""

    def __init__(self) -> None:
        self._verdict: Verdict | None = None
        self._heard_ns = 0
        self._locked_ns: int | None = None

    def hear(self, verdict: Verdict | None, now_ns: int) -> None:
        """Take what a source says, at a reading of CLOCK_MONOTONIC. That nobody speaks is news once somebody has."""
        if verdict is None:
            if self._verdict is None:
                return
            verdict = Verdict(False, "none", "nobody promises anything any more")
        self._verdict, self._heard_ns = verdict, now_ns
        if verdict.locked:
            self._locked_ns = now_ns

    def age_s(self, now_ns: int) -> float | None:
        """0 while locked. None as long as nobody has said anything; of a clock that never was locked since the boot."""
        if self._verdict is None:
            return None
        if self._verdict.locked and now_ns - self._heard_ns <= FRESH_NS:
            return 0.0
        return max(now_ns - (self._locked_ns or 0), 1) / NS

    def said(self, now_ns: int) -> Verdict | None:
        """The verdict in force: a lock that was not confirmed for too long is none."""
        verdict = self._verdict
        if verdict is not None and verdict.locked and now_ns - self._heard_ns > FRESH_NS:
            return Verdict(False, verdict.source, f"no answer for {(now_ns - self._heard_ns) / NS:.0f} s")
        return verdict
