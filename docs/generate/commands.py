"""The command lines, from click itself."""

from __future__ import annotations

import click

from dcon.cli import dcon
from generate.markdown import code, prose, table
from pmutools.cli import pmu
from pmutools.cli.shell import Exit, LazyGroup, common

EXITS = {
    Exit.DONE: "done",
    Exit.FAILED: "failed: a file or endpoint that cannot be used, nothing found, an internal error",
    Exit.USAGE: "usage: an option, a name or a setting that cannot be",
    Exit.INCOMPLETE: "finished, but input bytes were lost or undecodable, or a replay differed",
    Exit.INTERRUPTED: "interrupted with Ctrl-C",
}


@click.command()
@common
def _bare() -> None: ...


_COMMON = {item.name for item in _bare.params} | {"debug"}
"""Options that every command takes: said once."""


def everywhere() -> str:
    """The options that every command takes."""
    ctx = click.Context(_bare)
    return table(
        ("option", "meaning"), ((name, text) for name, _, text in (_option(item, ctx) for item in _bare.params))
    )


def reference(group: LazyGroup) -> str:
    """Every subcommand of a group: usage, what it does, options."""
    parent = click.Context(group, info_name=group.name)
    return "\n\n".join(_subcommand(group, parent, name) for name in group.list_commands(parent))


def _subcommand(group: LazyGroup, parent: click.Context, name: str) -> str:
    command = group.get_command(parent, name)
    assert command is not None
    ctx = click.Context(command, info_name=name, parent=parent)
    pieces = " ".join(command.collect_usage_pieces(ctx))
    text = "\n\n".join(prose(part) for part in (command.help or "").split("\n\n"))
    options = [item for item in command.params if isinstance(item, click.Option)]
    rows = [_option(item, ctx) for item in options if item.name not in _COMMON]
    shown = table(("option", "default", "meaning"), rows)
    return f"### {group.name} {name}\n\n```text\n{group.name} {name} {pieces}\n```\n\n{text}\n\n{shown}"


def _option(option: click.Parameter, ctx: click.Context) -> tuple[str, str, str]:
    assert isinstance(option, click.Option)
    names = " ".join(code(name) for name in reversed(option.opts))
    takes = "" if option.is_flag or option.count else f" {option.make_metavar(ctx)}"
    default = option.get_default(ctx) if option.show_default else None
    meaning = [prose(option.help)] + (["Required."] if option.required else [])
    return names + (f" `{takes.strip()}`" if takes else ""), "" if default is None else code(default), " ".join(meaning)


def exits() -> str:
    """What the exit codes mean."""
    return table(("code", "meaning"), ((code(int(item)), EXITS[item]) for item in Exit))


GENERATORS = {
    "commands-pmu": lambda: reference(pmu()),
    "commands-dcon": lambda: reference(dcon()),
    "everywhere": everywhere,
    "exit-codes": exits,
}
