"""Programs are asked for a bounded time and a bounded answer, whatever they do."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from pmutools.clocksources.asking import ANSWER_BYTES, NoAnswer, Patience, ask, find, shortened

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(os.name != "posix", reason="such programs are POSIX's"),
]


def sh(script: str) -> list[str]:
    return ["/bin/sh", "-c", script]


def test_an_answer_in_english_with_its_errors() -> None:
    assert ask(sh('echo "$LC_ALL"; echo wrong >&2; exit 3'), Patience(5)) == "C\nwrong\n"
    assert ask(sh("printf '\\377x'"), Patience(5)) == "\ufffdx"
    assert ask(sh("read line && echo $line"), Patience(5)) == "", "it has nothing to read from"


def test_an_answer_is_bounded() -> None:
    assert len(ask(sh(f"head -c {5 * ANSWER_BYTES} /dev/zero"), Patience(5))) == ANSWER_BYTES


@pytest.mark.parametrize("script", ["sleep 60", "sleep 60 & echo begun; sleep 60", "trap '' TERM INT; sleep 60", "yes"])
def test_who_does_not_end_is_ended_with_all_it_started(script: str, tmp_path: Path) -> None:
    began = time.monotonic()
    with pytest.raises(NoAnswer, match="sh does not answer in time"):
        ask(sh(f"echo $$ > {tmp_path}/pid; {script}"), Patience(0.3))
    assert time.monotonic() - began < 3
    group = int((tmp_path / "pid").read_text())
    deadline = time.monotonic() + 5
    while group_is_alive(group):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def group_is_alive(group: int) -> bool:
    listed = subprocess.run(["ps", "-eo", "pgid=,stat="], capture_output=True, text=True, check=False).stdout
    return any(int(row[0]) == group and row[1][0] != "Z" for row in map(str.split, listed.splitlines()))


def test_who_closes_its_output_and_stays_is_ended_too() -> None:
    with pytest.raises(NoAnswer, match="in time"):
        ask(sh("exec >&- 2>&-; sleep 60"), Patience(0.3))


def test_nobody_waits_for_an_answer_that_is_no_longer_wanted() -> None:
    stopped = threading.Event()
    threading.Timer(0.2, stopped.set).start()
    began = time.monotonic()
    with pytest.raises(NoAnswer):
        ask(sh("sleep 60"), Patience(30, stopped))
    assert time.monotonic() - began < 5


def test_what_cannot_be_run() -> None:
    with pytest.raises(NoAnswer, match="nothing-there cannot be run: No such file"):
        ask(["/nothing-there"], Patience(1))


def test_programs_are_found_where_only_root_looks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent))
    assert find("no-such-program") is None
    program = tmp_path / "some-daemon"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    monkeypatch.setattr("pmutools.clocksources.asking.SYSTEM_PATHS", (str(tmp_path),))
    assert find("some-daemon") == str(program)


def test_a_long_answer_is_told_by_its_beginning() -> None:
    assert shortened("a\n b\t c") == "a b c"
    assert shortened("x" * 1000, 10) == "xxxxxxxxx…"
