"""``dcon simulate``."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pmutools.cli.shell import Parsed, Talk, common
from pmutools.errors import SettingsError, SourceError
from pmutools.parsers import number

if TYPE_CHECKING:
    from dcon.sim.plan import Plan
    from dcon.sim.simulate import Outcome

SWEPT = {"gain": "gain_mw_per_mhz", "delay": "delay_ms", "deadband": "deadband_mhz", "seed": "seed"}
SWEEP_LIMIT = 10_000


@click.command(name="simulate", short_help="A scenario in virtual time, through the same bytes and the same engine.")
@click.argument("scenario_name", metavar="SCENARIO")
@click.option("--plant", default="modal", show_default=True, metavar="NAME")
@click.option("--gain", type=Parsed(number(0, 100)), default=9.0, show_default=True, metavar="K", help="MW/mHz.")
@click.option("--delay", type=Parsed(number(0, 2000)), default=82.0, show_default=True, metavar="MS", help="Total.")
@click.option("--deadband", type=Parsed(number(0, 100)), default=0.0, show_default=True, metavar="MHZ")
@click.option("--noise", type=Parsed(number(0, 100)), default=0.0, metavar="MRAD", help="Angle noise of every PMU.")
@click.option("--fault", "faults", multiple=True, metavar="NAME", help="A fault of the paper; repeatable.")
@click.option("--impair", metavar="PROFILE", help="An impairment profile: a ready one's name, or a file.")
@click.option("--no-control", is_flag=True, help="Compute and log, but drive nothing.")
@click.option("--no-align", is_flag=True, help="Do not align on time stamps (to see why one must).")
@click.option("--interpolate", is_flag=True, help="Bridge single lost frames by their midpoint.")
@click.option("--duration", type=Parsed(number(1e-3, 86400)), metavar="S", help="Default: until all is seen.")
@click.option("--seed", type=int, default=1, show_default=True, metavar="N")
@click.option("--sweep", "sweeps", multiple=True, metavar="NAME=FROM:TO:STEP", help="gain, delay, deadband or seed.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), metavar="DIR", help="Log the session there.")
@common
def command(
    scenario_name: str,
    plant: str,
    gain: float,
    delay: float,
    deadband: float,
    noise: float,
    faults: tuple[str, ...],
    impair: str | None,
    no_control: bool,
    no_align: bool,
    interpolate: bool,
    duration: float | None,
    seed: int,
    sweeps: tuple[str, ...],
    out: Path | None,
    as_json: bool,
    quiet: bool,
    verbose: int,
) -> None:
    """Simulate a SCENARIO: grid, PMUs, wire, faults and controller, and judge the ringdown.

    With --sweep, one line a run. With --out, each run leaves its session log there.
    """
    from dcon.sim.plan import Plan
    from dcon.sim.simulate import simulate
    from pmutools.impair.profile import Profile
    from pmutools.impair.profiles import load_profile

    talk = Talk(quiet, verbose)
    plan = Plan(
        scenario=scenario_name,
        plant=plant,
        gain_mw_per_mhz=gain,
        delay_ms=delay,
        deadband_mhz=deadband,
        faults=faults,
        profile=Profile() if impair is None else load_profile(impair),
        control=not no_control,
        align=not no_align,
        interpolate_single_loss=interpolate,
        duration_s=duration,
        noise_rad=noise / 1e3,
        seed=seed,
    )
    plans = list(_swept(plan, sweeps))
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise SourceError(f"--out {out}: {error.strerror}") from None
    for run, each in enumerate(plans, 1):
        path = None if out is None else str(out / ("session.mcap" if len(plans) == 1 else f"session-{run}.mcap"))
        outcome = simulate(each, path, partial(_progress, talk, f"run {run} of {len(plans)}"))
        talk.progress("")
        if as_json:
            click.echo(json.dumps(outcome.to_json() | ({"session": path} if path else {})))
        else:
            click.echo(_line(outcome) if len(plans) > 1 else _text(outcome))
        if path:
            talk.say(f"session log: {path}")


def _progress(talk: Talk, run: str, now_s: float) -> None:
    talk.progress(f"{run}: {now_s:.0f} s")


def _swept(plan: Plan, sweeps: tuple[str, ...]) -> list[Plan]:
    axes = [_axis(sweep) for sweep in sweeps]
    plans = [plan]
    for name, values in axes:
        plans = [replace(each, **{name: value}) for each, value in itertools.product(plans, values)]  # type: ignore[arg-type]
        if len(plans) > SWEEP_LIMIT:
            raise SettingsError(f"--sweep: more than {SWEEP_LIMIT} runs")
    return plans


def _axis(text: str) -> tuple[str, list[float]]:
    name, equals, span = text.partition("=")
    try:
        first, last, step = (float(part) for part in span.split(":"))
        count = int((last - first) / step + 1e-9) + 1
    except (ValueError, ZeroDivisionError, OverflowError):
        equals = ""
    if not equals or name not in SWEPT or first < 0 or not 0 < count <= SWEEP_LIMIT:
        raise SettingsError(f"--sweep {text}: write {'|'.join(SWEPT)}=FROM:TO:STEP, as in gain=0:15:3")
    values = [first + step * number for number in range(count)]
    return SWEPT[name], [int(value) for value in values] if name == "seed" else values


def _line(outcome: Outcome) -> str:
    plan, mode = outcome.plan, outcome.mode or outcome.open_loop
    judged = f"{mode.frequency_hz:.4f} Hz {mode.damping_percent:6.2f} %" if mode else "-"
    peak = max(map(abs, outcome.command_mw), default=0.0)
    settings = (
        f"K {plan.gain_mw_per_mhz:g} delay {plan.delay_ms:g} ms deadband {plan.deadband_mhz:g} mHz seed {plan.seed}"
    )
    return f"{settings}: {judged}, peak {peak:.1f} MW, {outcome.final_state}"


def _text(outcome: Outcome) -> str:
    plan = outcome.plan
    lines = [f"{plan.scenario} on {plan.plant}, {plan.length_s:g} s: {plan.course.text}"]
    lines.append(f"  K {plan.gain_mw_per_mhz:g} MW/mHz, total delay {plan.delay_ms:g} ms, seed {plan.seed}")
    for name, mode in (("open loop", outcome.open_loop), ("closed loop", outcome.mode)):
        if mode is not None:
            lines.append(f"  {name:<12} {mode.frequency_hz:.4f} Hz  {mode.damping_percent:6.2f} %  (R² {mode.r2:.4f})")
    peak = max(map(abs, outcome.command_mw), default=0.0)
    lines.append(f"  peak command {peak:.1f} MW, final state {outcome.final_state}")
    lines += [
        f"  {time_s:9.3f} s  {event.name:<22} {event.subject} {event.detail}".rstrip()
        for time_s, event in outcome.events
        if event.subject == "system" or not event.name.startswith("instance_")
    ]
    return "\n".join(lines)
