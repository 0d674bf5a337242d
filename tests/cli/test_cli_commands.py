"""What each command gives: data on stdout, talk on stderr, one JSON document, the documented exit codes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from support.captures import PMU, tcp_packets, udp_packet, write_pcap
from support.commands import Pmu, command, run_pmu
from support.playing import START_NS, interleaved, recording, stream
from support.recordings import write

from pmutools.timebase import NS

COMMANDS = ("info", "dump", "convert", "synth", "play", "read")


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A second of one stream, as raw frames."""
    path = tmp_path / "small.c37118"
    write(path, recording(stream(7, name="ALPHA"), 50))
    return path


@pytest.fixture
def damaged(tmp_path: Path) -> Path:
    """Frames with noise between them, over TCP: 30 bytes are no frame."""
    frames = [message.frame.data for message in recording(stream(), 20)]
    return write_pcap(tmp_path / "damaged.pcap", tcp_packets([*frames[:10], b"\xaa" * 30, *frames[10:]]))


# --- the commands as such


def test_help_of_every_command_is_complete_and_in_columns(pmu: Pmu) -> None:
    overview = pmu("--help")
    assert overview.code == 0
    for name in COMMANDS:
        assert f"  {name} " in overview.out
        told = pmu(name, "--help")
        assert (told.code, told.err) == (0, "")
        assert told.out.startswith(f"Usage: pmu {name} [OPTIONS]")
        for option in ("--json", "--quiet", "--verbose"):
            assert option in told.out
        assert max(map(len, told.out.splitlines())) <= 80
    assert pmu("-h").out == overview.out


def test_help_imports_nothing_heavy() -> None:
    program = (
        "import sys\nfrom pmutools.cli import pmu\nfrom pmutools.cli.shell import run\n"
        "for name in ('play', 'read', 'info', 'dump', 'convert', 'synth'):\n"
        "    assert run(pmu(), [name, '--help']) == run(pmu(), ['--help']) == 0\n"
        "print(*(name for name in ('numpy', 'pyarrow', 'scapy', 'mcap', 'rich', 'google') if name in sys.modules), "
        "file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert done.stderr.strip() == ""


def test_the_version_is_told(pmu: Pmu) -> None:
    from pmutools import __version__

    assert pmu("--version").out == f"pmu, version {__version__}\n"


def test_the_papers_names_run_the_same_commands(monkeypatch: pytest.MonkeyPatch, capfd: Any) -> None:
    from pmutools import cli

    for entry, name in ((cli.player, "stream-player"), (cli.reader, "stream-reader")):
        monkeypatch.setattr("sys.argv", [name, "--help"])
        with pytest.raises(SystemExit) as ended:
            entry()
        assert ended.value.code == 0
        assert capfd.readouterr().out.startswith(f"Usage: {name} [OPTIONS]")


# --- info


def test_info_tells_a_program_everything(pmu: Pmu, small: Path) -> None:
    result = pmu("info", small, "--json")
    assert (result.code, result.err) == (0, "")
    told = result.json
    assert (told["kind"], told["frames"], told["skipped"], told["defects"]) == ("raw", {"data": 50, "cfg2": 1}, {}, {})
    (one,) = told["streams"]
    assert (one["idcode"], one["rate_hz"], one["frames"], one["missing"], one["span_s"]) == (7, 50.0, 50, 0, 0.98)
    assert one["first"] == "2016-09-08T17:05:11.000000000Z"
    assert [station["name"] for station in one["stations"]] == ["ALPHA"]


def test_info_tells_a_person_the_same(pmu: Pmu, small: Path) -> None:
    result = pmu("info", small)
    assert (result.code, result.err) == (0, "")
    for words in ("50 frames/s", "ALPHA", "IDCODE 7", "50 frames over 0.980 s", "V1 (V)"):
        assert words in result.out


@pytest.mark.parametrize("command", ["info", "dump"])
def test_skipped_bytes_are_told_and_are_exit_code_3(pmu: Pmu, damaged: Path, command: str) -> None:
    plain, as_json = pmu(command, damaged), pmu(command, damaged, "--json")
    assert (plain.code, as_json.code) == (3, 3)
    assert "30 bytes" in plain.out
    skipped = (
        sum(as_json.json["skipped"].values())
        if command == "info"
        else sum(line["nbytes"] for line in as_json.lines if line["type"] == "skipped")
    )
    assert skipped == 30


def test_flags_and_gaps_are_results_not_failures(pmu: Pmu, tmp_path: Path) -> None:
    path = tmp_path / "gaps.c37118"
    write(path, recording(stream(), 10, slots=[0, 1, 2, 5, 6, 7, 8, 20, 21, 22]))
    result = pmu("info", path)
    assert result.code == 0
    assert "13 frames missing in 2 gaps" in result.out


# --- dump


def test_dump_is_one_object_a_line(pmu: Pmu, small: Path) -> None:
    result = pmu("dump", small, "--json")
    assert (result.code, result.err, len(result.lines)) == (0, "", 51)
    config, *data = result.lines
    assert (config["type"], config["rate_hz"], config["stations"][0]["fnom_hz"]) == ("cfg2", 50.0, 60.0)
    assert [line["type"] for line in data] == ["data"] * 50
    assert [line["time_ns"] for line in data] == [START_NS + k * NS // 50 for k in range(50)]
    assert {line["arrival_ns"] for line in data} == {None}
    assert data[3]["stations"][0] == {
        "name": "ALPHA",
        "idcode": 7,
        "stat": 0,
        "valid": True,
        "phasors": [{"name": "V1", "kind": "V", "re": 1.0, "im": -1.0}],
        "frequency": 60.003,
        "rocof": 0.0,
        "analogs": [],
        "digitals": [],
    }


def test_dump_is_one_line_a_frame_for_a_person(pmu: Pmu, small: Path) -> None:
    lines = pmu("dump", small).out.splitlines()
    assert len(lines) == 51
    assert lines[0].split()[:3] == ["2016-09-08T17:05:11.000000000Z", "7", "cfg2"]
    assert lines[4].split() == [
        "2016-09-08T17:05:11.060000000Z", "7", "data", "ALPHA", "stat=0000", "f=60.0030", "V1=1.41421<-45.000",
    ]  # fmt: skip


def test_dump_picks_types_and_none_found_is_no_failure(pmu: Pmu, small: Path) -> None:
    assert {line["type"] for line in pmu("dump", small, "--json", "--type", "cfg2").lines} == {"cfg2"}
    assert len(pmu("dump", small, "--json", "--type", "cfg2", "--type", "data").lines) == 51
    nothing = pmu("dump", small, "--type", "header")
    assert (nothing.code, nothing.out, nothing.err) == (0, "", "")


def test_duration_of_a_file_is_stream_time(pmu: Pmu, small: Path) -> None:
    assert len(pmu("dump", small, "--json", "--type", "data", "--duration", "0.2").lines) == 10
    assert pmu("info", small, "--json", "--duration", "0.2").json["streams"][0]["frames"] == 10


# --- convert


def test_convert_tells_what_went_through(pmu: Pmu, small: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.csv"
    result = pmu("convert", small, out)
    assert (result.code, result.out) == (0, "")
    assert "50 data frames of 1 streams" in result.err
    told = pmu("convert", small, out, "--json", "--quiet")
    assert (told.code, told.err) == (0, "")
    assert told.json == {"frames": 50, "streams": 1, "losses": {}, "paths": [str(out)]}


def test_convert_to_standard_output_is_the_table_alone(pmu: Pmu, small: Path) -> None:
    result = pmu("convert", small, "-", "--json")
    assert result.code == 0
    lines = result.out.splitlines()
    assert lines[0] == (
        "time,arrival_ns,stamp_source,idcode,time_quality,"
        "ALPHA.stat,ALPHA.freq_hz,ALPHA.rocof_hz_s,ALPHA.V1.mag,ALPHA.V1.deg"
    )
    assert len(lines) == 51


def test_losses_of_the_source_are_exit_code_3(pmu: Pmu, damaged: Path, tmp_path: Path) -> None:
    result = pmu("convert", damaged, tmp_path / "out.parquet", "--json")
    assert result.code == 3
    assert sum(result.json["losses"].values()) == 30
    assert result.json["frames"] == 20


def test_convert_cuts_picks_and_merges(pmu: Pmu, tmp_path: Path) -> None:
    write(tmp_path / "a.pcap", recording(stream(1), 100, latency_ns=0, first_slot=25))
    write(tmp_path / "b.pcap", recording(stream(2), 100, latency_ns=0))
    out = tmp_path / "out.c37118"
    result = pmu("convert", tmp_path / "a.pcap", tmp_path / "b.pcap", out, "--start", "1", "--end", "2", "--json")
    assert result.json["frames"] == 100
    times = [line["time_ns"] for line in pmu("dump", out, "--json", "--type", "data").lines]
    assert times == sorted(times)
    assert (times[0], times[-1]) == (START_NS + NS, START_NS + 2 * NS - NS // 50), "counted from the earlier source"
    assert pmu("convert", tmp_path / "a.pcap", out, "--idcode", "2").code == 1
    both = pmu("convert", tmp_path / "a.pcap", tmp_path / "b.pcap", tmp_path / "t.csv", "--idcode", "0x2", "--json")
    assert (both.json["frames"], both.json["streams"]) == (100, 1)


def test_parts_of_one_stream_become_one_table_in_order(pmu: Pmu, tmp_path: Path) -> None:
    config = stream(3)
    for part in (0, 1, 2):
        messages = recording(config, 50, first_slot=50 * part, latency_ns=0, flow=recording(config, 0)[0].flow)
        write(tmp_path / f"part{part}.pcap", messages)
    names = [tmp_path / f"part{part}.pcap" for part in (2, 0, 1)]
    result = pmu("convert", *names, tmp_path / "whole.csv", "--json")
    assert result.json["streams"] == 1
    rows = (tmp_path / "whole.csv").read_text().splitlines()[1:]
    assert len(rows) == 150
    assert rows == sorted(rows)


def test_several_streams_become_tables_in_a_folder_and_play_back(pmu: Pmu, synthetic: Path, tmp_path: Path) -> None:
    result = pmu("convert", synthetic, tmp_path / "eight.parquet", "--json")
    assert len(result.json["paths"]) == 8
    assert {Path(path).parent for path in result.json["paths"]} == {tmp_path / "eight"}
    assert pmu("info", tmp_path / "eight", "--json").json["frames"] == {"data": 960}
    again = pmu("convert", tmp_path / "eight", tmp_path / "again.c37118", "--json").json
    assert (again["frames"], again["streams"]) == (960, 8)


# --- synth


@pytest.mark.parametrize(
    ("options", "streams", "rate", "frames"),
    [
        ((), 8, 60.0, 480),
        (("--rate", 50, "--pmus", 2), 2, 50.0, 100),
        (("--rate", 30, "--pmus", 3, "--scenario", "square-pulse"), 3, 30.0, 90),
        (("--rate", 25, "--pdc", 77), 1, 25.0, 25),
        (("--rate", 120, "--pmus", 1, "--scenario", "ambient"), 1, 120.0, 120),
    ],
)
def test_synth_makes_clean_streams_and_the_same_bytes_again(
    pmu: Pmu, tmp_path: Path, options: tuple[object, ...], streams: int, rate: float, frames: int
) -> None:
    first, second = tmp_path / "first.pcap", tmp_path / "second.pcap"
    result = pmu("synth", first, "--duration", 1, "--json", *options)
    assert (result.json["streams"], result.json["frames"]) == (streams, frames)
    assert pmu("synth", second, "--duration", 1, *options).code == 0
    assert first.read_bytes() == second.read_bytes()
    told = pmu("info", first, "--json").json
    assert len(told["streams"]) == streams
    for one in told["streams"]:
        assert (one["rate_hz"], one["frames"], one["missing"], one["off_grid"]) == (rate, rate, 0, 0)
        assert (one["duplicates"], one["backwards"], one["invalid"], one["data_error"]) == (0, 0, 0, 0)
    if "--pdc" in options:
        assert (told["streams"][0]["idcode"], len(told["streams"][0]["stations"])) == (77, 8)


def test_synth_with_another_seed_makes_other_bytes(pmu: Pmu, tmp_path: Path) -> None:
    for seed in (1, 2):
        assert pmu("synth", tmp_path / f"{seed}.c37118", "--duration", 1, "--seed", seed, "--pmus", 1).code == 0
    assert (tmp_path / "1.c37118").read_bytes() != (tmp_path / "2.c37118").read_bytes()


@pytest.mark.parametrize("suffix", [".pcap", ".pcapng", ".c37118", ".mcap", ".csv", ".parquet", ".arrow", ".csv.gz"])
def test_synth_writes_every_format(pmu: Pmu, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"one{suffix}"
    assert pmu("synth", out, "--duration", "0.5", "--pmus", 1).code == 0
    assert pmu("info", out, "--json").json["frames"]["data"] == 30


# --- play


def test_play_tells_how_late_it_was(pmu: Pmu, small: Path) -> None:
    result = pmu("play", small, "--to", "udp://127.0.0.1:9", "--speed", 10, "--json")
    assert result.code == 0
    (one,) = result.json["streams"]
    assert (one["name"], one["idcode"], sum(one["fates"].values())) == ("ALPHA", 7, 50)
    assert set(one["late_us"]) == {"p50", "p99", "max"}
    quiet = pmu("play", small, "--to", "udp://127.0.0.1:9", "--speed", 10, "--quiet")
    assert (quiet.code, quiet.out, quiet.err) == (0, "", "")


def test_play_of_a_damaged_source_is_exit_code_3(pmu: Pmu, damaged: Path) -> None:
    result = pmu("play", damaged, "--to", "udp://127.0.0.1:9", "--speed", 10, "--json")
    assert result.code == 3
    assert sum(result.json["losses"].values()) == 30
    assert result.json["streams"][0]["fates"]["sent"] == 20
    assert "bytes skipped" in result.err


def test_a_fault_for_a_stream_that_is_not_there_is_told(pmu: Pmu, small: Path) -> None:
    result = pmu("play", small, "--to", "udp://127.0.0.1:9", "--speed", 10, "--disable", "BETA@0..1")
    assert result.code == 0
    assert "BETA: no such stream; there are ALPHA" in result.err


def test_faults_that_were_asked_for_are_no_failure(pmu: Pmu, small: Path, tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    ledger = tmp_path / "ledger.parquet"
    arguments = ("--to", "udp://127.0.0.1:9", "--speed", 10, "--drop", "3,5", "--disable", "ALPHA@0.5..0.7")
    assert pmu("play", small, *arguments, "--ledger", ledger).code == 0
    fates = pq.read_table(ledger)["fate"].to_pylist()
    assert (fates.count("dropped"), fates.count("disabled"), fates.count("sent"), len(fates)) == (2, 10, 38, 50)


# --- everywhere


def test_progress_is_shown_where_a_person_watches_and_removed(tmp_path: Path) -> None:
    pty = pytest.importorskip("pty")
    path = tmp_path / "long.c37118"
    write(path, recording(stream(rate=120), 25_000))
    person, terminal = pty.openpty()
    try:
        words = command("info", path, "--json")
        subprocess.run(words, stdout=subprocess.DEVNULL, stderr=terminal, timeout=60, check=True)
        shown = os.read(person, 1 << 16).decode()
    finally:
        os.close(person)
        os.close(terminal)
    assert shown.startswith(f"{path}: ")
    assert shown.endswith(" frames\r\x1b[K")


def test_quiet_commands_say_nothing(pmu: Pmu, small: Path, tmp_path: Path) -> None:
    for words in (
        ("convert", small, tmp_path / "x.csv"),
        ("synth", tmp_path / "y.csv", "--duration", "0.1", "--pmus", 1),
    ):
        result = pmu(*words, "--quiet")
        assert (result.code, result.out, result.err) == (0, "", "")


def test_a_compressed_truncated_capture_is_read_as_far_as_it_goes(pmu: Pmu, tmp_path: Path) -> None:
    packets = [udp_packet(message.frame.data, PMU) for message in recording(stream(), 30)]
    whole = write_pcap(tmp_path / "whole.pcap", packets)
    (tmp_path / "cut.pcap").write_bytes(whole.read_bytes()[:-20])
    result = pmu("info", tmp_path / "cut.pcap", "--json")
    assert result.code == 3
    assert result.json["frames"] == {"cfg2": 1, "data": 29}
    assert result.json["defects"]


def test_commands_of_their_own_process_keep_data_and_talk_apart(small: Path, tmp_path: Path) -> None:
    result = run_pmu("convert", small, tmp_path / "x.mcap", "--json")
    assert result.code == 0
    assert json.loads(result.out)["frames"] == 50
    assert result.err.count("\n") == 1


def test_merged_streams_are_in_one_capture(pmu: Pmu, tmp_path: Path) -> None:
    path = tmp_path / "two.pcap"
    write(path, interleaved(recording(stream(1), 10, latency_ns=0), recording(stream(2), 10, latency_ns=0)))
    assert [one["idcode"] for one in pmu("info", path, "--json").json["streams"]] == [1, 2]
