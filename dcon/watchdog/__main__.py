"""``python -m dcon.watchdog``: plain arguments, as ``dcon watchdog`` makes them from an initialisation file."""

from __future__ import annotations

import argparse
import sys

from dcon.watchdog.codec import LOOPS
from dcon.watchdog.files import Lines
from dcon.watchdog.limits import Limits, Rules, refusal
from dcon.watchdog.links import Refused
from dcon.watchdog.loop import Config, main


def _limit(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        number = float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: write NAME=NUMBER") from None
    if refused := refusal(name, number):
        raise argparse.ArgumentTypeError(refused)
    return name, number


def _names(text: str) -> tuple[str, ...]:
    return tuple(filter(None, (name.strip() for name in text.split(","))))


def _loops(text: str) -> tuple[str, ...]:
    names = _names(text)
    if strange := [name for name in names if name not in LOOPS]:
        raise argparse.ArgumentTypeError(f"{strange[0]!r} is no loop; there are {', '.join(LOOPS)}")
    return names


def config_of(arguments: list[str]) -> Config:
    """The configuration that a command line asks for; SystemExit with a line on stderr where it cannot be."""
    parser = argparse.ArgumentParser(
        "python -m dcon.watchdog",
        description=__doc__,
        allow_abbrev=False,
        formatter_class=argparse.RawTextHelpFormatter,
    )
    parser.add_argument("--run-dir", required=True, metavar="DIR")
    parser.add_argument("--output", default=Config._field_defaults["output"], help="udp://HOST:PORT, or a socket there")
    parser.add_argument("--status", type=_names, default=Config._field_defaults["status"], help="sockets told, A,B")
    parser.add_argument("--beats", type=_loops, default=Rules().beats, help="loops that must beat, A,B")
    parser.add_argument("--readback-required", action="store_true")
    parser.add_argument("--limit", type=_limit, action="append", default=[], metavar="NAME=NUMBER")
    for name in Lines._fields[:-1]:
        parser.add_argument(f"--{name.replace('_', '-')}", default="", metavar="FILE")
    parser.add_argument("--pulse", action="store_true", help="drive closed relays by a turning level")
    parser.add_argument("--log", default="", metavar="FILE", help="default: stderr")
    parser.add_argument("--log-mb", type=float, default=10.0)
    parser.add_argument("--no-fifo", dest="fifo", action="store_false")
    given = parser.parse_args(arguments)
    rules = Rules(Limits(**dict(given.limit)), given.beats, given.readback_required)
    lines = Lines(*(getattr(given, name) for name in Lines._fields))
    log_bytes = max(1, int(given.log_mb * 1e6))
    return Config(given.run_dir, given.output, given.status, rules, lines, given.log, log_bytes, given.fifo)


if __name__ == "__main__":
    try:
        main(config_of(sys.argv[1:]))
    except Refused as refused:
        sys.stderr.write(f"dcon watchdog: {refused}\n")
        sys.exit(1)
