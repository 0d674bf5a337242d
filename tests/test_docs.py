"""The documentation is true: tables are made from the code, examples run, commands parse, public names are explained.

In ``README.md`` and ``docs/``:

- every ```` ```python ```` block runs, in a folder that has ``captures``; a ```` ```text ```` block right after it is
  exactly what it prints;
- every ``$ `` line of a ```` ```console ```` block is a command that click accepts;
- under ``<!-- run -->`` (``<!-- run: slow -->``) they are run, one after the other, and print what the block says,
  where ``...`` stands for anything.
"""

from __future__ import annotations

import ast
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import click
import pytest

from dcon.cli import dcon
from dcon.core.rows import CORE
from pmutools.cli import pmu

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = {path.relative_to(ROOT).as_posix(): path for path in (ROOT / "README.md", *sorted(DOCS.glob("*.md")))}
WITH_COMMANDS = PAGES | {"captures/README.md": ROOT / "captures" / "README.md"}
EXPLAINED = ("pmutools/c37118", "pmutools/formats", "pmutools/net", "dcon/core")
IMAGE_LIMIT_BYTES = 200_000
TIME_LIMIT_S = 60
INCOMPLETE = 3
"""Exit code of a command that found damage, which an example may want to show."""

sys.path.insert(0, str(DOCS))
from generate import GENERATORS, display  # noqa: E402
from hooks import MARKER, filled  # noqa: E402


class Fence(NamedTuple):
    """A code block: the comment right above it, its language, its text, and the block right after it, if any."""

    marker: str
    language: str
    text: str
    after: str | None


_FENCE = re.compile(
    r"^(?:<!-- ([\w: ]+) -->\n)?```(\w*)\n(.*?)^```$(?:\n\n```text\n(.*?)^```$)?", re.MULTILINE | re.DOTALL
)


@cache
def fences(page: str) -> list[Fence]:
    text = WITH_COMMANDS[page].read_text(encoding="utf-8")
    return [Fence(match[1] or "", match[2], match[3], match[4]) for match in _FENCE.finditer(text)]


# --- what is made from the code ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", GENERATORS)
def test_what_is_generated_is_whole(name: str) -> None:
    text = GENERATORS[name]()
    assert text.strip()
    assert "None" not in text
    for block in re.findall(r"(?:^\|.*\|$\n?)+", text, re.MULTILINE):
        widths = {len(re.split(r"(?<!\\)\|", re.sub(r"`[^`]*`", "", row))) for row in block.splitlines()}
        assert len(widths) == 1, block


def test_markers_and_generators_are_the_same() -> None:
    used = [name for path in PAGES.values() for name in MARKER.findall(path.read_text(encoding="utf-8"))]
    assert set(used) == GENERATORS.keys()
    assert "<!-- generated" not in filled("<!-- generated: layers -->")
    with pytest.raises(KeyError):
        filled("<!-- generated: no-such-table -->")


def test_a_page_has_no_marker_that_is_misspelt() -> None:
    for page, path in PAGES.items():
        comments = re.findall(r"<!--.*?-->", path.read_text(encoding="utf-8"))
        strange = [c for c in comments if not MARKER.fullmatch(c) and c not in ("<!-- run -->", "<!-- run: slow -->")]
        assert not strange, page


def test_images_are_small_and_there() -> None:
    for page, path in PAGES.items():
        for target in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", path.read_text(encoding="utf-8")):
            assert 0 < (path.parent / target).stat().st_size < IMAGE_LIMIT_BYTES, (page, target)


def test_files_that_the_readme_links_to_are_there() -> None:
    for target in re.findall(r"\]\(([^)#]+)", PAGES["README.md"].read_text(encoding="utf-8")):
        assert target.startswith("http") or (ROOT / target).exists(), target


def test_the_picture_of_the_player_is_what_its_code_draws() -> None:
    kept, made = (
        re.sub(r"<[^>]*>|\s", "", text) for text in (display.PICTURE.read_text(encoding="utf-8"), display.svg())
    )
    assert kept.partition("PLAYING")[2] == made.partition("PLAYING")[2], display.__doc__


# --- examples ----------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A place to run examples in: the sample recordings beside it, the commands on the path."""
    (tmp_path / "captures").symlink_to(ROOT / "captures", target_is_directory=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"])))
    monkeypatch.setenv("COLUMNS", "200")
    return tmp_path


PYTHON = [(page, number) for page in PAGES for number, fence in enumerate(fences(page)) if fence.language == "python"]


@pytest.mark.parametrize(("page", "number"), PYTHON, ids=[f"{page}-{number}" for page, number in PYTHON])
def test_python_examples_run(page: str, number: int, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fence = fences(page)[number]
    exec(compile(fence.text, f"{page}, block {number}", "exec"), {"__name__": "example"})
    if fence.after is not None:
        assert capsys.readouterr().out == fence.after


def steps(text: str) -> Iterator[tuple[str, str]]:
    """(command, what it is said to print) of a console block."""
    for part in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]:
        command, _, printed = part.partition("\n")
        yield command, printed.strip()


def said(printed: str, output: str) -> bool:
    """Whether ``output`` is what ``printed`` says, in which ``...`` stands for anything."""
    pattern = ".*?".join(map(re.escape, printed.split("...")))
    return re.fullmatch(pattern, output.strip(), re.DOTALL) is not None


def run_examples(page: str, marker: str) -> None:
    for fence in fences(page):
        if fence.marker != marker:
            continue
        for command, printed in steps(fence.text):
            done = subprocess.run(
                command, shell=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=TIME_LIMIT_S
            )
            assert done.returncode in (0, INCOMPLETE), (command, done.stdout)
            assert said(printed, done.stdout), (
                f"{page}: $ {command}\n--- prints\n{done.stdout}--- is said to print\n{printed}"
            )


RUN = [page for page in PAGES if any(fence.marker == "run" for fence in fences(page))]
RUN_SLOW = [page for page in PAGES if any(fence.marker == "run: slow" for fence in fences(page))]
posix = pytest.mark.skipif(os.name != "posix", reason="the examples are written for a POSIX shell")


@posix
@pytest.mark.parametrize("page", RUN)
def test_examples_print_what_is_shown(page: str, folder: Path) -> None:
    run_examples(page, "run")


@posix
@pytest.mark.slow
@pytest.mark.parametrize("page", RUN_SLOW)
def test_slow_examples_print_what_is_shown(page: str, folder: Path) -> None:
    run_examples(page, "run: slow")


def test_the_comparison_can_fail() -> None:
    assert said("a ... c\n...", "a b c\nd\ne\n")
    assert not said("a ... c", "a b d")
    assert not said("a", "a\nb")


# --- command lines -----------------------------------------------------------------------------------------------

GROUPS = {"pmu": pmu, "dcon": dcon}
ALIASES = {"stream-player": ("pmu", "play"), "stream-reader": ("pmu", "read")}
OTHERS = frozenset(("python", "head", "nc", "printf"))
"""Programs of others that examples use."""


def subcommand(words: list[str]) -> click.Command:
    """The subcommand that ``words`` begin with; fails for one that there is not."""
    group = GROUPS[words[0]]()
    command = group.get_command(click.Context(group, info_name=words[0]), words[1])
    assert command is not None, " ".join(words[:2])
    return command


def parse(words: list[str]) -> None:
    """Let click read a command line, without running it; raises click.ClickException."""
    first, *rest = words
    if first in ALIASES:
        parse([*ALIASES[first], *rest])
    elif first in GROUPS:
        subcommand(words).make_context(words[1], words[2:])
    elif first == "make":
        assert re.search(rf"^{rest[0]}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE), words
    else:
        assert first in OTHERS, words


def simple_commands(line: str) -> Iterator[list[str]]:
    """The commands of a shell line without pipes, redirections and the like."""
    lexer = shlex.shlex(line, posix=True, punctuation_chars="|&;<>")
    lexer.whitespace_split = True
    words: list[str] = []
    to_file = False
    for word in lexer:
        if word in (">", ">>", "<"):
            to_file = True
        elif set(word) <= set("|&;"):
            yield words
            words = []
        elif to_file:
            to_file = False
        else:
            words.append(word)
    if words:
        yield words


COMMANDS = [
    (page, command)
    for page in WITH_COMMANDS
    for fence in fences(page)
    if fence.language == "console"
    for command, _ in steps(fence.text)
]


@pytest.mark.parametrize(("page", "line"), COMMANDS, ids=[f"{page}: {command[:60]}" for page, command in COMMANDS])
def test_commands_shown_are_accepted(page: str, line: str) -> None:
    for words in simple_commands(line):
        parse(words)


def test_a_wrong_command_would_not_be() -> None:
    for line in ("pmu info --no-such-option FILE", "dcon simulate", "pmu dump x --type nothing", "pmu no-such-command"):
        with pytest.raises((click.ClickException, AssertionError)):
            parse(line.split())


@pytest.mark.parametrize("page", PAGES)
def test_commands_named_in_the_text_exist(page: str) -> None:
    text = _FENCE.sub("", PAGES[page].read_text(encoding="utf-8"))
    for name in re.findall(r"`((?:pmu|dcon) [a-z][^`]*)`", text):
        words = name.split()
        known = {option for item in subcommand(words).params for option in item.opts} | {"--help"}
        assert {word for word in words if word.startswith("--")} <= known, name


# --- docstrings --------------------------------------------------------------------------------------------------

CHECKS = {row.test.__name__ for table in (CORE.frame, CORE.pmu, CORE.instance, CORE.system) for row in table}
"""Tests of check rows: the row's own text explains them."""


def definitions(path: Path) -> Iterator[Any]:
    """Public functions and classes of a module."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield node


@pytest.mark.parametrize("package", EXPLAINED)
def test_public_names_are_explained(package: str) -> None:
    bare = [
        f"{path.relative_to(ROOT)}:{node.lineno} {node.name}"
        for path in sorted((ROOT / package).rglob("*.py"))
        for node in definitions(path)
        if not ast.get_docstring(node) and node.name not in CHECKS
    ]
    assert not bare


@pytest.mark.parametrize("package", EXPLAINED)
def test_modules_say_what_they_are(package: str) -> None:
    for path in sorted((ROOT / package).rglob("*.py")):
        assert ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))), path
