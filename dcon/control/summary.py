"""What a session comes to: what ``--json`` prints at its end."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Summary:
    """How a session went."""

    ticks: int = 0
    late_over_1ms: int = 0
    caught_up_ticks: int = 0
    """Ticks that ran later than the one after them should have."""
    skipped_ticks: int = 0
    """Ticks left out, after a pause of the machine or a step of UTC."""
    clock_steps: int = 0
    frames: int = 0
    counts: dict[str, int] = field(default_factory=dict)
    """What did not become what it was sent for (:data:`dcon.link.counts.COUNTS`)."""
    unread: dict[str, int] = field(default_factory=dict)
    """Those of the counts, by PMU."""
    session: int = 0
    """Number of the session at the server; 0 where this process writes the log."""
    unlogged_ticks: int = 0
    """Ticks that the log had no room for."""
    log_parts: list[str] = field(default_factory=list)
    """Files of the session log, where this process writes it."""
    final_state: str = ""
    trouble: str = ""
    """Why the session ended, where nobody wanted it to."""
