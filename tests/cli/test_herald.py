"""News on stderr: little at once, and no waiting for a terminal that is stopped or a pipe that nobody reads."""

from __future__ import annotations

import subprocess
import sys

import pytest

from pmutools.cli import herald
from pmutools.cli.herald import BURST, Herald
from pmutools.cli.shell import Talk

MANY = """
from pmutools.cli import herald
from pmutools.cli.shell import Talk
herald.BURST = 10**9
news = herald.Herald(Talk(False, 0))
for number in range(5000):
    news.say(f"client {number} connected, and so on and so on, some fifty bytes")
news.progress(lambda: 1 / 0)  # no terminal: nobody asks for it
print(news._unsaid, flush=True)
input()
news.say("the last one")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="pipes cannot be asked there")
def test_a_pipe_that_nobody_reads_costs_lines_and_no_time() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", MANY],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        bufsize=1,
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdin is not None
        unsaid = int(process.stdout.readline())  # it comes, though nobody has read a line
        told = [process.stderr.readline() for _ in range(5000 - unsaid)]
        process.stdin.write("go on\n")
        rest = process.stderr.read().splitlines()
    assert 100 < len(told) < 4900
    assert told[0] == "client 0 connected, and so on and so on, some fifty bytes\n"
    assert rest == [f"({unsaid} lines left out)", "the last one"]


def test_a_flood_of_news_is_a_burst_and_a_count(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = iter([0.0, *[0.0] * 1000, 60.0])
    monkeypatch.setattr(herald.time, "monotonic", lambda: next(now))
    news = Herald(Talk(quiet=False, verbose=0))
    for number in range(1000):
        news.say(f"line {number}")
    news.say("a minute later")
    lines = capsys.readouterr().err.splitlines()
    assert lines == [*(f"line {k}" for k in range(BURST)), f"({1000 - BURST} lines left out)", "a minute later"]
