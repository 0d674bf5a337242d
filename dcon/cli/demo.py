"""``dcon demo``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from pmutools.cli.shell import Exit, Parsed, Talk, common
from pmutools.errors import SettingsError
from pmutools.parsers import number

SHORTEST_S = 48.0


@click.command(name="demo", short_help="The whole chain live on this machine: open loop, then closed loop.")
@click.option("--duration", type=Parsed(number(SHORTEST_S, 600)), metavar="S", help="Longer swings; 56 s by default.")
@click.option("--out", default="demo", show_default=True, type=click.Path(path_type=Path, file_okay=False))
@click.option("--gain", type=Parsed(number(0, 15)), default=12.0, show_default=True, metavar="K", help="MW/mHz.")
@click.option("--impair", default="table1", show_default=True, metavar="PROFILE", help="What happens on the network.")
@click.option("--seed", type=int, default=1, show_default=True)
@common
def command(
    duration: float | None, out: Path, gain: float, impair: str, seed: int, as_json: bool, quiet: bool, verbose: int
) -> int:
    """A simulated grid with eight emulated PMUs and the controller, as processes joined by sockets only.

    The dynamic brake goes in twice: first the controller only watches, then it drives the HVDC line. The session log,
    summary.json and a picture are left in --out.
    """
    from dcon.demo.conductor import Demo, perform
    from dcon.demo.course import Course
    from pmutools.impair.profiles import load_profile

    load_profile(impair)  # a misspelt name is told before anything is started
    talk = Talk(quiet, verbose)
    course = Course()
    if duration is not None:
        course = Course(swing_s=course.swing_s + (duration - course.end_s) / 2)
    if course.swing_s < 9:
        raise SettingsError(f"--duration {duration:g}: the swings would be too short to judge; at least {SHORTEST_S:g}")
    talk.say(f"live demo, {course.end_s:.0f} s; session log, summary and picture go to {out}/")
    demo = Demo(out, gain, course, impair, seed=seed)
    summary = perform(demo, lambda text, seconds: talk.say(f"  {max(seconds, 0.0):5.1f} s  {text}"))
    if as_json:
        click.echo(json.dumps(summary))
    else:
        click.echo(_table(summary, gain))
        picture = f", picture {summary['picture']}" if summary["picture"] else ""
        click.echo(f"session log {summary['session']}, summary {out / 'summary.json'}{picture}")
    if summary["picture"] is None:
        talk.say("no picture: matplotlib is not installed; pip install '.[analysis]' in a checkout brings it")
    opened, closed = summary["open_loop"], summary["closed_loop"]
    if opened is None or closed is None:
        click.echo("dcon demo: the swings could not be judged; is the machine overloaded?", err=True)
        return Exit.FAILED
    return Exit.DONE


def _table(summary: dict[str, Any], gain: float) -> str:
    lines = ["", f"{'':<26}{'frequency':>12}{'damping':>12}{'paper (simulation)':>26}"]
    for name, key in (("open loop", "open_loop"), (f"closed loop, K = {gain:g}", "closed_loop")):
        row = summary[key]
        if row is None:
            lines.append(f"{name:<26}{'not fitted':>24}")
            continue
        paper = ""
        if "paper_damping_percent" in row:
            paper = f"{row['paper_frequency_hz']:.3f} Hz  {row['paper_damping_percent']:4.1f} %"
        lines.append(f"{name:<26}{row['frequency_hz']:9.3f} Hz{row['damping_percent']:10.2f} %{paper:>26}")
    delay, late, compute = summary["delay_ms"], summary["wake_up_late_us"], summary["compute_us"]
    lines.append("")
    if delay and late and compute:
        lines += [
            f"{summary['frames']} frames, stamp to arrival {delay['mean']:.1f} ms (p99 {delay['p99']:.1f})",
            f"{summary['ticks']} ticks, compute p50 {compute['p50']:.0f} us p99 {compute['p99']:.0f} us, "
            f"wake-up p50 {late['p50']:.0f} us p99 {late['p99']:.0f} us",
            f"peak command {summary['peak_command_mw']:.1f} MW",
        ]
    return "\n".join(lines)
