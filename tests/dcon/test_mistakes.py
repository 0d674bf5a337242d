"""Mistakes that a person makes with the controller's commands: one line each, and what to do about it."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.peers import free_port

from dcon.cli import dcon
from dcon.demo.conductor import _alone
from pmutools.cli.shell import run
from pmutools.errors import SourceError


@pytest.mark.parametrize(
    "words",
    [
        ["simulate", "cjb", "--delay", "nan"],
        ["simulate", "cjb", "--duration", "nan"],
        ["simulate", "cjb", "--gain", "inf"],
        ["demo", "--duration", "nan"],
        ["demo", "--gain", "nan"],
        ["platform", "--ini", "x.ini", "--duration", "nan"],
    ],
)
def test_no_number_is_a_usage_error(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(dcon(), words) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert words[-2] in told


def test_two_demos_do_not_share_a_folder(tmp_path: Path) -> None:
    with _alone(tmp_path), pytest.raises(SourceError, match="another demo is writing"), _alone(tmp_path):
        pass
    with _alone(tmp_path):
        pass


@pytest.mark.realtime
def test_a_controller_that_heard_nothing_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ini = tmp_path / "dcon.ini"
    sites = [("N1", "north", 101), ("S1", "south", 201)]
    ini.write_text(
        "\n".join(
            f"[pmu {name}]\nurl = udp://127.0.0.1:{free_port()}\nidcode = {idcode}\nside = {side}\n"
            for name, side, idcode in sites
        )
    )
    words = ["platform", "--ini", str(ini), "--log", str(tmp_path / "s.mcap"), "--duration", "0.5"]
    assert run(dcon(), words) == 1
    assert "no frame came from any PMU" in capsys.readouterr().err
    before = (tmp_path / "s.mcap").read_bytes()
    assert run(dcon(), words) == 1
    assert "s-2.mcap" in capsys.readouterr().err
    assert (tmp_path / "s.mcap").read_bytes() == before  # a session that is there already stays
