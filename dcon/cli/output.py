"""``dcon output``."""

from __future__ import annotations

import json
import signal

import click

from pmutools.cli.shell import Exit, Talk, common


@click.command(name="output", short_help="The output process: commands from the watchdog to a DAC or a Modbus device.")
@click.option("--ini", required=True, metavar="FILE")
@click.option("--run-dir", required=True, metavar="DIR", help="Where the platform's processes meet.")
@common
def command(ini: str, run_dir: str, as_json: bool, quiet: bool, verbose: int) -> int:
    """Drive what [output] names, iio:// or modbus://, with the commands that the watchdog lets through.

    Without a command for [output] hold_ms it goes to 0 V by itself. Ctrl-C leaves 0 V. Killed with SIGKILL it leaves
    the last value: then only the relays take it off the line.
    """
    from dcon.link.notify import Notifier
    from dcon.link.paths import prepare
    from dcon.output.process import OutputProcess
    from dcon.settings import load
    from pmutools.log_thread import log_in_thread
    from pmutools.realtime import go_realtime

    talk = Talk(quiet, verbose)
    settings = load(ini)
    process = OutputProcess(settings.output, prepare(run_dir), notifier=Notifier())
    before = {number: signal.signal(number, lambda *_: process.stop()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with log_in_thread():  # threads that are there already stay at the normal policy
            missing = go_realtime(fifo=settings.platform.fifo)
            if missing.fifo:
                talk.say(f"running at the normal scheduling policy: {missing.fifo}")
            talk.say(f"driving {settings.output.url}; Ctrl-C ends")
            process.run()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    outlet, driver = process.outlet, process.driver
    refused = {why: count for why, count in sorted(outlet.refused.items()) if count}
    if as_json:
        summary = {"commands": outlet.commands, "readbacks": process.readbacks, "holds": outlet.holds}
        click.echo(json.dumps(summary | {"refused": refused, "failed": driver.failed, "trouble": driver.trouble}))
    words = ", ".join(f"{count} {why}" for why, count in refused.items()) or "none"
    talk.say(
        f"{outlet.commands} commands, {process.readbacks} read back, {outlet.holds} times to 0 V for want of one; "
        f"refused: {words}; {driver.failed} failures"
    )
    if driver.trouble:
        talk.complain(f"the output may not be at 0 V: {driver.trouble}")
        return Exit.FAILED
    return Exit.DONE
