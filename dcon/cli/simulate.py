"""``dcon simulate``."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dcon.cli.spare import keep_sessions, spare_in
from pmutools.cli.shell import Parsed, Talk, common
from pmutools.errors import SourceError
from pmutools.parsers import number

if TYPE_CHECKING:
    from dcon.sim.simulate import Outcome
    from dcon.sim.sweep import Axis, Run

RESULT = "result.json"


def _rate(text: str) -> int:
    from dcon.settings import frames_per_s

    return frames_per_s(text)


@click.command(name="simulate", short_help="A scenario in virtual time, through the same bytes and the same engine.")
@click.argument("scenario_name", metavar="SCENARIO")
@click.option("--plant", default="modal", show_default=True, metavar="NAME")
@click.option("--gain", type=Parsed(number(0, 100)), default=9.0, show_default=True, metavar="K", help="MW/mHz.")
@click.option("--delay", type=Parsed(number(0, 2000)), default=82.0, show_default=True, metavar="MS", help="Total.")
@click.option("--rate", type=Parsed(_rate), default=60, show_default=True, metavar="FPS", help="Of every PMU.")
@click.option("--deadband", type=Parsed(number(0, 100)), default=0.0, show_default=True, metavar="MHZ")
@click.option("--noise", type=Parsed(number(0, 100)), default=0.0, metavar="MRAD", help="Angle noise of every PMU.")
@click.option("--fault", "faults", multiple=True, metavar="NAME", help="A fault of the paper; repeatable.")
@click.option("--impair", metavar="PROFILE", help="An impairment profile: a ready one's name, or a file.")
@click.option("--no-control", is_flag=True, help="Do not arm: nothing is driven but a probing signal.")
@click.option("--no-align", is_flag=True, help="Do not align on time stamps (to see why one must).")
@click.option("--interpolate", is_flag=True, help="Bridge single lost frames by their midpoint.")
@click.option("--duration", type=Parsed(number(1e-3, 86400)), metavar="S", help="Default: until all is seen.")
@click.option("--seed", type=int, default=1, show_default=True, metavar="N")
@click.option(
    *("--sweep", "sweeps"),
    multiple=True,
    metavar="NAME=FROM:TO:STEP",
    help="gain, delay, deadband, noise or seed; repeatable: every combination.",
)
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), metavar="DIR", help="Log the session there.")
@common
def command(
    scenario_name: str,
    plant: str,
    gain: float,
    delay: float,
    rate: int,
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

    With --sweep, one row a run, and with --json a list. With --out, each run leaves its session log there, and
    result.json holds what --json prints.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: for matrices this small threads only cost
    from dcon.sim.plan import Plan
    from dcon.sim.sweep import outcomes, parse_axis, runs
    from pmutools.impair.profile import Profile
    from pmutools.impair.profiles import load_profile

    talk, control = Talk(quiet, verbose), not no_control
    plan = Plan(
        scenario=scenario_name,
        plant=plant,
        gain_mw_per_mhz=gain,
        delay_ms=delay,
        rate_hz=rate,
        deadband_mhz=deadband,
        faults=faults,
        profile=Profile() if impair is None else load_profile(impair),
        control=control,
        align=not no_align,
        interpolate_single_loss=interpolate,
        duration_s=duration,
        noise_rad=noise / 1e3,
        seed=seed,
    )
    axes = [parse_axis(sweep) for sweep in sweeps]
    sweep = runs(plan, axes, out)
    if out is not None:
        with _naming(out):
            spare_in(out, (RESULT,), () if impair is None else (impair,))
            keep_sessions([run.path for run in sweep if run.path])
            out.mkdir(parents=True, exist_ok=True)
    results: list[dict[str, Any]] = []
    for number_, (run, outcome) in enumerate(
        zip(sweep, outcomes(sweep, lambda now_s: talk.progress(f"{now_s:.0f} s")), strict=True), 1
    ):
        talk.progress(f"{number_} of {len(sweep)} runs" if number_ < len(sweep) else "")
        results.append(_result(run, outcome, axes))
        if as_json:
            click.echo(("[\n" if number_ == 1 else "") * bool(axes) + json.dumps(results[-1]), nl=False)
            click.echo(",\n" if number_ < len(sweep) else "\n]\n" if axes else "\n", nl=False)
        elif quiet:
            pass
        elif axes:
            click.echo("\n".join(_rows(run, outcome, axes)[number_ > 1 :]))
            if outcome.mode is None and control:
                talk.say(f"run {number_}: {outcome.mode_reason}")
        else:
            click.echo(_text(outcome))
    if out is not None:
        talk.say(f"session log: {sweep[0].path}" if len(sweep) == 1 else f"{len(sweep)} session logs in {out}")
        with _naming(out):
            (out / RESULT).write_text(json.dumps(results if axes else results[0], indent=1) + "\n")


@contextmanager
def _naming(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise SourceError(f"--out {out}: {error.strerror}") from None


def _result(run: Run, outcome: Outcome, axes: list[Axis]) -> dict[str, Any]:
    result = outcome.to_json()
    if axes:
        result["swept"] = run.swept
    if run.path:
        result["session"] = run.path
    return result


def _rows(run: Run, outcome: Outcome, axes: list[Axis]) -> list[str]:
    """The head of a sweep's table, and the row of one run."""
    from dcon.sim.sweep import SWEPT

    mode = outcome.mode if outcome.plan.control else outcome.open_loop
    cells = [(f"{axis.name} {SWEPT[axis.name].unit}".strip(), f"{run.swept[axis.name]:g}") for axis in axes]
    cells += [
        ("frequency Hz", f"{mode.frequency_hz:.4f}" if mode else "-"),
        ("damping %", f"{mode.damping_percent:.2f}" if mode else "-"),
        ("peak MW", f"{outcome.peak_command_mw:.1f}"),
        ("final state", outcome.final_state),
    ]
    widths = [max(len(name), 8) for name, _ in cells]
    return [
        "  ".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True))
        for row in zip(*cells, strict=True)
    ]


def _text(outcome: Outcome) -> str:
    plan = outcome.plan
    lines = [f"{plan.scenario} on {plan.plant}, {plan.length_s:g} s: {plan.course.text}"]
    rate = f", {plan.rate_hz} frames/s" if plan.rate_hz != 60 else ""
    lines.append(f"  K {plan.gain_mw_per_mhz:g} MW/mHz, total delay {plan.delay_ms:g} ms{rate}, seed {plan.seed}")
    for name, mode in (("open loop", outcome.open_loop), ("closed loop", outcome.mode)):
        if mode is not None:
            lines.append(f"  {name:<12} {mode.frequency_hz:.4f} Hz  {mode.damping_percent:6.2f} %  (R² {mode.r2:.4f})")
    if outcome.mode is None:
        lines.append(f"  closed loop  {outcome.mode_reason}")
    lines.append(f"  peak command {outcome.peak_command_mw:.1f} MW, final state {outcome.final_state}")
    lines += [
        f"  {time_s:9.3f} s  {event.name:<22} {event.subject} {event.detail}".rstrip()
        for time_s, event in outcome.events
        if event.subject == "system" or not event.name.startswith("instance_")
    ]
    return "\n".join(lines)
