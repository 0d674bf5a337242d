"""Exact, repeatable faults for PMU streams, and the record of what was done.

A :class:`Profile` says who suffers what; a :class:`Pipeline` is one stream's way through it: frames in, with the time
each is due, :class:`Outgoing` copies out, with the time each leaves and what was done to it. Pure: no clock, no I/O.
"""

from pmutools.impair.gate import Switch
from pmutools.impair.outgoing import UNREPEATABLE, Fate, LedgerRow, Outgoing
from pmutools.impair.pipeline import Pipeline
from pmutools.impair.profile import (
    Action,
    Profile,
    parse_action,
    parse_profile,
    profile_of_options,
    read_profile_file,
)
from pmutools.impair.profiles import READY, load_profile, ready_profile
from pmutools.impair.stages import OPTIONS
from pmutools.parsers import Place

__all__ = [
    "OPTIONS",
    "READY",
    "UNREPEATABLE",
    "Action",
    "Fate",
    "LedgerRow",
    "Outgoing",
    "Pipeline",
    "Place",
    "Profile",
    "Switch",
    "load_profile",
    "parse_action",
    "parse_profile",
    "profile_of_options",
    "read_profile_file",
    "ready_profile",
]
