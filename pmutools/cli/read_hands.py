"""``pmu read --trigger signal,key``: a recording that a person or a program asks for."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from pmutools.cli.shell import Talk
from pmutools.errors import SettingsError

if TYPE_CHECKING:
    from pmutools.tools.reader.ring import Ring


def triggered_by_hand(ring: Ring, kinds: Sequence[str], talk: Talk, stack: ExitStack) -> list[Callable[[Any], None]]:
    """Connect the signal and the keyboard, where they are among the triggers; what is to be called each round.

    Raises SettingsError where there is no such signal, or no terminal.
    """
    if "signal" in kinds:
        stack.callback(_on_signal(lambda: ring.fire("signal"), talk))
    if "key" not in kinds:
        return []
    pressed = stack.enter_context(_keyboard())
    talk.say("any key records")

    def look(found: Any) -> None:
        if pressed():
            ring.fire("key")

    return [look]


def _on_signal(fire: Callable[[], object], talk: Talk) -> Callable[[], object]:
    """Have the signal fire; gives what undoes that."""
    if not hasattr(signal, "SIGUSR1"):
        raise SettingsError("this system has no SIGUSR1; use --trigger key")
    before = signal.signal(signal.SIGUSR1, lambda number, frame: fire())
    talk.say(f"kill -USR1 {os.getpid()} records")
    return lambda: signal.signal(signal.SIGUSR1, before)


@contextmanager
def _keyboard() -> Iterator[Callable[[], bool]]:
    """Whether a key was pressed since the last look. Raises SettingsError where there is no terminal."""
    if sys.platform == "win32" or not sys.stdin.isatty():
        raise SettingsError("--trigger key: standard input is no terminal; use --trigger signal")
    import select
    import termios
    import tty

    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)
    tty.setcbreak(terminal)
    try:
        yield lambda: bool(select.select([terminal], [], [], 0)[0] and os.read(terminal, 1 << 10))
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)
