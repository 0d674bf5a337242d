"""A player's status for a person: one line of progress, or a table with a line a stream."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from pmutools.cli.columns import Column, layout, number
from pmutools.cli.shell import visible
from pmutools.tools.player.status import PacingStatus, PlayerStatus, StreamStatus


def faults_text(faults: dict[str, str]) -> str:
    """Faults in force, as they can be written again."""
    return "  ".join(f"{option}={' + '.join(value.split(chr(10)))}" for option, value in faults.items())


def late_text(pacing: PacingStatus) -> str:
    """How late frames left."""
    return f"late p50 {number(pacing.p50_us)} us p99 {number(pacing.p99_us)} us"


def misses_text(misses: int) -> str:
    return f"{misses} miss{'es' * (misses != 1)}"


def progress_line(status: PlayerStatus) -> str:
    """The whole player in one line, for where there is no display."""
    state = "" if status.state == "playing" else f"  {status.state}"
    return (
        f"{status.position_s:.1f}/{status.length_s:.1f} s{state}  loop {status.loop}  ×{speed_text(status.speed)}  "
        f"{number(status.frames_per_s)} frames/s  {late_text(status.pacing)}  {misses_text(status.pacing.misses)}"
    )


def speed_text(speed: float) -> str:
    """A speed with what digits it needs, one at least."""
    text = f"{speed:.4g}"
    return text if set(text) & set(".e") else f"{text}.0"


# --- columns -----------------------------------------------------------------------------------------------------


def _count(fate: str, width: int) -> Callable[[StreamStatus], str]:
    return lambda stream: number(stream.fates.get(fate, 0), width)


COLUMNS = (
    Column("stream", 0, lambda stream: visible(stream.name)),
    Column("id", 5, lambda stream: str(stream.idcode)),
    Column("on", 3, lambda stream: "on" if stream.enabled else "OFF", left=True),
    Column("to", 4, lambda stream: number(stream.clients, 4)),
    Column("sent", 8, _count("sent", 8)),
    Column("lost", 6, _count("lost", 6)),
    Column("drop", 5, _count("dropped", 5)),
    Column("disab", 5, _count("disabled", 5)),
    Column("skip", 5, _count("skipped", 5), 96),
    Column("fail", 5, _count("failed", 5), 96),
    Column("p50us", 5, lambda stream: number(stream.pacing.p50_us, 5)),
    Column("p99us", 5, lambda stream: number(stream.pacing.p99_us, 5)),
    Column("maxus", 6, lambda stream: number(stream.pacing.max_us, 6)),
    Column("miss", 5, lambda stream: number(stream.pacing.misses, 5), 96),
    Column("faults", 0, lambda stream: visible(faults_text(stream.faults))),
)
"""What is told of each stream. ``to`` counts who gets it; the counts are frames; delays are in µs."""


# --- the table of pmu ctl stats ----------------------------------------------------------------------------------


def state_lines(status: PlayerStatus) -> list[str]:
    """State, time, speed, pacing: what is not of one stream."""
    between = status.between
    loop = f"loop {status.loop}" + (f", between {between[0]:g} and {between[1]:g} s" if between else "")
    pacing = status.pacing
    return [
        f"{status.state.upper()}  {status.position_s:.3f} / {status.length_s:.3f} s  {loop}",
        f"speed ×{speed_text(status.speed)}  {number(status.frames_per_s)} frames/s  {status.sent} sent  "
        f"in {status.elapsed_s:.1f} s",
        f"{late_text(pacing)} max {number(pacing.max_us)} us  {misses_text(pacing.misses)}",
    ]


def status_lines(status: PlayerStatus, width: int) -> Sequence[str]:
    """All of it: the player, then a line a stream; at least 80 cells wide, faults whole."""
    table = layout(COLUMNS, max(width, 80))
    rows = []
    for stream in status.streams:
        counts = table.row(stream)[: -table.widths[-1]].rstrip()
        rows.append(f"{counts}  {visible(faults_text(stream.faults))}".rstrip())
    return [*state_lines(status), table.header().rstrip(), *rows]
