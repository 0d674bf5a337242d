"""The sample recordings are what their README says, and come out of the commands that it gives."""

from __future__ import annotations

import hashlib
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from pmutools.cli import pmu
from pmutools.cli.shell import run

CAPTURES = Path(__file__).parents[1] / "captures"
README = (CAPTURES / "README.md").read_text(encoding="utf-8")
LISTED = {
    name: (int(size.replace(",", "")), digest)
    for name, size, digest in re.findall(r"^\| \[(\S+)\]\(#\S+\) \| ([\d,]+) \| `([0-9a-f]{64})` \|$", README, re.M)
}
COMMANDS = {
    Path(words[2]).name: words[2:]
    for line in re.findall(r"^\$ (pmu synth .+)$", README, re.M)
    if (words := shlex.split(line))
}
SCRIPTED = {
    Path(words[2]).with_suffix(suffix).name: words[1:]
    for line in re.findall(r"^\$ (python .+\.cfg)$", README, re.M)
    if (words := shlex.split(line))
    for suffix in (".cfg", ".dat")
}
"""COMTRADE: a script writes two files."""
LIMIT_BYTES = 4 << 20


def test_every_file_is_listed_and_has_its_command() -> None:
    there = {path.name for path in CAPTURES.iterdir()} - {"README.md"}
    assert there == LISTED.keys() == COMMANDS.keys() | SCRIPTED.keys()
    assert sum(size for size, _ in LISTED.values()) < LIMIT_BYTES


@pytest.mark.parametrize("name", LISTED)
def test_the_file_is_the_one_listed(name: str) -> None:
    octets = (CAPTURES / name).read_bytes()
    assert (len(octets), hashlib.sha256(octets).hexdigest()) == LISTED[name]


def rebuilt(name: str, folder: Path) -> Path:
    """The recording made anew by the README's command."""
    output, *options = COMMANDS[name]
    assert Path(output).parent.name == "captures"
    assert run(pmu(), ["synth", str(folder / name), *options, "--quiet"]) == 0
    return folder / name


@pytest.mark.skipif(sys.platform != "linux", reason="the last bit of sin, cos and exp is the C library's")
@pytest.mark.parametrize("name", [name for name in COMMANDS if not name.endswith(".parquet")])
def test_the_command_makes_the_same_bytes(name: str, tmp_path: Path) -> None:
    assert rebuilt(name, tmp_path).read_bytes() == (CAPTURES / name).read_bytes()


@pytest.mark.skipif(sys.platform != "linux", reason="the last bit of cos is the C library's")
@pytest.mark.parametrize("name", SCRIPTED)
def test_the_script_makes_the_same_bytes(name: str, tmp_path: Path) -> None:
    script, output = SCRIPTED[name]
    folder = tmp_path / "captures"
    folder.mkdir()
    subprocess.run([sys.executable, str(CAPTURES.parent / script), output], cwd=tmp_path, check=True, timeout=60)
    assert (folder / name).read_bytes() == (CAPTURES / name).read_bytes()


@pytest.mark.parametrize("name", [name for name in LISTED if name.endswith(".parquet")])
def test_the_command_makes_the_same_table(name: str, tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    mine, listed = pq.read_table(rebuilt(name, tmp_path)), pq.read_table(CAPTURES / name)
    assert mine.schema.equals(listed.schema, check_metadata=True)
    assert mine.equals(listed)
