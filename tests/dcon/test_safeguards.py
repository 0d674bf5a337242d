"""Settings that make two safeguards one are refused, and a safeguard that one failure defeats is told."""

from __future__ import annotations

from pathlib import Path

import pytest

from dcon.cli import dcon
from dcon.effective import warnings_of
from dcon.settings import load, parse
from pmutools.cli.shell import run
from pmutools.errors import SettingsError

PMUS = (
    "[pmu N1]\nurl = udp://0.0.0.0:7001?source=192.0.2.11\nside = north\n"
    "[pmu S1]\nurl = tcp+udp://h:1?data=7002\nside = south\n"
)
LINE = "[pdci]\nurl = udp://127.0.0.1:7003\n"
ONE = "is the file of [watchdog]"
MISTAKES = {
    "one relay twice": ("[watchdog]", "relay_a = r\nrelay_b = ./x/../r", f"relay_b: ./x/../r: {ONE} relay_a"),
    "by a link": ("[watchdog]", "relay_a = there\nrelay_b = link", f"relay_b: link: {ONE} relay_a"),
    "by a hard link": ("[watchdog]", "estop_a = there\nestop_b = hard", f"estop_b: hard: {ONE} estop_a"),
    "a contact of two": ("[watchdog]", "contact_a = c\ncontact_b = c", f"contact_b: c: {ONE} contact_a"),
    "a contact that is a relay": ("[watchdog]", "relay_a = r\ncontact_a = r", f"contact_a: r: {ONE} relay_a"),
    "a stop that is a relay": ("[watchdog]", "estop_b = r\nrelay_a = r", f"relay_a: r: {ONE} estop_b"),
    "a stop that is a contact": ("[watchdog]", "estop_a = r\ncontact_b = r", f"contact_b: r: {ONE} estop_a"),
    "two logs": ("[watchdog]", "log = l\n[log]\npath = l", f"path: l: {ONE} log"),
    "the default log": ("[watchdog]", "log = session.mcap", f"log: path = session.mcap: {ONE} log"),
    "a relay that is read": ("[watchdog]", "relay_a = dcon.ini", "relay_a: dcon.ini is the initialisation file"),
    "out of the folder": ("[watchdog]", "status = control.in,../x", "status: ../x: is no plain name"),
    "the folder itself": ("[watchdog]", "status = ..", "status: ..: is no plain name"),
    "its own place": (
        "[watchdog]",
        "status = control.in,watchdog.in",
        "status: watchdog.in: something else is awaited",
    ),
    "datagrams read back": (
        "[watchdog]",
        "readback = required\n[output]\nurl = udp://192.0.2.1:5",
        "readback: required: [output] url = udp://192.0.2.1:5 reads nothing back",
    ),
    "a DAC alone": (
        "[watchdog]",
        "readback = required\n[output]\nurl = iio:///x",
        "readback: required: [output] url = iio:///x?",
    ),
    "commands to a PMU": ("[output]", "url = udp://127.0.0.1:7001", "url: udp://127.0.0.1:7001: there N1 is awaited"),
    "to its data": ("[output]", "url = udp://localhost:7002", "url: udp://localhost:7002: there S1 is awaited"),
    "to the line": (
        "[output]",
        "url = udp://127.0.0.1:7003\n[pdci]\nurl = udp://127.0.0.1:7003",
        "url: udp://127.0.0.1:7003: there the line's status is awaited",
    ),
    "the line at a PMU's port": (
        "[pdci]",
        "url = udp://0.0.0.0:7001",
        "url: udp://0.0.0.0:7001: there N1 is awaited; the line's status needs a port of its own",
    ),
    "at one of its addresses": (
        "[pdci]",
        "url = udp://localhost:7001?source=192.0.2.7",
        "url: udp://localhost:7001?source=192.0.2.7: there N1 is awaited; the line's",
    ),
    "at the port of a PMU's data": (
        "[pdci]",
        "url = udp://127.0.0.1:7002",
        "url: udp://127.0.0.1:7002: there S1 is awaited",
    ),
    "a device that is asked too rarely": (
        "[pdci]",
        "url = modbus://h?period_ms=2000",
        "url: status_age_s = 2: must be above period_ms = 2000 of url",
    ),
    "no rating": ("[pdci]", "rating_ns_mw = 0", "rating_ns_mw: 0: must be above minimum_mw = 310"),
}
"""(section, its keys, what is said after the place)."""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("there").write_text("1")
    Path("link").symlink_to("there")
    Path("hard").hardlink_to("there")
    return tmp_path


@pytest.mark.parametrize(("section", "keys", "message"), MISTAKES.values(), ids=MISTAKES)
def test_what_defeats_a_safeguard_is_refused(
    section: str, keys: str, message: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("dcon.ini").write_text(text := f"{PMUS}{section}\n{keys}\n")
    assert run(dcon(), ["check", "--ini", "dcon.ini"]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and err.startswith("dcon: dcon.ini:") and message in err
    if "relay_a = dcon.ini" not in keys:
        parse(text, "a log")  # what was recorded is replayed


@pytest.mark.parametrize(
    "text",
    [
        "relay_a = there\nrelay_b = other\nestop_a = e\nestop_b = f\ncontact_a = g\ncontact_b = h\ndrive = pulse\n"
        + LINE,
        "readback = required\n[output]\nurl = modbus://192.0.2.1\n" + LINE,
        "readback = required\n[output]\nurl = iio:///x?readback=0\n" + LINE,
        "[output]\nurl = udp://192.0.2.1:7001\n" + LINE,
        "[output]\nurl = udp://127.0.0.1:7004\n" + LINE,
        "[pdci]\nurl = udp://0.0.0.0:7003?source=192.0.2.1",
        "[pdci]\nurl = modbus://192.0.2.1",
        "[pdci]\nurl = udp://[::1]:7001",
        "[pmu N2]\nurl = udp://127.0.0.1:7004\nside = north\n[pdci]\nurl = udp://127.0.0.2:7004?source=127.0.0.3",
        "[platform]\ntime_source = none\n" + LINE,
        "beats = control,udp,parse,gps,gui,pdci,server\nstatus = control.in,mine\n" + LINE,
    ],
)
def test_what_is_safe_is_said_nothing_of(text: str, folder: Path) -> None:
    Path("dcon.ini").write_text(f"{PMUS}[watchdog]\n{text}\n")
    assert warnings_of(load("dcon.ini")) == []


@pytest.mark.parametrize(
    ("text", "warned"),
    [
        ("estop_b = e\n" + LINE, "[watchdog] estop_a is not set: there is only one line"),
        ("relay_a = r\ndrive = pulse\n" + LINE, "[watchdog] relay_b is not set: there is only one relay"),
        ("relay_a = r\nrelay_b = s\n" + LINE, "[watchdog] drive = level: closed relays stay closed"),
        ("contact_b = r\n" + LINE, "[watchdog] contact_b: relay_b is not set"),
        ("beats = gui,gps,pdci\n" + LINE, "[watchdog] beats: without control, udp, parse, which may then never beat"),
        ("status = status.in\n" + LINE, "[watchdog] status lacks control.in: the controller does not hear it"),
        ("[pdci]\nurl = udp://0.0.0.0:7003", "[pdci] url = udp://0.0.0.0:7003: whoever reaches that port"),
        ("[pdci]", "[pdci] url is not set: nobody tells the line's status, so nothing can be armed"),
        ("[pdci]\nrequired = no", "[pdci] required = no: arms without knowing"),
        (
            "[platform]\ngps_required = yes\ntime_source = none\n" + LINE,
            "[platform] gps_required = yes with time_source = none: the lock is never known",
        ),
        (
            "[pmu N2]\nurl = udp://0.0.0.0:7005\nside = north\n" + LINE,
            "[pmu N2] url = udp://0.0.0.0:7005: whoever reaches that port may send its frames; add ?source=ADDRESS",
        ),
    ],
)
def test_what_one_failure_or_anybody_defeats_is_a_warning(
    text: str, warned: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("dcon.ini").write_text(f"{PMUS}[watchdog]\n{text}\n")
    assert run(dcon(), ["check", "--ini", "dcon.ini"]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"warning: {warned}")


def test_two_keys_that_clash_are_both_named(folder: Path) -> None:
    Path("dcon.ini").write_text(f"{PMUS}[watchdog]\nreadback = required\n[output]\nurl = udp://192.0.2.1:5\n")
    with pytest.raises(SettingsError, match=r"^dcon.ini:8: \[watchdog\] readback: .*\[output\] url"):
        load("dcon.ini")
