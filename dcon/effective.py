"""Every setting in force, with unit, default and source: what ``dcon check`` prints.

A field of a section's dataclass needs to say nothing for that: its unit follows from its name unless its metadata has
one, and a number without a source is our own choice.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import MISSING, Field, fields
from typing import Any, Final, NamedTuple

from dcon.core.idle import idle_checks
from dcon.safeguards import weak_safeguards
from dcon.settings import ELSEWHERE, PARAMS, RATE_HZ, Settings, every_pair

GIVEN: Final = "initialisation file"
OWN: Final = "own choice"
UNITS: Final = {
    "_ms": "ms",
    "_us": "us",
    "_s": "s",
    "_minutes": "min",
    "_mb": "MB",
    "rate": "frames/s",
    "_hz": "Hz",
    "_mhz": "mHz",
    "_mw": "MW",
    "_kv": "kV",
    "_v": "V",
    "_percent": "%",
}
"""By how the key ends, the first that fits, where the metadata has no ``unit``."""
NOT_SET: Final = "not set"


def warnings_of(settings: Settings) -> list[str]:
    """One line for each check that cannot fire, and each safeguard that does not do all that it could."""
    return idle_checks(settings.params) + weak_safeguards(settings)


class Effective(NamedTuple):
    """One setting. ``default`` is None where it is what is in force, or there is none."""

    section: str
    key: str
    value: str
    default: str | None
    source: str
    """Of the value: where the default comes from if that is in force, else that it was given."""

    def __str__(self) -> str:
        also = "" if self.default is None else f"; default {self.default}"
        return f"[{self.section}] {self.key} = {self.value}   ({self.source}{also})"


def effective(settings: Settings) -> list[Effective]:
    """Every setting in force, in the order of the sections."""
    params = settings.params
    rows = [row for site in settings.sites for row in _of(f"pmu {site.name}", site, ("name",))]
    rows += _of("controller", params, ELSEWHERE)
    rows.append(_priority(settings))
    for section, values in (
        ("supervisor", params.thresholds),
        ("probing", params.probing),
        ("pdci", settings.line_input),
        ("pdci", params.line),
        ("platform", settings.platform),
        ("watchdog", settings.watchdog),
        ("server", settings.server),
        ("output", settings.output),
        ("log", settings.log),
    ):
        rows += _of(section, values, ("samples",))
    return [_given(row) if (row.section, row.key) in settings.given else row for row in rows]


def _given(row: Effective) -> Effective:
    """A row that the file gives, be it by chance what the default is."""
    return row._replace(source=GIVEN)


def _priority(settings: Settings) -> Effective:
    names = ",".join(settings.params.instance_names)
    if settings.params.instances == every_pair("", settings.sites):
        return Effective("controller", "priority", names, None, OWN)
    return Effective("controller", "priority", names, "every north with every south", GIVEN)


def _of(section: str, values: Any, leave_out: Collection[str]) -> Iterator[Effective]:
    """The fields of a section's dataclass."""
    for item in fields(values):
        if item.name not in leave_out:
            yield _row(section, item, getattr(values, item.name))


def _row(section: str, item: Field[Any], value: object) -> Effective:
    default, source = item.default, item.metadata.get("source", OWN)
    if item.name == "rate":  # of a PMU: the one number that the controller has by another name
        default, source = RATE_HZ, PARAMS["rate_hz"].metadata["source"]
        value = default if value is None else value
    source = f"own {source}" if source.startswith("choice") else source
    shown = _shown(item, value)
    if default is MISSING:
        return Effective(section, item.name, shown, None, GIVEN)
    if value == default:
        return Effective(section, item.name, shown, None, source)
    return Effective(section, item.name, shown, _shown(item, default), GIVEN)


def _shown(item: Field[Any], value: object) -> str:
    """With its unit."""
    if value is None or value == "":
        return NOT_SET
    if type(value) is tuple:  # an address is one too, and says itself how it is written
        return ",".join(map(str, value))
    text = f"{value:g}" if isinstance(value, float) else str(value)
    if isinstance(value, bool):
        return text.lower()
    return f"{text} {_unit(item)}".strip() if isinstance(value, int | float) else text


def _unit(item: Field[Any]) -> str:
    if "unit" in item.metadata:
        return str(item.metadata["unit"])
    return next((unit for ending, unit in UNITS.items() if item.name.endswith(ending)), "")
