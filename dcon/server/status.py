"""Parts of a status for operators: above all, what is bad and what is only not known. Pure."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

from dcon.core.rows import CORE
from dcon.core.values import Surroundings

TEXTS: Final = {row.name: row.text for row in CORE.rows}
LINE_CHECKS: Final = ("line_out", "line_refuses")
"""They are up, too, where the line's status is required and not known."""
UNTOLD: Final = {
    "gps": ("gps_age_s", "nobody has told yet whether the controller's clock has GPS"),
    "watchdog": ("watchdog_healthy", "nobody has told yet whether the watchdog is healthy"),
    "estop": ("estop_released", "nobody has told yet whether the emergency stop is pressed"),
}
"""So are these, before anything is told: of which field, and what is to be read then."""


class LineExpected(NamedTuple):
    """Whether anybody should tell of the line, and how old a status is known."""

    fitted: bool = False
    status_age_s: float = 2.0


NO_LINE: Final = LineExpected()


def line_of(source: LineExpected, last: Any | None, utc_ns: int) -> dict[str, Any] | None:
    """The ``line`` of a status at ``utc_ns``, by the line's ``last`` status; None where there is none to be told of."""
    if last is None:
        known = {"known": False, "age_s": None, "time_ns": None}
        return {**known, **dict.fromkeys(_SAID), "last_said": None} if source.fitted else None
    age_s = (utc_ns - last.time_ns) / 1e9
    said = {name: getattr(last, name) for name in _SAID}
    is_known = age_s <= source.status_age_s
    now = said if is_known else dict.fromkeys(said)
    return {"known": is_known, "age_s": max(age_s, 0.0), "time_ns": last.time_ns, **now, "last_said": said}


_SAID: Final = ("power_mw", "scheduled_mw", "in_service", "dcon_enabled")


def flag_text(check: str, told: Surroundings | None, line: dict[str, Any] | None) -> str:
    """What a check that is up, or latched, means: bad, or not known. ``line`` as it was in the check's tick."""
    if check in LINE_CHECKS and line is not None and not line["known"]:
        age_s = line["age_s"]
        return f"the line's status is not known, {'and never was' if age_s is None else f'for {age_s:.1f} s'}"
    field, untold = UNTOLD.get(check, ("", ""))
    if field and told is not None and getattr(told, field) is None:
        return untold
    return TEXTS.get(check, "")


def watchdog_of(
    silent: bool, *, relays_closed: bool, estop: bool, latched: bool, causes: Sequence[str], **others: Any
) -> dict[str, Any]:
    """The ``watchdog`` of a status. Of one that is silent nothing is known but what it said last."""
    said = {"relays_closed": relays_closed, "estop": estop, "latched": latched, "causes": list(causes)}
    now = dict.fromkeys(said) if silent else said
    return {**now, "silent": silent, "reason": " ".join(causes), "last_said": said, **others}


def _finite(value: Any) -> Any:
    """With None for what is no number: JSON has no NaN, and no infinity."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_json(values: dict[str, Any]) -> bytes:
    """One line; what is no finite number is null."""
    return json.dumps(_finite(values), separators=(",", ":"), allow_nan=False).encode() + b"\n"
