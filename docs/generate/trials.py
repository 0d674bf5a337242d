"""What is done to a running controller, and what becomes of it: the tests try each row on ``dcon run``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from generate.markdown import code, table

EXAMPLES = Path(__file__).parents[1] / "systemd"


@dataclass(frozen=True)
class Trial:
    """A controller that is ACTIVE in closed loop, and what happens to it."""

    what: str
    state: str
    """Of the controller, once all has happened."""
    relays: str
    """``closed`` all along, ``open`` because the controller asked for it, ``tripped`` until an operator resets."""
    events: tuple[str, ...] = ()
    """That the session log must have."""
    restarts: tuple[str, ...] = ()
    """Processes that are started again."""
    besides: str = ""
    """More, in words."""


TRIALS = {
    "estop": Trial("an operator's emergency stop", "ESTOP", "tripped", ("estop",)),
    "gps": Trial("the clock loses its GPS lock for longer than the holdover", "STANDBY", "open", ("gps", "rampdown")),
    "line": Trial("the DC line is blocked", "STANDBY", "open", ("line_out", "rampdown")),
    "flood": Trial(
        "10,000 frames/s of another IDCODE at the port of one PMU",
        "ACTIVE",
        "closed",
        besides="every tick is run, and no frame of the other PMU is lost",
    ),
    "malformed": Trial(
        "10,000 malformed datagrams/s at the port of one PMU",
        "ACTIVE",
        "closed",
        besides="every tick is run, and no frame of the other PMU is lost",
    ),
    "spoofed": Trial(
        "frames with a PMU's IDCODE from another address", "ACTIVE", "closed", besides="none of them reaches a tick"
    ),
    "forged": Trial(
        "an order signed with a wrong key, and one that was heard before",
        "ACTIVE",
        "closed",
        ("refused",),
        besides="both are in the log, with the reason",
    ),
    "server-stopped": Trial(
        "the server hangs for three seconds (SIGSTOP)",
        "ACTIVE",
        "closed",
        ("server",),
        besides="the log has every tick of them",
    ),
    "server-killed": Trial(
        "the server is killed (SIGKILL)", "ACTIVE", "closed", restarts=("server",), besides="the log has every tick"
    ),
    "watchdog-killed": Trial(
        "the watchdog is killed", "FAULT", "open", ("watchdog", "fault"), ("watchdog",), "no command leaves any more"
    ),
    "front-killed": Trial(
        "the front is killed", "FAULT", "tripped", ("watchdog", "fault"), ("platform",), "a new session, open loop"
    ),
    "aides-killed": Trial(
        "the aides are killed", "STANDBY", "open", ("rampdown",), ("platform",), "a new session, open loop"
    ),
    "platform-killed": Trial(
        "the control process is killed", "FAULT", "tripped", (), ("platform",), "a new session, open loop"
    ),
    "platform-stopped": Trial(
        "the control process hangs for half a second (SIGSTOP)", "FAULT", "tripped", ("watchdog", "fault")
    ),
}
RELAYS = {"closed": "stay closed", "open": "open", "tripped": "open, latched"}


def trials() -> str:
    """Every trial and its outcome."""
    rows = []
    for trial in TRIALS.values():
        again = f"{', '.join(trial.restarts)} started again" if trial.restarts else ""
        besides = "; ".join(filter(None, (again, trial.besides)))
        rows.append((trial.what, trial.state, RELAYS[trial.relays], ", ".join(map(code, trial.events)), besides))
    return table(("what happens", "controller", "relays", "events", "besides"), rows)


def example(name: str, language: str) -> str:
    """A file of ``docs/systemd``, whole."""
    return f"```{language}\n{(EXAMPLES / name).read_text(encoding='utf-8').strip()}\n```"


GENERATORS = {
    "trials": trials,
    "systemd-unit": lambda: example("dcon.service", "ini"),
    "site-ini": lambda: example("site.ini", "ini"),
}
