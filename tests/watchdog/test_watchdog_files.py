"""Input lines, relays and the log as files."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import pytest

from dcon.watchdog.files import Lines, contact, read_line, released, write_line
from dcon.watchdog.memory import Contact, Driven, Inputs
from dcon.watchdog.report import QUEUED, Report

CONTENTS: dict[bytes, tuple[bool, Contact]] = {
    b"1": (True, Contact.CLOSED),
    b"1\n": (True, Contact.CLOSED),
    b"0": (False, Contact.OPEN),
    b"0\n": (False, Contact.OPEN),
    b"": (False, Contact.UNKNOWN),
    b"\n": (False, Contact.UNKNOWN),
    b"1\n\n": (False, Contact.UNKNOWN),
    b" 1": (False, Contact.UNKNOWN),
    b"11": (False, Contact.UNKNOWN),
    b"1\0": (False, Contact.UNKNOWN),
    b"1" * 99: (False, Contact.UNKNOWN),
    b"released": (False, Contact.UNKNOWN),
    b"\xff": (False, Contact.UNKNOWN),
}


@pytest.mark.parametrize("content", CONTENTS, ids=repr)
def test_a_line_is_released_only_by_a_single_1(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "line"
    path.write_bytes(content)
    assert (released(str(path)), contact(str(path))) == CONTENTS[content]


def test_a_line_that_cannot_be_read_is_pressed(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")  # nobody writes: opening it does not wait
    for name in ("missing", "folder", "pipe"):
        assert read_line(str(tmp_path / name)) == b""
        assert released(str(tmp_path / name)) is False and contact(str(tmp_path / name)) is Contact.UNKNOWN


def test_a_line_that_is_not_fitted_is_none() -> None:
    assert Lines().read() == Inputs(None, None, None, None)
    assert Lines().drive(True, True, 0) == Driven(True)


def test_all_lines_are_read_from_their_files(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a", "b", "c", "d")]
    for path, text in zip(paths, ("1", "0", "0", "1"), strict=True):
        path.write_text(text)
    assert Lines(*map(str, paths)).read() == Inputs(True, False, Contact.OPEN, Contact.CLOSED)


def test_relays_are_driven_apart_and_by_level(tmp_path: Path) -> None:
    a, b = tmp_path / "a", tmp_path / "b"
    a.write_text("x\n")
    b.write_text("x\n")
    lines = Lines(relay_a=str(a), relay_b=str(b))
    for closed_a in (True, False):
        for closed_b in (True, False):
            for tick in range(3):
                assert lines.drive(closed_a, closed_b, tick) == Driven(True)
                assert (a.read_text(), b.read_text()) == (f"{closed_a:d}\n", f"{closed_b:d}\n")


def test_a_pulse_turns_each_tick_while_closed_and_never_while_open(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_text("0\n")
    lines = Lines(relay_a=str(path), pulse=True)
    seen = []
    for closed in (True, False):
        for tick in range(4):
            lines.drive(closed, closed, tick)
            seen.append(path.read_text().strip())
    assert seen == ["0", "1", "0", "1", "0", "0", "0", "0"]


def test_a_relay_that_cannot_be_driven_is_told_and_the_other_is_driven(tmp_path: Path) -> None:
    path = tmp_path / "b"
    path.write_text("0\n")
    assert not write_line(str(tmp_path / "missing"), True)
    assert not (tmp_path / "missing").exists()
    lines = Lines(relay_a=str(tmp_path / "missing"), relay_b=str(path))
    assert lines.drive(True, True, 1) == Driven(False) and path.read_text() == "1\n"


# --- the log -----------------------------------------------------------------------------------------------------


def lines_of(path: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_lines_are_json_and_a_log_goes_on_where_it_was(tmp_path: Path) -> None:
    path = tmp_path / "w.log"
    for number in (1, 2):
        report = Report(str(path))
        report.line(event="trip", number=number)
        report.close(5.0)
    assert [(line["event"], line["number"]) for line in lines_of(path)] == [("trip", 1), ("trip", 2)]
    assert all(str(line["utc"]).endswith("Z") for line in lines_of(path))


def test_a_log_has_a_bound(tmp_path: Path) -> None:
    path, old = tmp_path / "w.log", tmp_path / "w.log.1"
    report = Report(str(path), max_bytes=1000)
    for number in range(60):
        report.line(number=number, text="x" * 60)
    report.close(5.0)
    assert path.stat().st_size <= 1000 and old.stat().st_size <= 1000
    kept = [line["number"] for line in (*lines_of(old), *lines_of(path))]
    assert kept == list(range(60))[-len(kept) :] and len(kept) > 10


def test_what_finds_no_room_is_counted_and_told(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    report = Report(str(pipe))
    begun = time.monotonic()
    for number in range(2000):
        report.line(number=number, text="x" * 200)
    assert time.monotonic() - begun < 5 and report.dropped >= 2000 - QUEUED - 400
    told = []
    os.set_blocking(reader, True)
    rest = b""
    while len(told) < 2000 - report.dropped:
        *whole, rest = (rest + os.read(reader, 1 << 16)).split(b"\n")
        told += [json.loads(line) for line in whole]
    dropped = report.dropped
    report.line(event="after")
    report.close(5.0)
    last = json.loads((rest + os.read(reader, 1 << 16)).splitlines()[-1])
    os.close(reader)
    assert (last["event"], last["dropped"]) == ("after", dropped)


def test_a_log_that_cannot_be_opened(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Report(str(tmp_path / "no" / "x.log"))
