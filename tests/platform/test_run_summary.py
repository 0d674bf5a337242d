"""What ``dcon run`` makes of what controllers and servers said of their sessions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from dcon.cli.run import _sessions_in, _summary
from dcon.server.state import State, save


def controller(session: int, unlogged: int, **more: Any) -> str:
    return json.dumps({"session": session, "unlogged_ticks": unlogged, **more})


def server(*parts: str, **lacking: int) -> str:
    by_session = {name.removeprefix("s"): ticks for name, ticks in lacking.items()}
    return json.dumps({"log_parts": parts, "unlogged_ticks": 0, "unlogged_by_session": by_session})


CASES: dict[str, tuple[list[str], list[str], int]] = {
    "nothing is missing": ([controller(1, 0)], [server()], 0),
    "the larger of what both know of a session": ([controller(1, 70)], [server(s1=100)], 100),
    "the controller alone": ([controller(1, 70)], [server()], 70),
    "an earlier session, its controller killed": (["", controller(2, 0)], [server(s1=100)], 100),
    "every session": (["", controller(2, 7), controller(3, 5)], [server(s1=100, s2=6, s3=9)], 116),
    "a server that was killed": ([controller(1, 70)], [""], 70),
    "servers one after another": ([controller(2, 0)], [server(s1=100), "", server(s1=100, s2=3)], 103),
    "a server whose memory was damaged": ([controller(2, 0)], [server(s1=100), server(s2=3)], 103),
    "sessions of an earlier run": ([controller(1, 0)], [server(s8=1000, s9=1000, s1=2)], 2),
    "half a word": (['{"session": 1, "unlog'], [server(s1=4)], 4),
    "no controller": ([], [server(s1=4)], 4),
}


@pytest.mark.parametrize(("controllers", "servers", "missing"), CASES.values(), ids=CASES)
def test_missing_ticks_of_all_sessions_are_counted_once(
    controllers: list[str], servers: list[str], missing: int
) -> None:
    said = {"platform": controllers, "server": servers}
    assert _summary(said, {8, 9})["unlogged_ticks"] == missing


def test_the_rest_is_of_the_last_controller_and_the_last_server() -> None:
    said = {
        "platform": [controller(1, 0, ticks=3), controller(2, 0, ticks=5)],
        "server": [server("a.mcap"), server("b.mcap", "b.part2.mcap")],
    }
    summary = _summary(said, ())
    assert (summary["ticks"], summary["session"], summary["log_parts"]) == (5, 2, ["b.mcap", "b.part2.mcap"])
    assert _summary({}, ()) == {"unlogged_ticks": 0, "log_parts": []}


def test_sessions_before_the_run_are_those_of_the_folder(tmp_path: Path) -> None:
    assert _sessions_in(tmp_path) == set()
    assert save(tmp_path, State(3, "key", "x.mcap", 7, unlogged=2, earlier=((1, 30), (2, 4))))
    assert _sessions_in(tmp_path) == {1, 2, 3}
