"""Stages, models and ready profiles of the fault pipeline."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from generate.markdown import code, fenced, prose, table
from pmutools.impair import config_change, segment
from pmutools.impair.content import KINDS
from pmutools.impair.delays import COURSES, Trace
from pmutools.impair.distributions import DISTRIBUTIONS, LIMITS
from pmutools.impair.losses import LOSSES
from pmutools.impair.profiles import READY
from pmutools.impair.scope import FIELDS
from pmutools.impair.source_faults import LEAP_BITS, STAT_BITS
from pmutools.impair.stages import OPTIONS, SEVERAL
from pmutools.impair.verbs import PLAYER
from pmutools.parsers import is_optional, settable

WORDS = {
    "corrupt": "content faults: bytes that are wrong, or true bytes that say something false",
    "config": "the configuration changes, with or without notice",
    "disable": "the stream falls silent: at frame indices, over stream time, or by order",
    "drop": "named frames never leave",
    "loss": "a loss model decides",
    "duplicate": "further copies, each with its own delay",
    "delay": "a sum of distributions, traces and courses over time",
    "reorder": "a frame that others overtake",
    "rate": "a bit rate with a queue",
    "slot": "everything waiting leaves at once",
    "segment": "how the bytes of a frame meet a TCP connection",
}
"""What each stage is, for the table of stages; a stage without words is an error there."""
UNITS = {
    "shape": "no unit",
    "sample": "ms each",
    "bins": "ms, ms, count",
    "points": "% and ms",
    "components": "% and DIST",
    "values": "ms each",
    "time": "s",
    "start": "s",
    "end": "s",
    "period": "s",
    "phase": "degrees",
    "peak": "h UTC",
}
"""Units of the parameters of delays, where these are not ms."""


def call(name: str, cls: type[Any]) -> str:
    """How a model is written: its parameters, optional ones in brackets."""
    shown = [
        key + (", ..." if item.metadata["rest"] else "") for key, item in settable(cls).items() if not is_optional(item)
    ]
    shown += [f"[{key}]" for key, item in settable(cls).items() if is_optional(item)]
    return f"{name}({', '.join(shown)})"


def models(of: Mapping[str, type[Any]]) -> str:
    """One row a model: how it is written, and its docstring."""
    return table(("written", "meaning"), ((code(call(name, cls)), prose(cls.__doc__)) for name, cls in of.items()))


def delays(of: Mapping[str, type[Any]]) -> str:
    """As :func:`models`, with the units of the parameters."""
    rows = []
    for name, cls in of.items():
        units = ", ".join(f"{code(key)} {UNITS.get(key, 'ms')}" for key in settable(cls))
        rows.append((code(call(name, cls)), units, prose(cls.__doc__)))
    return table(("written", "parameters", "meaning"), rows)


def verbs() -> str:
    """The player's verbs, and whether a timeline takes them."""
    rows = ((code(verb.usage), "no" if verb.unscheduled else "yes", verb.unscheduled) for verb in PLAYER.values())
    return table(("verb", "in a timeline", "why not"), rows)


def stages() -> str:
    """The stages in the order in which a frame goes through them."""
    rows = []
    for number, (option, cls) in enumerate(OPTIONS.items(), 1):
        keys = " ".join(code(f"{key}=") for key in list(settable(cls))[1:])
        rows.append((number, code(option), WORDS[option], keys, "yes" if option in SEVERAL else "no"))
    return table(("", "stage", "what it does", "further keys", "several parts"), rows)


def ready() -> str:
    """The ready profiles as they are."""
    return "\n\n".join(f"**{name}**\n\n{fenced(text, 'ini')}" for name, text in READY.items())


GENERATORS = {
    "stages": stages,
    "loss-models": lambda: models(LOSSES),
    "delay-distributions": lambda: delays(DISTRIBUTIONS),
    "delay-limits": lambda: ", ".join(code(f"{name}=") for name in LIMITS),
    "delay-courses": lambda: delays({"trace": Trace, **COURSES}),
    "content-faults": lambda: models(KINDS),
    "config-changes": lambda: models(config_change.KINDS),
    "segment-ways": lambda: models(segment.KINDS),
    "player-verbs": verbs,
    "leap-flags": lambda: ", ".join(map(code, LEAP_BITS)),
    "fault-fields": lambda: ", ".join(map(code, FIELDS)),
    "stat-names": lambda: table(
        ("name", "mask"), ((code(name), code(f"{mask:#06x}")) for name, mask in STAT_BITS.items())
    ),
    "ready-profiles": ready,
}
