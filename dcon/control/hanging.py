"""Whether a process that this one has started hangs: it lives, and one of its loops has long not beaten. Pure.

They beat to the watchdog only, whose status tells how long ago. A watchdog that is silent says nothing of them; and
where the whole machine stood still, or this process, nobody has hung: silence counts as long as this process looks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

from dcon.control.heard import HELPERS, Heard, is_silent
from dcon.link.children import HUNG_S
from pmutools.timebase import NS

HUNG_NS: Final = round(HUNG_S * 1e9)
ROUND_NS: Final = NS
"""The longest from one look to the next that counts as a silence."""


class Silences(NamedTuple):
    """How long each loop has said nothing, of those that have beaten since this process began to listen."""

    looked_ns: int
    loops_ns: Mapping[str, int] = MappingProxyType({})


def look(before: Silences, heard: Heard, now_ns: int) -> Silences:
    """What is known at ``now_ns`` (monotonic)."""
    status, passed_ns = heard.status, min(now_ns - before.looked_ns, ROUND_NS)
    if status is None or is_silent(heard, now_ns):
        return before._replace(looked_ns=now_ns)
    ages_ns = {loop: now_ns - status.monotonic_ns + age_ms * 1e6 for loop, age_ms in status.beats_ms}
    loops_ns = {}
    for loop in HELPERS:
        age_ns = ages_ns.get(loop, math.inf)  # a new watchdog has not heard one that hangs
        if loop in before.loops_ns or age_ns < now_ns - heard.started_ns:  # else it is of an earlier life
            loops_ns[str(loop)] = round(min(before.loops_ns.get(loop, 0) + passed_ns, age_ns))
    return Silences(now_ns, loops_ns)


def hung(silences: Silences, limit_ns: int) -> str:
    """Who hangs, in words; "" where nobody does."""
    for loop, process in HELPERS.items():
        if silences.loops_ns.get(loop, 0) > limit_ns:
            return f"the {process} process hangs: its loop {loop} has not beaten for {limit_ns / 1e9:g} s"
    return ""
