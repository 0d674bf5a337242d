"""Talk to a person who may not be there any more."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.parametrize("words", ["say('one')", "complain('one')"])
def test_work_goes_on_where_nobody_reads_what_is_said(words: str) -> None:
    code = (
        "import sys; from pmutools.cli.shell import Talk; talk = Talk(False, 0)\n"
        "sys.stdin.read()\n"
        f"for _ in range(3): talk.{words}\n"
        "print('done')"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        process.stderr.close()
        assert process.communicate("", timeout=20)[0] == "done\n"
    assert process.returncode == 0
