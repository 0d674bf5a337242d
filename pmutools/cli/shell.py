"""What all commands share: lazy subcommands, common options, exit codes, one line an error.

Exit codes: 0 done; 1 failed; 2 usage; 3 finished, but input was lost or undecodable, or a check failed;
130 interrupted. A traceback shows only with ``--debug``.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Callable, Sequence
from enum import IntEnum
from importlib import import_module
from types import FrameType
from typing import Any, TypeVar

import click

from pmutools.errors import PmuError, SettingsError

F = TypeVar("F", bound=Callable[..., Any])


class Exit(IntEnum):
    DONE = 0
    FAILED = 1
    USAGE = 2
    INCOMPLETE = 3
    INTERRUPTED = 130


class LazyGroup(click.Group):
    """A group that knows its subcommands' names and one-line helps, and imports a subcommand only to run it."""

    def __init__(self, name: str, commands: dict[str, tuple[str, str]], *, help: str, version: str) -> None:
        super().__init__(name, help=help, context_settings={"help_option_names": ["-h", "--help"]})
        self.lazy = commands
        click.version_option(version, prog_name=name)(self)

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.lazy)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in self.lazy:
            return None
        command: click.Command = import_module(self.lazy[cmd_name][0]).command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in self.lazy.items()])


def common(function: F) -> F:
    """The options every command takes: ``--json --quiet -v --debug``."""
    for option in reversed(
        (
            click.option("--json", "as_json", is_flag=True, help="Data to stdout as JSON; talk goes to stderr."),
            click.option("-q", "--quiet", is_flag=True, help="No talk, no progress; errors only."),
            click.option("-v", "--verbose", count=True, help="More talk; twice: everything."),
            click.option("--debug", is_flag=True, expose_value=False, help="Show tracebacks.", hidden=True),
        )
    ):
        function = option(function)
    return function


class Talk:
    """Talk to the person: always on stderr, so that stdout is data."""

    def __init__(self, quiet: bool, verbose: int) -> None:
        self.quiet = quiet
        self._shown = False
        level = logging.ERROR if quiet else (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
        logging.basicConfig(level=level, format="%(levelname)s %(name)s: %(message)s", stream=sys.stderr)

    def say(self, text: str) -> None:
        if not self.quiet:
            self._clear()
            click.echo(text, err=True)

    def progress(self, text: str) -> None:
        """A line that the next one overwrites; only where a person is watching."""
        if not self.quiet and sys.stderr.isatty():
            self._clear()
            click.echo(text, err=True, nl=False)
            self._shown = True

    def _clear(self) -> None:
        if self._shown:
            click.echo("\r\x1b[K", err=True, nl=False)
            self._shown = False


def run(command: click.Command, arguments: Sequence[str], *, name: str | None = None) -> int:
    """Run a command; every outcome becomes an exit code and at most one line on stderr."""
    name = name or command.name or "pmu"
    debug = "--debug" in arguments
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        code = command.main(list(arguments), prog_name=name, standalone_mode=False)
        sys.stdout.flush()
        return int(code or 0)
    except click.ClickException as error:
        if debug:
            raise
        error.show()
        return Exit.USAGE
    except (KeyboardInterrupt, click.Abort):
        return Exit.INTERRUPTED
    except BrokenPipeError:  # `pmu dump ... | head`: the reader has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return Exit.DONE
    except SettingsError as error:
        if debug:
            raise
        return _complain(name, error, Exit.USAGE)
    except (PmuError, OSError) as error:
        if debug:
            raise
        return _complain(name, error, Exit.FAILED)
    except Exception as error:
        if debug:
            raise
        return _complain(name, f"internal error: {type(error).__name__}: {error} (--debug shows where)", Exit.FAILED)


def _complain(name: str, error: object, code: Exit) -> int:
    text = " ".join(str(error).split())
    click.echo(f"{name}: {text}", err=True)
    return code


def _interrupt(signum: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt
