"""A status of the server in words: what ``dcon ctl status`` and ``dcon ctl watch`` show."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any


def line(status: dict[str, Any]) -> str:
    """One line of what changes."""
    before = "".join(f"{word}; " for word in (*_old(status), *_tripped(status)))
    if status.get("state") is None:
        return f"{before}no controller has been heard yet"
    flags = " ".join(dict.fromkeys(flag["name"] for flag in status["flags"] if flag["up"]))
    last = "" if status["controller_connected"] else "last known: "
    return (
        f"{before}{last}{status['state']:<8} {status['mode']:<11} {status['active'] or '-':<10} "
        f"{number(status['command_mw'], '8.2f')} MW {number(status['output_v'], '7.3f')} V  {_log(status)}  {flags}"
    ).rstrip()


def text(status: dict[str, Any]) -> str:
    """All that an operator needs; the first line has what must not be overlooked."""
    watchdog = [] if status["watchdog"] is None else [relays(status["watchdog"])]
    if status.get("state") is None:
        return "\n".join([line(status), *watchdog])
    return "\n".join([*_state(status), *watchdog, *_around(status), _log_line(status)])


def _state(status: dict[str, Any]) -> Iterator[str]:
    old, tripped = _old(status), _tripped(status)
    last = "last known: " if old else ""
    if old:
        trip = f", and {tripped[0]}" if tripped else ""
        yield f"{old[0]}{trip}: the controller is silent; what it was doing when it was last heard:"
    elif tripped:
        last = f"{tripped[0]}; the controller: "
    yield (
        f"{last}{status['state']}, {status['mode']}, gain {number(status['gain_mw_per_mhz'], 'g')} MW/mHz, "
        f"instance {status['active'] or 'none'}"
    )
    yield (
        f"{'last known: ' if old else ''}command {number(status['command_mw'], '.2f')} MW, "
        f"output {number(status['output_v'], '.3f')} V, probe {number(status['probe_mw'], '.2f')} MW"
    )


def _around(status: dict[str, Any]) -> Iterator[str]:
    from dcon.link.counts import words

    was = "" if status["controller_connected"] else "was "
    if status["line"] is not None:
        yield dc_line(status["line"])
    for pmu in status["pmus"]:
        age, f = pmu["age_ms"], pmu["f_hz"]
        shown = "nothing yet" if age is None else f"{was}{age:.0f} ms old" + ("" if f is None else f", {f:.4f} Hz")
        yield f"  {pmu['name']:<12} {shown}"
    for flag in status["flags"]:
        where = " ".join(filter(None, (flag["name"], flag["subject"])))
        yield f"  {f'{was}up' if flag['up'] else 'latched':<8} {where}: {flag['text']}"
    if counted := words(status["counts"] or {}):
        yield f"not taken: {counted}"


def number(value: float | None, spec: str) -> str:
    """Null is what is not known."""
    return "not known" if value is None else format(value, spec)


def _old(status: dict[str, Any]) -> list[str]:
    """What goes before a state that nobody may take for the present one."""
    told = status["controller_connected"] or status.get("state") is None
    return [] if told else [f"OLD, by {_age(status['tick_age_ms'])}"]


def _tripped(status: dict[str, Any]) -> list[str]:
    """That the watchdog has tripped: no command passes, whatever the controller says."""
    watchdog = status["watchdog"]
    if watchdog is None or not watchdog["last_said"]["latched"]:
        return []
    return ["the watchdog had TRIPPED when it was last heard" if watchdog["silent"] else "the watchdog has TRIPPED"]


def _age(age_ms: float | None) -> str:
    return "nobody knows how much" if age_ms is None else f"{age_ms / 1000:.1f} s"


def _log(status: dict[str, Any]) -> str:
    log = status["log"]
    if log["refused"]:
        return "log NOT WRITTEN"
    return "no log" if log["lag_s"] is None else f"log {log['lag_s']:.1f} s behind"


def _log_line(status: dict[str, Any]) -> str:
    log = status["log"]
    disk = "" if log["disk_free_percent"] is None else f", disk {log['disk_free_percent']:.0f} % free"
    missing = f"{log['unlogged_ticks']} ticks missing{disk}"
    if log["refused"]:
        return f"log NOT WRITTEN: the system takes nothing for {log['file'] or 'its file'}; is the disk full? {missing}"
    if log["lag_s"] is None:
        return f"no log, {missing}"
    trouble = ", the disk hangs" if log["hangs"] else ""
    return f"log {log['file']}, {log['lag_s']:.1f} s behind{trouble}, {missing}"


def relays(watchdog: dict[str, Any]) -> str:
    """What the watchdog says, and why."""
    said = watchdog["last_said"]
    words = [f"relays {'closed' if said['relays_closed'] else 'open'}"]
    if said["latched"]:
        words.append("tripped")
    if said["causes"]:
        words.append(f"causes: {' '.join(said['causes'])}")
    if watchdog["silent"]:
        return f"relays NOT KNOWN: the watchdog is silent; {_age(watchdog['age_ms'])} ago it said: {'; '.join(words)}"
    if beats := [f"{name} {age:.0f}" for name, age in watchdog["beats_ms"].items() if age is not None]:
        words.append(f"beats in ms: {' '.join(beats)}")
    return "; ".join(words)


def dc_line(line: dict[str, Any]) -> str:
    """What the DC line says."""
    said = line["last_said"]
    if said is None:
        return "line NOT KNOWN: it has never told its status"
    words = (
        f"{number(said['power_mw'], '.1f')} MW, {number(said['scheduled_mw'], '.1f')} MW scheduled, "
        f"{'in service' if said['in_service'] else 'OUT OF SERVICE'}, "
        f"{'accepts the command' if said['dcon_enabled'] else 'DOES NOT ACCEPT the command'}"
    )
    if line["known"]:
        return f"line {words}; {line['age_s']:.1f} s old"
    return f"line NOT KNOWN: its newest status is {line['age_s']:.1f} s old; it said: {words}"
