"""``python -m dcon.aides``."""

from __future__ import annotations

import argparse
import logging
import signal
import sys
import threading
from pathlib import Path

from dcon.aides.crew import aides, work
from dcon.link import paths
from dcon.link.failure import Failure
from dcon.link.news import encode
from dcon.settings import load
from pmutools import linux
from pmutools.errors import PmuError
from pmutools.log_thread import log_in_thread


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="dcon.aides")
    parser.add_argument("--ini", required=True)
    parser.add_argument("--run-dir", type=Path, required=True)
    given = parser.parse_args(arguments)
    linux.end_with_parent(signal.SIGKILL)
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopping.set())
    failure: Failure | None = None
    try:
        with log_in_thread():  # a stuck reader of what is logged must not hold up the beats
            if reason := work(aides(load(given.ini), paths.prepare(given.run_dir)), stopping.is_set):
                failure = Failure(reason)
    except PmuError as error:
        failure = Failure.of(error)
    if failure is None:
        return 0
    told = encode(failure)
    if not paths.Sender(given.run_dir / paths.CONTROL).send(told):  # else who has started this one says it
        sys.stderr.write(f"aides: {failure.reason}\n")
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
