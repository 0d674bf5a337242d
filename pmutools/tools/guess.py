"""Which channels of a station are its voltage, and at what level: guessed from names, types and values."""

from __future__ import annotations

import cmath
import math
import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from pmutools.c37118.config import PhasorChannel, Station
from pmutools.c37118.constants import PhasorComponent

USUAL_KV = (
    *(0.4, 0.48, 4.16, 6.6, 10, 11, 12.47, 13.8, 20, 22, 24.9, 33, 34.5, 46, 66, 69, 110, 115, 132, 138, 150, 161),
    *(220, 230, 275, 287, 330, 345, 380, 400, 420, 500, 735, 765, 1000),
)
"""Nominal voltages in use, line to line."""
WITHIN = 0.06
"""A voltage is of the nearest usual level if it is at most this share away."""
PHASES = ("ABC", "RST", "RYB", "UVW", "123")
"""Letters that tell channels of three phases apart, in their order."""
_POSITIVE = re.compile(
    r"""(?<![A-Z0-9])V1(?![0-9])(?![ABC](?![A-Z]))   # V1, V1LPM; not V10, and not V1A, phase A of the first set
      | (?<![A-Z])(POS|POSSEQ|POSITIVE|PSEQ|PS)(?![A-Z])
      | (?<![A-Z])VPOS | (?<![A-Z])V\+ | \+\s*SEQ""",
    re.VERBOSE,
)


class Guess(NamedTuple):
    """Channels that make the positive-sequence voltage: one, or three phases; () where nothing fits."""

    channels: tuple[str, ...]
    basis: str = ""
    """What speaks for it."""
    doubt: str = ""
    """What speaks against it."""


def guess_voltage(station: Station, phasors: Sequence[complex]) -> Guess:
    """The positive-sequence channel by the type that CFG-3 gives, or by name; else the three phases.

    ``phasors`` (P,) are values of the station at one time, NaN where unknown. Channels named by numbers are taken for
    phases only where they are a third of a turn apart.
    """
    voltages = [
        (channel, value) for channel, value in zip(station.phasors, phasors, strict=True) if channel.kind == "V"
    ]
    kinds = {_component(channel) for channel, _ in voltages}
    if len(voltages) == 1 or len(kinds) > 1:  # types that are all the same say nothing
        for wanted in ((PhasorComponent.POSITIVE_SEQUENCE,), _THREE):
            found = [next((c.name for c, _ in voltages if _component(c) == kind), None) for kind in wanted]
            names = tuple(name for name in found if name is not None)
            if len(names) == len(wanted):
                return Guess(names, "CFG-3 says so")
    by_name = {channel.name: value for channel, value in reversed(voltages)}
    names = tuple(dict.fromkeys(channel.name for channel, _ in voltages))
    triples = list(_triples(names))
    numbered = {name for triple, letters in triples if letters == "123" for name in triple}
    for name in names:
        if _POSITIVE.search(name.upper()) and name not in numbered:
            return Guess((name,), "guessed from its name")
    for triple, letters in triples:
        turned = _turned([by_name[name] for name in triple])
        if turned or letters != "123":
            doubt = "" if turned is not False else "the three are not a third of a turn apart"
            return Guess(triple, "guessed from their names", doubt)
    return Guess(())


_THREE = (PhasorComponent.PHASE_A, PhasorComponent.PHASE_B, PhasorComponent.PHASE_C)


def _component(channel: PhasorChannel) -> int | None:
    """What of a three-phase quantity CFG-3 says that it is."""
    return None if channel.phscale is None else channel.phscale.type & 7


def _triples(names: Sequence[str]) -> Iterable[tuple[tuple[str, str, str], str]]:
    """Names that differ in one place only, by the letters of :data:`PHASES`; and these letters."""
    upper = {name.upper(): name for name in reversed(names)}
    for letters in PHASES:
        for name in names:
            first = name.upper()
            for at in range(len(first) - 1, -1, -1):
                if first[at] != letters[0]:
                    continue
                others = [first[:at] + letter + first[at + 1 :] for letter in letters[1:]]
                if all(other in upper for other in others):
                    yield (name, upper[others[0]], upper[others[1]]), letters


def _turned(phases: Sequence[complex]) -> bool | None:
    """Whether phases are alike and a third of a turn apart, the first one leading; None where there are no values."""
    if any(cmath.isnan(value) or not abs(value) for value in phases):
        return None
    first = phases[0]
    return all(
        abs(value / first * cmath.exp(2j * math.pi / 3 * number) - 1) < 0.3 for number, value in enumerate(phases)
    )


def nominal_kv(phase_volts: float) -> float | None:
    """The usual level, line to line, nearest to a phase voltage (V RMS); None where none is near."""
    if not (math.isfinite(phase_volts) and phase_volts > 0):
        return None
    kv = phase_volts * math.sqrt(3) / 1000
    nearest = min(USUAL_KV, key=lambda level: abs(math.log(kv / level)))
    return nearest if abs(kv / nearest - 1) <= WITHIN else None
