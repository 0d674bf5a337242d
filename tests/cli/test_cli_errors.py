"""A user's mistake is one line that names it and says what to do, with the right exit code; data are never at risk."""

from __future__ import annotations

import socket
import subprocess
from pathlib import Path

import pytest
from support.commands import Pmu, command, run_pmu

NOWHERE = "udp://127.0.0.1:9"


@pytest.fixture(autouse=True)
def in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, synthetic: Path) -> None:
    """Each test runs in a folder of its own with the usual suspects in it."""
    monkeypatch.chdir(tmp_path)
    Path("good.pcap").write_bytes(synthetic.read_bytes())
    Path("empty.pcap").write_bytes(b"")
    Path("text.txt").write_text("hello\n")
    Path("noise.c37118").write_bytes(bytes(range(256)) * 8)
    Path("table.csv").write_text("a,b\n1,2\n")
    Path("folder").mkdir()


MISTAKES = [
    # a file
    ("info missing.pcap", 1, "missing.pcap: No such file or directory; check the path"),
    ("dump missing.pcap", 1, "missing.pcap: No such file or directory"),
    ("convert missing.pcap out.csv", 1, "missing.pcap: No such file or directory"),
    (f"play missing.pcap --to {NOWHERE}", 1, "missing.pcap: No such file or directory"),
    ("info empty.pcap", 1, "empty.pcap is empty; record it again"),
    ("info folder", 1, "folder is a folder without recordings; name a file"),
    ("info text.txt", 2, "text.txt is of no known format; known are .pcap"),
    ("info noise.c37118", 1, "noise.c37118: no C37.118 frames found in 2048 bytes"),
    ("dump noise.c37118", 1, "noise.c37118: no C37.118 frames found"),
    ("convert noise.c37118 out.csv", 1, "no data frames in noise.c37118"),
    (f"play noise.c37118 --to {NOWHERE}", 1, "no data frames to play"),
    ("info table.csv", 1, "table.csv"),
    # an output
    ("convert good.pcap out.xyz", 2, "out.xyz: its suffix is not one of .pcap"),
    ("convert good.pcap folder", 2, "folder: its suffix is not one of"),
    ("convert good.pcap nodir/out.csv", 1, "nodir/out.csv: No such file or directory; check the folder"),
    ("convert good.pcap out.parquet.gz", 2, "leave out .gz"),
    ("convert good.pcap good.pcap", 2, "good.pcap is an input, and would be overwritten"),
    ("convert good.pcap ./folder/../good.pcap", 2, "is an input, and would be overwritten"),
    (f"play good.pcap --to {NOWHERE} --ledger good.pcap", 2, "good.pcap is an input"),
    (f"play good.pcap --to {NOWHERE} --ledger nodir/x.parquet -q", 1, "nodir/x.parquet: No such file or directory"),
    ("synth out.xyz", 2, "out.xyz: its suffix is not one of"),
    ("read udp://127.0.0.1:0 --out nodir/out.csv --duration 1", 1, "nodir/out.csv: No such file or directory"),
    ("read udp://127.0.0.1:0 --out out.xyz --duration 1", 2, "out.xyz: its suffix is not one of"),
    ("read udp://127.0.0.1:0 --duration 1", 2, "--out"),
    # an address
    ("play good.pcap", 2, "where to? give --to udp://HOST:PORT or --listen tcp://HOST:PORT"),
    ("play good.pcap --to tcp://127.0.0.1:4712", 2, "give --listen tcp://127.0.0.1:4712"),
    ("play good.pcap --listen udp://127.0.0.1:4712", 2, "udp:// knows no commands; give --to, or udp+cmd://"),
    ("play good.pcap --to 127.0.0.1:4712", 2, "no endpoint URL; write tcp://127.0.0.1:4712"),
    ("play good.pcap --to foo://127.0.0.1:4712", 2, "unknown scheme 'foo'; use one of udp://"),
    ("play good.pcap --to udp://127.0.0.1", 2, "no port; C37.118 customarily has udp://127.0.0.1:4713"),
    ("play good.pcap --to udp://127.0.0.1:99999", 2, "ports are 0..65535"),
    ("play good.pcap --to udp://127.0.0.1:1?idcod=5", 2, "is 'idcode' meant?"),
    ("play good.pcap --to udp://127.0.0.1:1?idcode=5", 2, "no stream of IDCODE 5; there are "),
    ("play good.pcap --to udp://no.such.host.invalid:1", 1, "unknown host 'no.such.host.invalid'"),
    ("read foo --out x.csv", 2, "no endpoint URL"),
    ("dump udp://127.0.0.1", 2, "no port"),
    ("info tcp+udp://127.0.0.1:4712", 2, "add ?data=PORT"),
    # a value
    (f"play good.pcap --to {NOWHERE} --speed 0", 2, "'--speed': 0 is out of range"),
    (f"play good.pcap --to {NOWHERE} --speed nan", 2, "'--speed': 'nan' is not a finite number"),
    (f"play good.pcap --to {NOWHERE} --speed 1e999999999", 2, "'--speed'"),
    (f"play good.pcap --to {NOWHERE} --interval -5", 2, "'--interval': -5 is out of range"),
    (f"play good.pcap --to {NOWHERE} --cfg-period inf", 2, "'--cfg-period': 'inf' is not"),
    (f"play good.pcap --to {NOWHERE} --fps 0", 2, "'--fps': 0 is out of range"),
    (f"play good.pcap --to {NOWHERE} --loop -1", 2, "'--loop'"),
    (f"play good.pcap --to {NOWHERE} --stamp never", 2, "'--stamp': 'never' is not one of 'shift', 'keep'"),
    (f"play good.pcap --to {NOWHERE} --start yesterday", 2, "'--start': 'yesterday' is no time; write seconds"),
    (f"play good.pcap --to {NOWHERE} --start 100", 1, "nothing is left to play; widen --start and --end"),
    (f"play good.pcap --to {NOWHERE} --select N9", 2, "--select N9: no such stream; there are "),
    (f"play good.pcap --to {NOWHERE} --fps 30 --interval 10", 2, "--fps and --interval clash"),
    (f"play good.pcap --to {NOWHERE} --fps 30 --stamp keep", 2, "--stamp keep keeps the old: leave one out"),
    (f"play good.pcap --to {NOWHERE} --loss 7", 2, "--loss: 7 is not a probability; did you mean 7%?"),
    (f"play good.pcap --to {NOWHERE} --drop every", 2, "--drop"),
    (f"play good.pcap --to {NOWHERE} --delay banana(3)", 2, "--delay"),
    (
        f"play good.pcap --to {NOWHERE} --impair nowhere.ini",
        2,
        "nowhere.ini: neither a file nor a ready profile; known: table1",
    ),
    (f"play good.pcap --to {NOWHERE} --seed x", 2, "'--seed': 'x' is not a whole number"),
    ("info good.pcap --duration 0", 2, "'--duration': 0 is out of range"),
    ("info good.pcap --duration soon", 2, "'--duration': 'soon' is not a number"),
    ("dump good.pcap --type cfg4", 2, "'--type': 'cfg4' is not one of 'data'"),
    ("convert good.pcap out.csv --idcode x", 2, "'--idcode': 'x' is not a whole number"),
    ("convert good.pcap out.csv --idcode 70000", 2, "'--idcode': 70000 is out of range"),
    ("convert good.pcap out.csv --start 1e6", 1, "no data frames in good.pcap within what was asked for"),
    ("convert good.pcap out.csv --phasors square", 2, "'--phasors'"),
    ("synth out.pcap --scenario nonesuch", 2, "no scenario 'nonesuch': one of cjb"),
    ("synth out.pcap --plant nonesuch", 2, "no plant 'nonesuch': one of modal"),
    ("synth out.pcap --pmus 0", 2, "'--pmus'"),
    ("synth out.pcap --rate 0", 2, "'--rate'"),
    ("synth out.pcap --pdc 1 --pmus 150", 2, "--pdc: at most 100 PMUs"),
    ("synth out.pcap --duration nan", 2, "'--duration'"),
    # a word
    ("inf good.pcap", 2, "no command 'inf'; did you mean 'info'?"),
    ("info good.pcap --jsn", 2, "--jsn"),
    ("info", 2, "TARGET"),
    ("convert good.pcap", 2, "(pmu convert --help lists all)"),
]


@pytest.mark.parametrize(("line", "code", "words"), MISTAKES, ids=[line for line, *_ in MISTAKES])
def test_a_mistake_is_one_line_that_says_what_to_do(pmu: Pmu, line: str, code: int, words: str) -> None:
    before = Path("good.pcap").read_bytes()
    result = pmu(*line.split())
    assert result.code == code, result.err
    assert words in result.complaint
    assert result.complaint.startswith("pmu")
    assert result.out == ""
    assert Path("good.pcap").read_bytes() == before, "no input is touched"


def test_a_failed_conversion_leaves_no_file_behind(pmu: Pmu) -> None:
    for suffix in ("csv", "parquet", "arrow"):
        assert pmu("convert", "good.pcap", f"out.{suffix}", "--start", "1e6").code == 1
        assert not Path(f"out.{suffix}").exists()


@pytest.mark.parametrize("kind", ["udp", "tcp"])
def test_a_port_in_use_is_named_with_a_remedy(pmu: Pmu, kind: str) -> None:
    datagram = kind == "udp"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM if datagram else socket.SOCK_STREAM) as taken:
        taken.bind(("127.0.0.1", 0))
        if not datagram:
            taken.listen()
        port = taken.getsockname()[1]
        where = f"{kind}://127.0.0.1:{port}"
        arguments = ["read", where, "--out", "x.csv"] if datagram else ["play", "good.pcap", "--listen", where]
        result = pmu(*arguments)
    assert result.code == 1
    assert (
        result.complaint
        == f"pmu: {where}: already in use; stop the other program that has this port, or choose another"
    )


def test_two_streams_of_one_idcode_cannot_be_listened_to(pmu: Pmu) -> None:
    for name in ("one.csv", "two.csv"):
        assert pmu("convert", "good.pcap", name, "--idcode", 101).code == 0
    for where in (("--listen", "tcp://127.0.0.1:0"), ("--to", "udp://127.0.0.1:9")):
        result = pmu("play", "one.csv", "two.csv", *where)
        assert result.code == 2
        assert "N1 and N1#2 both have IDCODE 101; choose one with --select" in result.complaint
        assert "--idcode 'N1#2=N'" in result.complaint
    mended = pmu("play", "one.csv", "two.csv", "--to", "udp://127.0.0.1:9", "--idcode", "N1#2=501", "--end", 0.1)
    assert mended.code == 0
    result = pmu("play", "one.csv", "--to", "udp://127.0.0.1:9", "--idcode", "N9=5")
    assert result.code == 2
    assert "--idcode N9=5: no such stream; there are N1" in result.complaint


def test_a_time_that_is_past_is_none_to_begin_at(pmu: Pmu) -> None:
    result = pmu("play", "good.pcap", "--to", "udp://127.0.0.1:9", "--at", "2001-01-01T00:00:00Z")
    assert result.code == 2
    assert "--at 2001-01-01T00:00:00.000000000Z is past" in result.complaint


def test_a_capture_of_something_else_holds_no_frames(pmu: Pmu, foreign: Path) -> None:
    for words in (("info",), ("dump",)):
        result = pmu(*words, foreign)
        assert result.code == 1
        assert "no C37.118 frames" in result.complaint
    assert pmu("convert", foreign, "out.csv").code == 1


@pytest.mark.parametrize("quiet", [(), ("--quiet",)])
def test_errors_are_told_with_quiet_too(pmu: Pmu, quiet: tuple[str, ...]) -> None:
    assert pmu("info", "missing.pcap", *quiet).complaint
    assert pmu("dump", "noise.c37118", *quiet).complaint
    assert pmu("convert", "good.pcap", "out.csv", "--start", "1e6", *quiet).complaint


@pytest.mark.parametrize(
    ("arguments", "code"), [(("info", "missing.pcap"), 1), (("synth", "x.xyz"), 2), (("dump",), 2)]
)
def test_debug_shows_where_and_changes_nothing_else(pmu: Pmu, arguments: tuple[str, ...], code: int) -> None:
    plain, debug = pmu(*arguments), pmu(*arguments, "--debug")
    assert (plain.code, debug.code) == (code, code)
    assert "Traceback" not in plain.err
    assert "Traceback (most recent call last)" in debug.err
    assert debug.err.endswith(plain.err)


def test_an_unforeseen_error_is_one_line_too(pmu: Pmu, monkeypatch: pytest.MonkeyPatch) -> None:
    import pmutools.tools.inventory

    def broken(*arguments: object) -> None:
        raise ZeroDivisionError("two\nlines")

    monkeypatch.setattr(pmutools.tools.inventory, "take_inventory", broken)
    result = pmu("info", "good.pcap")
    assert result.code == 1
    assert result.complaint == "pmu: internal error: ZeroDivisionError: two lines (--debug shows where)"


@pytest.mark.parametrize(
    "arguments", ["dump good.pcap", "dump good.pcap --json", "info good.pcap", "convert good.pcap - --idcode 101"]
)
def test_a_reader_who_has_seen_enough_is_no_error(arguments: str) -> None:
    with subprocess.Popen(
        command(*arguments.split()), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.read(10)
        process.stdout.close()
        complaints = process.stderr.read()
        assert process.wait(30) == 0
    assert "Traceback" not in complaints
    assert "roken" not in complaints


@pytest.mark.parametrize(
    "arguments", ["dump good.pcap", "info good.pcap --json", "convert good.pcap full.csv --idcode 101"]
)
def test_a_full_disk_is_one_line(arguments: str) -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("needs /dev/full")
    Path("full.csv").symlink_to(full)
    with full.open("w") as out:
        done = subprocess.run(
            command(*arguments.split()), stdout=out, stderr=subprocess.PIPE, text=True, timeout=60, check=False
        )
    assert done.returncode == 1
    assert "No space left on device" in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_name_that_the_terminal_cannot_show_is_no_error(tmp_path: Path) -> None:
    from support.playing import recording, stream
    from support.recordings import write

    write(tmp_path / "named.c37118", recording(stream(name="Δf 変 \x1b[31m\n"), 3))
    for arguments in (("dump", "named.c37118"), ("info", "named.c37118")):
        result = run_pmu(*arguments, env={"PYTHONIOENCODING": "ascii"})
        assert (result.code, result.err) == (0, "")
        assert "\x1b" not in result.out
    assert run_pmu("dump", "named.c37118").out.count("\n") == 4
