"""What all commands share: lazy subcommands, common options, exit codes, one line an error.

Exit codes: 0 done; 1 failed; 2 usage; 3 finished, but input was lost or undecodable, or a check failed;
130 interrupted. A traceback shows only with ``--debug``.
"""

from __future__ import annotations

import io
import logging
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from enum import IntEnum
from importlib import import_module
from types import FrameType
from typing import Any, TypeVar

import click

from pmutools.errors import PmuError, SettingsError
from pmutools.parsers import Parser, suggestion

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

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command:
        if cmd_name not in self.lazy:
            raise click.UsageError(f"no command {cmd_name!r}; {suggestion(cmd_name, self.lazy)}", ctx)
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


def visible(text: str) -> str:
    """``text`` with what does not print (line ends, control sequences of a terminal) escaped."""
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


class Talk:
    """Talk to the person: always on stderr, so that stdout is data."""

    def __init__(self, quiet: bool, verbose: int) -> None:
        self.quiet = quiet
        self._shown = False
        level = logging.ERROR if quiet else (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
        logging.basicConfig(level=level, format="%(levelname)s %(name)s: %(message)s", stream=sys.stderr)

    def say(self, text: str) -> None:
        if not self.quiet:
            self.complain(text)

    def complain(self, text: str) -> None:
        """Say what went wrong: shown with ``--quiet`` too."""
        self._clear()
        _echo(visible(text))

    def progress(self, text: str) -> None:
        """A line that the next one overwrites, and an empty one removes; only where a person is watching."""
        if not self.quiet and sys.stderr.isatty():
            self._clear()
            _echo(visible(text), nl=False)
            self._shown = bool(text)

    def _clear(self) -> None:
        if self._shown:
            _echo("\r\x1b[K", nl=False)
            self._shown = False


def _echo(text: str, *, nl: bool = True) -> None:
    """To stderr. Where whoever read it is gone, the work goes on: only without stdout it would be for nothing."""
    try:
        click.echo(text, err=True, nl=nl)
    except BrokenPipeError:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115  # as long as the process


class Parsed(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.4, of the same name before
    """An option read by one of :mod:`pmutools.parsers`, which says what is wrong with a value and what to write."""

    name = "value"

    def __init__(self, parse: Parser[Any]) -> None:
        self.parse = parse

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not isinstance(value, str):
            return value
        try:
            return self.parse(value)
        except ValueError as error:
            self.fail(str(error), param, ctx)


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Ctrl-C and SIGTERM only ask to stop: gives a function that tells whether they have; a second one interrupts.

    For work that must not be cut between two writes. Who uses this returns :attr:`Exit.INTERRUPTED`.
    """
    asked = False

    def ask(signum: int, frame: FrameType | None) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run(command: click.Command, arguments: Sequence[str], *, name: str | None = None) -> int:
    """Run a command; every outcome becomes an exit code and at most one line on stderr.

    ``--debug`` adds the traceback, and changes nothing else.
    """
    name = name or command.name or "pmu"
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices are small here: a second thread spins for nothing
    signal.signal(signal.SIGTERM, _interrupt)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a station's name is no reason to fail
    try:
        if f"_{name}_COMPLETE".replace("-", "_").upper() in os.environ:  # a shell asks what could come next
            command.main(list(arguments), prog_name=name)
        with command.make_context(name, list(arguments)) as ctx:
            code = command.invoke(ctx)
        sys.stdout.flush()
        return int(code or 0)
    except click.exceptions.Exit as end:  # --help, --version
        return end.exit_code
    except (KeyboardInterrupt, click.Abort):
        return Exit.INTERRUPTED
    except BrokenPipeError:
        return _unread()
    except SystemExit as end:  # so rich says that a pipe is broken
        if not isinstance(end.__context__, BrokenPipeError):
            raise
        return _unread()
    except Exception as error:
        if "--debug" in arguments:
            traceback.print_exc()
        code, text = _judged(error, name)
        click.echo(text, err=True)
        return code


def _unread() -> int:
    """``pmu dump ... | head``: the reader has seen enough."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    return Exit.DONE


def _judged(error: Exception, name: str) -> tuple[Exit, str]:
    """The exit code and the text of an error: one line, but for the help that a bare ``pmu`` gives."""
    match error:
        case click.UsageError(ctx=click.Context() as ctx) if error.message == ctx.get_help():
            return Exit.USAGE, error.message
        case click.UsageError(ctx=click.Context() as ctx):
            return (
                Exit.USAGE,
                f"{_line(ctx.command_path, error.format_message())} ({ctx.command_path} --help lists all)",
            )
        case click.ClickException():
            return Exit.USAGE, _line(name, error.format_message())
        case SettingsError():
            return Exit.USAGE, _line(name, error)
        case PmuError():
            return Exit.FAILED, _line(name, error)
        case OSError():
            return Exit.FAILED, _line(name, f"{error.filename or 'standard output'}: {error.strerror or error}")
    what = f"internal error: {type(error).__name__}: {error} (--debug shows where)"
    return Exit.FAILED, _line(name, what)


def _line(name: str, what: object) -> str:
    return visible(f"{name}: {' '.join(str(what).split())}")


def _interrupt(signum: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt
