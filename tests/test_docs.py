"""The documentation is true: tables are made from the code, examples run, commands parse, public names are explained.

In ``README.md`` and ``docs/``:

- every ```` ```python ```` block runs, in a folder that has ``captures``; a ```` ```text ```` block right after it is
  what it prints; the command of ``<!-- beside: COMMAND -->`` above it runs meanwhile;
- every ``$ `` line of a ```` ```console ```` block is a command that click accepts;
- under ``<!-- run -->`` (``<!-- run: slow -->``) they are run, one after the other, and print what the block says.
  A command that ends with ``&`` runs beside those after it, which wait until its
  ports and sockets are there; it is interrupted at the end of the block. :data:`PORTS` are replaced by free ones;
- under ``<!-- run: live -->`` too, all blocks of a page as one, with a machine for themselves; ``kill %1`` ends the
  first command that ends with ``&``; ``dcon ctl status`` is repeated until it sees what the block says;
- a block under ``<!-- file: NAME -->`` is written to that file.

``...`` stands for anything that is printed.
"""

from __future__ import annotations

import ast
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import click
import pytest
from support.live import free_ports

from dcon.cli import dcon
from pmutools.cli import pmu

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = {path.relative_to(ROOT).as_posix(): path for path in (ROOT / "README.md", *sorted(DOCS.glob("*.md")))}
WITH_COMMANDS = PAGES | {"captures/README.md": ROOT / "captures" / "README.md"}
EXPLAINED = (
    "pmutools/c37118",
    "pmutools/formats",
    "pmutools/net",
    "pmutools/measure",
    "pmutools/report",
    "dcon/core",
    "dcon/link",
    "dcon/watchdog",
)
IMAGE_LIMIT_BYTES = 200_000
TIME_LIMIT_S = 60
INCOMPLETE, INTERRUPTED = 3, 130
"""Exit codes of a command that found damage, which an example may want to show, and of one that was ended."""
PORTS = ("4712", "4713", "4790", "4801")
"""Examples use these; whoever runs the tests may use them too."""

sys.path.insert(0, str(DOCS))
from generate import GENERATORS, display, live  # noqa: E402
from hooks import MARKER, filled  # noqa: E402

BESIDE, FILE = "beside: ", "file: "


class Fence(NamedTuple):
    """A code block: the comment right above it, its language, its text, and the block right after it, if any."""

    marker: str
    language: str
    text: str
    after: str | None


_FENCE = re.compile(
    r"^(?:<!-- ([^\n]+) -->\n)?```(\w*)\n(.*?)^```$(?:\n\n```text\n(.*?)^```$)?", re.MULTILINE | re.DOTALL
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
        plain, open_ended = ("<!-- run -->", "<!-- run: slow -->", "<!-- run: live -->"), (BESIDE, FILE)
        strange = [
            c
            for c in comments
            if not MARKER.fullmatch(c) and c not in plain and not any(c.startswith(f"<!-- {one}") for one in open_ended)
        ]
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


@pytest.mark.parametrize("view", ["frequency", "delay"])
def test_the_pictures_of_the_live_displays_are_what_their_code_draws(view: str) -> None:
    kept, made = (
        re.sub(r"<[^>]*>|\s", "", text) for text in (live.picture(view).read_text(encoding="utf-8"), live.svg(view))
    )
    assert kept.partition("LIVE")[2] == made.partition("LIVE")[2], live.__doc__


# --- examples ----------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A place to run examples in: the sample recordings beside it, the commands on the path."""
    (tmp_path / "captures").symlink_to(ROOT / "captures", target_is_directory=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"])))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("COLUMNS", "200")
    return tmp_path


PYTHON = [(page, number) for page in PAGES for number, fence in enumerate(fences(page)) if fence.language == "python"]


@pytest.mark.parametrize(("page", "number"), PYTHON, ids=[f"{page}-{number}" for page, number in PYTHON])
def test_python_examples_run(page: str, number: int, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fence, ports = fences(page)[number], ports_to_use()
    command = fence.marker.removeprefix(BESIDE) if fence.marker.startswith(BESIDE) else None
    code = compile(replaced(fence.text, ports), f"{page}, block {number}", "exec")
    with beside(replaced(command, ports)) if command else nullcontext():
        exec(code, {"__name__": "example"})
    if fence.after is not None:
        output = capsys.readouterr().out
        assert said(fence.after.strip(), output), output


def steps(text: str) -> Iterator[tuple[str, str]]:
    """(command, what it is said to print) of a console block."""
    for part in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]:
        command, _, printed = part.partition("\n")
        while command.endswith("\\"):
            more, _, printed = printed.partition("\n")
            command = f"{command[:-1].rstrip()} {more.strip()}"
        yield command, printed.strip()


def said(printed: str, output: str) -> bool:
    """Whether ``output`` is what ``printed`` says, in which ``...`` stands for anything."""
    pattern = ".*?".join(map(re.escape, printed.split("...")))
    return re.fullmatch(pattern, output.strip(), re.DOTALL) is not None


def ports_to_use() -> dict[str, str]:
    """A port that nobody has for each of :data:`PORTS`."""
    return dict(zip(PORTS, map(str, free_ports(len(PORTS))), strict=True))


def replaced(text: str, words: dict[str, str]) -> str:
    return re.sub("|".join(rf"\b{word}\b" for word in words), lambda match: words[match[0]], text)


def opened(place: str) -> bool:
    """Whether a port, or a unix socket by its path, is there."""
    if not place.isdigit():
        return Path(place).exists()
    with socket.socket() as stream, socket.socket(type=socket.SOCK_DGRAM) as datagrams:
        stream.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            for sock in (stream, datagrams):
                sock.bind(("127.0.0.1", int(place)))
        except OSError:
            return True
    return False


@contextmanager
def beside(command: str) -> Iterator[None]:
    """``command`` runs meanwhile, and is interrupted at the end."""
    listens = re.findall(r"(?:read|--listen|--control) \S*?(\d{4,5}|\./\S+)\b", command)
    if run := re.match(r"dcon run --ini (\S+)", command):
        listens += re.findall(r"^listen = \S+:(\d+)$", Path(run[1]).read_text(encoding="utf-8"), re.MULTILINE)
    process = subprocess.Popen(
        f"exec {command}", shell=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        deadline = time.monotonic() + TIME_LIMIT_S
        while process.poll() is None and not all(map(opened, listens)) and time.monotonic() < deadline:
            time.sleep(0.1)
        yield
    finally:
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=TIME_LIMIT_S)
    assert process.returncode in (0, INCOMPLETE, INTERRUPTED), (command, output)


def run_examples(page: str, marker: str) -> None:
    """Each block by itself, with ports of its own."""
    for fence in fences(page):
        if fence.marker == marker:
            with Session(page) as session:
                session.run(fence)


class Session:
    """A shell in which blocks are typed, beside the files of the page; what runs in its background ends with it."""

    def __init__(self, page: str) -> None:
        self.page = page
        self.ports = ports_to_use()
        self._jobs: list[ExitStack] = []
        for fence in fences(page):
            if fence.marker.startswith(FILE):
                Path(fence.marker.removeprefix(FILE)).write_text(replaced(fence.text, self.ports), encoding="utf-8")

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        with ExitStack() as all_jobs:
            for job in self._jobs:
                all_jobs.enter_context(job)

    def run(self, fence: Fence) -> None:
        for shown, printed in steps(fence.text):
            command = replaced(shown, self.ports)
            if command.endswith(" &"):
                self._jobs.append(ExitStack())
                self._jobs[-1].enter_context(beside(command.removesuffix(" &")))
            elif number := re.fullmatch(r"kill %(\d)(?:; wait %\1)?", command):
                self._jobs[int(number[1]) - 1].close()
            else:
                self._say(shown, command, printed)

    def _say(self, shown: str, command: str, printed: str) -> None:
        """Run a command that ends; a look (``dcon ctl status``) again, until it sees what it is said to."""
        back = {free: port for port, free in self.ports.items()}
        if command.startswith("dcon ctl ") and "--to" not in command:  # the default is a port of PORTS
            command += f" --to 127.0.0.1:{self.ports['4790']}"
        deadline = time.monotonic() + TIME_LIMIT_S
        while True:
            done = subprocess.run(
                command, shell=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=TIME_LIMIT_S
            )
            output = replaced(done.stdout, back)
            is_so = said(printed, output)
            if is_so or not command.startswith("dcon ctl status") or time.monotonic() > deadline:
                break
            time.sleep(0.1)
        assert done.returncode in (0, INCOMPLETE), (shown, output)
        assert is_so, f"{self.page}: $ {shown}\n--- prints\n{output}--- is said to print\n{printed}"


RUN = [page for page in PAGES if any(fence.marker == "run" for fence in fences(page))]
RUN_SLOW = [page for page in PAGES if any(fence.marker == "run: slow" for fence in fences(page))]
RUN_LIVE = [page for page in PAGES if any(fence.marker == "run: live" for fence in fences(page))]
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


@pytest.mark.skipif(sys.platform != "linux", reason="dcon run needs Linux")
@pytest.mark.realtime
@pytest.mark.alone
@pytest.mark.slow
@pytest.mark.parametrize("page", RUN_LIVE)
def test_live_examples_print_what_is_shown(page: str, folder: Path) -> None:
    with Session(page) as session:
        for fence in fences(page):
            if fence.marker == "run: live":
                session.run(fence)


def test_the_comparison_can_fail() -> None:
    assert said("a ... c\n...", "a b c\nd\ne\n")
    assert not said("a ... c", "a b d")
    assert not said("a", "a\nb")


# --- command lines -----------------------------------------------------------------------------------------------

GROUPS = {"pmu": pmu, "dcon": dcon}
ALIASES = {
    "stream-player": ("pmu", "play"),
    "stream-reader": ("pmu", "read"),
    "network-characterizer": ("pmu", "characterize"),
}
OTHERS = frozenset(
    (
        *("python", "python3", "head", "nc", "printf", "kill", "wait", "cat", "install", "cp", "rm", "mkdir"),
        *("useradd", "usermod", "systemctl", "pip"),
    )
)
"""Programs of others that examples use."""
INSTALLED = "/opt/pmutools/bin/"
"""Where the commands are at a site."""


def subcommand(words: list[str]) -> click.Command:
    """The subcommand that ``words`` begin with; fails for one that there is not."""
    group = GROUPS[words[0]]()
    command = group.get_command(click.Context(group, info_name=words[0]), words[1])
    assert command is not None, " ".join(words[:2])
    return command


def parse(words: list[str]) -> None:
    """Let click read a command line, without running it; raises click.ClickException."""
    first, *rest = words = [words[0].removeprefix(INSTALLED), *words[1:]]
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
        if not ast.get_docstring(node)
    ]
    assert not bare


@pytest.mark.parametrize("package", EXPLAINED)
def test_modules_say_what_they_are(package: str) -> None:
    for path in sorted((ROOT / package).rglob("*.py")):
        assert ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))), path
