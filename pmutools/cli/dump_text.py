"""``pmu dump`` for a person: a described frame as a line of text."""

from __future__ import annotations

import math

from pmutools.formats.describe import Json


def one_line(described: Json) -> str:
    """A described frame in one line; names and texts may hold anything, line ends too."""
    kind = described["type"]
    if kind == "skipped":
        return f"-- skipped {described['nbytes']} bytes at {described['offset']}: {described['reason']}"
    if kind == "data":
        parts = []
        for station in described["stations"]:
            frequency = station["frequency"]
            text = f"{station['name']} stat={station['stat']:04x}"
            text += f" f={frequency:.4f}" if frequency is not None else " f=-"
            for phasor in station["phasors"]:
                text += f" {phasor['name']}={_polar_text(phasor)}"
            parts.append(text)
        return f"{described['time']} {described['idcode']:>5} data  {' | '.join(parts)}"
    detail = {
        "command": lambda: described.get("command", "?"),
        "header": lambda: described.get("text", "?"),
    }.get(kind, lambda: _config_text(described))()
    return f"{described['time'] or '-':<30} {described['idcode']:>5} {kind:<5} {detail}"


def _polar_text(phasor: Json) -> str:
    if phasor["re"] is None or phasor["im"] is None:
        return "-"
    value = complex(phasor["re"], phasor["im"])
    return f"{abs(value):.6g}<{math.degrees(math.atan2(value.imag, value.real)):.3f}"


def _config_text(described: Json) -> str:
    if "stations" not in described:
        return "undecodable"
    stations = ", ".join(
        f"{s['name']} ({len(s['phasors'])} phasors, {len(s['analogs'])} analogs, {len(s['digitals'])} words)"
        for s in described["stations"]
    )
    return f"{described['rate_hz']:g} frames/s, {stations}"
