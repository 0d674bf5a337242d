"""What ``pmu read`` is told to do: fields, formats, files, triggers; and what does not go together."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.commands import Pmu, command, ended, started, wait_for_udp
from support.live import free_udp_port
from support.playing import recording, stream
from support.recordings import blocks_of, data_of

from pmutools.c37118 import Message
from pmutools.c37118.demux import Demux
from pmutools.flow import Chunk, Flow
from pmutools.formats import open_source
from pmutools.timebase import NS

pytestmark = pytest.mark.realtime
PATIENCE_S = 20.0


def frames_of(idcode: int, count: int, *, name: str | None = None, first_slot: int = 0) -> list[bytes]:
    messages = recording(stream(idcode, name=name), count, first_slot=first_slot)
    return [message.frame.data for message in messages]


def bound(port: int) -> bool:
    lines = Path("/proc/net/udp").read_text().splitlines()[1:]
    return any(line.split()[1].endswith(f":{port:04X}") for line in lines)


@contextmanager
def fed(*streams: list[bytes], then: Callable[[], None] | None = None) -> Iterator[int]:
    """A port; what is bound to it gets the streams, each from a socket of its own. ``then`` something is done."""
    if not Path("/proc/net/udp").exists():
        pytest.skip("needs /proc/net to see when a port is bound")
    port = free_udp_port()

    def feed() -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not bound(port):
            if time.monotonic() > deadline:
                return
            time.sleep(0.005)
        for frames in streams:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                sender.bind(("127.0.0.1", 0))
                for frame in frames:
                    sender.sendto(frame, ("127.0.0.1", port))
        if then is not None:
            then()

    thread = threading.Thread(target=feed)
    thread.start()
    yield port
    thread.join(PATIENCE_S)


def url(port: int) -> str:
    return f"udp://127.0.0.1:{port}"


def frames_in(path: Path) -> int:
    return sum(len(block.batch) for block in blocks_of(open_source(path)))


# --- fields


def test_columns_are_chosen_and_ordered(pmu: Pmu, tmp_path: Path) -> None:
    out = tmp_path / "log.csv"
    with fed(frames_of(7, 5)) as port:
        result = pmu("read", url(port), "--out", out, "--fields", "time,*.V1.*,PMU 7.freq_hz", "--duration", 0.5)
    assert result.code == 0, result.err
    lines = out.read_text().splitlines()
    assert lines[0] == "time,PMU 7.V1.mag,PMU 7.V1.deg,PMU 7.freq_hz"
    assert lines[2].startswith("2016-09-08T17:05:11.020000000Z,")
    assert lines[2].endswith(",60.001")


def test_a_field_that_there_is_not_is_one_line_with_the_nearest(pmu: Pmu, tmp_path: Path) -> None:
    with fed(frames_of(7, 5)) as port:
        where = f"{url(port)}?idcode=7"
        result = pmu("read", where, "--out", tmp_path / "log.csv", "--fields", "time,PMU 7.frq", "--duration", 20)
    assert result.code == 2
    assert "--fields: no column fits 'PMU 7.frq'; did you mean 'PMU 7.freq_hz'" in result.complaint
    assert "--list-fields prints all" in result.complaint


def test_the_columns_there_are(pmu: Pmu) -> None:
    with fed(frames_of(7, 5)) as port:
        result = pmu("read", f"{url(port)}?idcode=7", "--list-fields", "--duration", 20)
    assert result.code == 0, result.err
    lines = result.out.splitlines()
    assert lines[:2] == ["time_ns\tns", "arrival_ns\tns"]
    assert "PMU 7.freq_hz\tHz" in lines
    assert "PMU 7.V1.deg\tdeg" in lines
    with fed(frames_of(7, 5)) as port:
        result = pmu("read", f"{url(port)}?idcode=7", "--list-fields", "--phasors", "rect", "--json", "--duration", 20)
    assert {"name": "PMU 7.V1.re", "unit": "V"} in result.json


def test_streams_without_the_fields_are_left_out_and_that_is_said(pmu: Pmu, tmp_path: Path) -> None:
    with fed(frames_of(7, 5), frames_of(8, 5, name="OTHER")) as port:
        out = tmp_path / "log.csv"
        result = pmu("read", url(port), "--out", out, "--fields", "time,OTHER.freq_hz", "--duration", 4)
    assert result.code == 0, result.err
    assert "left out, as they have none of the fields: streams 7" in result.err
    assert out.read_text().startswith("time,OTHER.freq_hz\n")


def test_a_field_of_a_stream_that_never_came_is_no_mistake(pmu: Pmu, tmp_path: Path) -> None:
    """One of the two addresses stays silent: its columns are not known."""
    with fed(frames_of(7, 5)) as port:
        arguments = ("--fields", "time,PMU 7.freq_hz,GHOST.freq_hz", "--duration", 3)
        result = pmu("read", url(port), url(free_udp_port()), "--out", tmp_path / "log.csv", *arguments)
    assert result.code == 0, result.err
    assert "--fields: 'GHOST.freq_hz' has fitted no column of the streams that came" in result.err
    assert frames_in(tmp_path / "log.csv") == 5


# --- standard output


def of_csv(raw: bytes) -> int:
    lines = raw.decode().splitlines()
    assert lines[0].startswith("time,arrival_ns")
    return len(lines) - 1


def of_jsonl(raw: bytes) -> int:
    objects = [json.loads(line) for line in raw.splitlines()]
    assert objects[0]["type"] == "cfg2"
    assert objects[1]["stamp_source"] == "kernel"
    return sum(each["type"] == "data" for each in objects)


def of_arrow(raw: bytes) -> int:
    import pyarrow as pa

    return int(pa.ipc.open_stream(raw).read_all().num_rows)


def of_raw(raw: bytes) -> int:
    messages = [item for item in Demux().feed(Chunk(raw, None, Flow("file", "x"))) if isinstance(item, Message)]
    return len(data_of(messages))


def of_capture(raw: bytes, suffix: str = ".pcapng") -> int:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"x{suffix}"
        path.write_bytes(raw)
        return frames_in(path)


READERS: dict[str, Callable[[bytes], int]] = {
    "csv": of_csv,
    "jsonl": of_jsonl,
    "arrow": of_arrow,
    "raw": of_raw,
    "pcapng": of_capture,
    "pcap": lambda raw: of_capture(raw, ".pcap"),
}


@pytest.mark.parametrize("form", READERS)
def test_what_goes_to_standard_output_is_nothing_but_data(form: str, capfdbinary: pytest.CaptureFixture[bytes]) -> None:
    from pmutools.cli import pmu as group
    from pmutools.cli.shell import run

    with fed(frames_of(7, 20)) as port:
        code = run(group(), ["read", url(port), "--out", "-", "--format", form, "--duration", "0.5", "--json"])
    out, err = capfdbinary.readouterr()
    assert code == 0, err
    assert READERS[form](out) == 20
    assert b"20 frames of 1 streams" in err


# --- files


@pytest.mark.parametrize("suffix", [".pcapng", ".jsonl.gz", ".csv"])
def test_a_file_for_each_stream(suffix: str, pmu: Pmu, tmp_path: Path) -> None:
    with fed(frames_of(7, 10), frames_of(8, 20)) as port:
        result = pmu("read", url(port), "--out", tmp_path / f"log{suffix}", "--per-stream", "--duration", 0.5, "--json")
    assert result.code == 0, result.err
    names = {Path(path).name: frames_in(Path(path)) for path in result.json["paths"]}
    assert names == {f"PMU_7-7{suffix}": 10, f"PMU_8-8{suffix}": 20}


def test_streams_of_an_initialisation_file_have_its_names(pmu: Pmu, tmp_path: Path) -> None:
    with fed(frames_of(7, 10), frames_of(8, 20), frames_of(9, 30)) as port:
        ini = tmp_path / "sites.ini"
        ini.write_text(
            f"[pmu North/1]\nurl = {url(port)}\nidcode = 7\n[pmu S]\nurl = {url(port)}\nidcode = 8\n"
            "[controller]\ngain_mw_per_mhz = 9\n"
        )
        out = tmp_path / "log.parquet"
        result = pmu("read", "--ini", ini, "--out", out, "--duration", 0.5, "--json")
    assert result.code == 0, result.err
    assert sorted(path.name for path in (tmp_path / "log").iterdir()) == ["North_1.parquet", "S.parquet"]
    assert [each["frames"] for each in result.json["streams"]] == [10, 20]


def test_urls_and_an_initialisation_file_together(pmu: Pmu, tmp_path: Path) -> None:
    with fed(frames_of(7, 10)) as port, fed(frames_of(8, 10)) as other:
        ini = tmp_path / "sites.ini"
        ini.write_text(f"[pmu NORTH]\nurl = {url(port)}\n")
        result = pmu("read", url(other), "--ini", ini, "--out", tmp_path / "log.csv", "--duration", 1.5)
    assert result.code == 0, result.err
    assert sorted(path.name for path in (tmp_path / "log").iterdir()) == ["NORTH.csv", "PMU_8-8.csv"]


def test_numbered_files(pmu: Pmu, tmp_path: Path) -> None:
    """At least one boundary is within a run that takes longer than the span."""
    with fed(frames_of(7, 10), then=lambda: time.sleep(1.5)) as port:
        arguments = ("--out", tmp_path / "log.c37118", "--split", "100MB,1s", "--duration", 1.2, "--json")
        result = pmu("read", url(port), *arguments)
    assert result.code == 0, result.err
    paths = [Path(path) for path in result.json["paths"]]
    assert paths[0].name == "log-0001.c37118"
    assert sum(map(frames_in, paths)) == 10


# --- triggers


def test_an_excursion_is_recorded_with_what_came_before(pmu: Pmu, tmp_path: Path) -> None:
    """Frame k has k mHz above nominal."""
    with fed(frames_of(7, 100)) as port:
        arguments = ("--trigger", "freq>60.05,signal", "--ring", "10s", "--after", "200ms", "--duration", 1.5, "--json")
        result = pmu("read", url(port), "--out", tmp_path / "event.jsonl", *arguments)
    assert result.code == 0, result.err
    (path,) = map(Path, result.json["paths"])
    assert path.name == "event-20160908T170512.020Z.jsonl"
    assert frames_in(path) == 100
    assert "trigger freq>60.05: PMU 7 (stream 7) 60.051 Hz at 2016-09-08T17:05:12.020000000Z -> " in result.err
    assert f"kill -USR1 {os.getpid()} records" in result.err


def test_a_trigger_that_fits_nothing_is_told_in_the_end(pmu: Pmu, tmp_path: Path) -> None:
    with fed(frames_of(7, 10)) as port:
        arguments = ("--trigger", "Z9.freq>1,loss", "--duration", 0.5)
        result = pmu("read", url(port), "--out", tmp_path / "event.csv", *arguments)
    assert result.code == 0, result.err
    assert "--trigger: Z9.freq>1 has fitted no station or channel of the streams that came" in result.err
    assert "10 frames of 1 streams -> nothing written" in result.err
    assert list(tmp_path.iterdir()) == []


def test_a_signal_records(pmu: Pmu, tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGUSR1)

    def ask() -> None:
        deadline = time.monotonic() + PATIENCE_S
        while signal.getsignal(signal.SIGUSR1) is before:  # it would end this process
            if time.monotonic() > deadline:
                return
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGUSR1)

    with fed(frames_of(7, 30), then=ask) as port:
        result = pmu(
            "read", url(port), "--out", tmp_path / "event.csv", "--trigger", "signal", "--duration", 2, "--json"
        )
    assert result.code == 0, result.err
    (path,) = map(Path, result.json["paths"])
    assert frames_in(path) == 30
    assert "trigger signal: at " in result.err
    assert signal.getsignal(signal.SIGUSR1) is before


def test_a_key_records(tmp_path: Path) -> None:
    pty = pytest.importorskip("pty")
    port = free_udp_port()
    ours, theirs = pty.openpty()
    arguments = command("read", url(port), "--out", tmp_path / "event.csv", "--trigger", "key", "--ring", "60s")
    reader = subprocess.Popen(arguments, stdin=theirs, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        wait_for_udp(port, reader)
        assert reader.stderr is not None
        assert reader.stderr.readline() == "any key records\n"
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for frame in frames_of(7, 30):
                sender.sendto(frame, ("127.0.0.1", port))
        os.write(ours, b"x")
        assert select.select([reader.stderr], [], [], PATIENCE_S)[0]
        line = reader.stderr.readline()
        assert line.startswith("trigger key: at ")
        reader.send_signal(signal.SIGINT)
        assert ended(reader).code == 130
    finally:
        if reader.poll() is None:
            reader.kill()
        reader.communicate(timeout=PATIENCE_S)
        os.close(ours)
        os.close(theirs)
    (path,) = tmp_path.iterdir()
    assert frames_in(path) == 30


# --- the end


def test_the_summary_tells_each_stream(pmu: Pmu, tmp_path: Path) -> None:
    with fed(frames_of(7, 10), frames_of(8, 20)) as port:
        result = pmu("read", url(port), "--out", tmp_path / "log.mcap", "--duration", 0.5, "--json")
    assert result.code == 0, result.err
    told = result.json
    assert (told["frames"], told["skipped"], told["own_drops"]) == (30, {}, 0)
    assert [(each["name"], each["idcode"], each["frames"]) for each in told["streams"]] == [
        ("PMU 7", 7, 10),
        ("PMU 8", 8, 20),
    ]
    assert told["streams"][1]["last_time_ns"] - told["streams"][1]["first_time_ns"] == 19 * NS // 50
    assert told["paths"] == [str(tmp_path / "log.mcap")]


@pytest.mark.parametrize("quiet", [[], ["--quiet"]])
def test_the_summary_of_what_goes_to_standard_output_is_the_last_line_of_the_other(quiet: list[str]) -> None:
    port = free_udp_port()
    with started("read", url(port), "--out", "-", "--json", "--duration", 1.2, *quiet) as reader:
        wait_for_udp(port, reader)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for frame in frames_of(7, 10):
                sender.sendto(frame, ("127.0.0.1", port))
        result = ended(reader)
    assert result.code == 0
    assert len(result.out.splitlines()) == 11
    *talk, last = result.err.splitlines()
    assert bool(talk) == (not quiet)
    assert json.loads(last)["frames"] == 10


def test_sigterm_ends_as_an_interrupt_does(tmp_path: Path) -> None:
    port, out = free_udp_port(), tmp_path / "log.parquet"
    with started("read", url(port), "--out", out, "--quiet") as reader:
        wait_for_udp(port, reader)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for frame in frames_of(7, 30):
                sender.sendto(frame, ("127.0.0.1", port))
        reader.send_signal(signal.SIGTERM)
        result = ended(reader)
    assert (result.code, result.err) == (130, "")
    assert frames_in(out) == 30
    assert list(tmp_path.iterdir()) == [out]


# --- mistakes

U = "udp://127.0.0.1:0"
MISTAKES = [
    (f"read {U}", 2, "where to? give --out FILE"),
    ("read --out x.csv", 2, "what is to be read? give URLs"),
    (f"read {U} --out x.parquet --format csv", 2, "x.parquet as csv: its suffix says parquet"),
    (f"read {U} --out - --format parquet", 2, "'parquet' is not one of 'csv'"),
    (f"read {U} --out x.mcap --fields time", 2, "mcap holds whole frames; fields and long form are for"),
    (f"read {U} --out x.pcap --long", 2, "pcap holds whole frames"),
    (f"read {U} --out x.csv --fields a,,b", 2, "'--fields': 'a,,b' has an empty item"),
    *((f"read {U} --out x.{suffix} --phasors rect", 2, "one notation of phasors") for suffix in ("pcapng", "mcap")),
    (f"read {U} --out - --format raw --phasors rect", 2, "raw has one notation of phasors; to choose it is for"),
    (f"read {U} --out x.csv --split 5", 2, "'--split': '5' is not a size or a span of time; write as in 100MB or 1h"),
    (f"read {U} --out x.csv --split 5furlongs", 2, "(units: kB, MB, GB, TB, KiB, MiB, GiB, ms, s, min, h, d)"),
    (f"read {U} --out x.csv --split 0MB", 2, "0MB is nothing; it must be more than 0"),
    (f"read {U} --out x.csv --split 0h", 2, "0h is nothing; it must be more than 0"),
    *((f"read {U} --out x.csv --split {bad}", 2, f"'{bad}' is not a size or") for bad in ("0", "-1", "banana")),
    (f"read {U} --out - --split 1h", 2, "several files cannot go to standard output"),
    (f"read {U} --out - --trigger loss", 2, "several files cannot go to standard output"),
    (f"read {U} --out - --per-stream", 2, "several files cannot go to standard output"),
    (f"read {U} --out x.csv --split 1h --trigger loss", 2, "choose one"),
    (f"read {U} --out x.csv --per-stream --long", 2, "choose one"),
    (f"read {U} --out x.csv --keep 3", 2, "--keep counts files of --split or --trigger"),
    (f"read {U} --out x.csv --split 1h --keep 0", 2, "'--keep': 0 is out of range"),
    (f"read {U} --out x.csv --ring 10s", 2, "--ring and --after are for --trigger"),
    (f"read {U} --out x.csv --trigger freq=60", 2, "'--trigger': 'freq=60' is no trigger"),
    (f"read {U} --out x.csv --trigger stat:triger", 2, "did you mean 'trigger'?"),
    (f"read {U} --out x.csv --trigger loss --ring 10", 2, "'--ring': '10' is not a span of time"),
    (f"read {U} --out x.xyz --trigger loss", 2, "x.xyz: its suffix is not one of"),
    (f"read {U} --out x.csv --trigger key", 2, "standard input is no terminal; use --trigger signal"),
    ("read --ini missing.ini --out x.csv", 1, "missing.ini: No such file or directory"),
    (f"read {U} --out log.parquet.gz", 2, "leave out .gz"),
]


@pytest.mark.parametrize(("line", "code", "words"), MISTAKES, ids=[line for line, *_ in MISTAKES])
def test_a_mistake_is_one_line(
    line: str, code: int, words: str, pmu: Pmu, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdin", open(os.devnull))  # noqa: SIM115
    result = pmu(*line.split(), "--duration", 5)
    assert result.code == code, result.err
    assert words in result.complaint
    assert list(tmp_path.iterdir()) == []
