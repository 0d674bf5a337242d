"""``pmu characterize`` of recordings: what it writes, says and answers, and each diagnosis from a capture file."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from support.captures import REAL_CAPTURES, capture_path
from support.commands import Pmu, Result, run_here
from support.live import data_frame
from support.playing import MS, START_NS, interleaved, recording, stream
from support.recordings import write

from pmutools.c37118 import Format, Frame, Message
from pmutools.c37118.checksum import sealed
from pmutools.cli.characterize_text import TOLD_MUTE, TOLD_STREAMS, worst
from pmutools.flow import Flow, StampSource
from pmutools.impair.profile import read_profile_file
from pmutools.timebase import NS

ROOT = Path(__file__).parents[2]
CJB = ROOT / "captures" / "cjb-8pmu.pcap"
PDC = Flow("udp", "192.0.2.7:4713", "192.0.2.1:4713")


def characterized(path: Path, out: Path, *options: object) -> tuple[Result, dict[str, Any]]:
    """The command's answer, and the summary that it left."""
    result = run_here("characterize", path, "--out", out, "--no-report", *options)
    found: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return result, found


def ids(found: dict[str, Any]) -> set[str]:
    return {diagnosis["id"] for diagnosis in found["diagnoses"]}


# --- what comes of it


def test_streams_that_are_only_announced_hide_none() -> None:
    def of(name: str, received: int) -> dict[str, Any]:
        return {"name": name, "received": received, "lost": 0, "expected": received, "diagnoses": [], "delay_ms": {}}

    mute = [of(f"M{number}", 0) for number in range(2000)]
    heard = [of(f"H{number}", 60) | {"delay_ms": {"p99": number}} for number in range(30)]
    assert [each["name"] for each in worst([*mute, heard[0]])[-1:]] == ["H0"]
    assert len(worst([*mute, *heard])) == TOLD_STREAMS
    assert sum(not each["received"] for each in worst([*mute, *heard])) == TOLD_MUTE
    assert worst([*mute, *heard])[TOLD_MUTE]["name"] == "H29"


def test_names_as_sent_never_steer_the_terminal(tmp_path: Path) -> None:
    (capture,) = write(tmp_path / "x.pcap", recording(stream(name="A\x00\x07\x1b[31m"), 90))
    result, told = characterized(capture, tmp_path / "run")
    assert told["streams"][0]["name"] == "A\x00\x07\x1b[31m"
    assert "A\\x00\\x07\\x1b[31m" in result.out
    assert all(line.isprintable() for line in result.out.splitlines())


def test_a_capture_by_its_stamps(tmp_path: Path) -> None:
    result, told = characterized(CJB, tmp_path / "run")
    assert result.code == 0, result.err
    assert [found["name"] for found in told["streams"]] == ["N1", "N2", "N3", "N4", "S1", "S2", "S3", "S4"]
    for found in told["streams"]:
        assert (found["expected"], found["received"], found["lost"]) == (1200, 1200, 0)
        assert found["delay_ms"]["p50"] == pytest.approx(59.8, abs=0.2)
        assert found["uncertainty_ms"] is None  # a capture does not say how good its clock was
        assert not ids(found)
    assert told["all"]["alignment"][0]["complete"] == 1200
    assert told["run"]["complete"] and told["run"]["input"]["defects"] == {}
    samples = pq.read_table(tmp_path / "run" / "samples.parquet")
    assert samples.num_rows == 9600
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == ["samples.parquet", "summary.json"]
    lines = result.out.splitlines()
    assert "captures/cjb-8pmu.pcap: 8 streams, 20.0 s" in lines[0]
    assert [line.split()[:4] for line in lines if line.startswith("N1 ")] == [["N1", "60", "1200", "1200"]]
    assert any(line.startswith("  Effective") for line in lines)


def test_json_is_the_summary_and_quiet_is_quiet(pmu: Pmu, tmp_path: Path) -> None:
    result = pmu("characterize", CJB, "--out", tmp_path / "a", "--no-report", "--json", "--quiet")
    assert result.code == 0
    assert result.json == json.loads((tmp_path / "a" / "summary.json").read_text())
    assert result.err == ""
    result = pmu("characterize", CJB, "--out", tmp_path / "b", "--no-report", "--quiet")
    assert (result.out, result.err) == ("", "")


def test_part_of_it_in_intervals_and_without_samples(tmp_path: Path) -> None:
    _, told = characterized(CJB, tmp_path, "--duration", 5, "--interval", 2, "--no-samples")
    assert told["all"]["received"] == 2400
    lines = [json.loads(line) for line in (tmp_path / "intervals.jsonl").read_text().splitlines()]
    assert sum(line["all"]["received"] for line in lines) == 2400
    assert [line["all"]["received"] for line in lines][1] == 960
    assert not (tmp_path / "samples.parquet").exists()


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".arrow", ".mcap", ".pcapng"])
def test_a_reader_s_log_of_every_format_is_measured_alike(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"log{suffix}"
    messages = recording(stream(), 300, latency_ns=lambda k: 40 * MS + k % 7 * MS)
    write(path, [message for k, message in enumerate(messages) if k not in (100, 101, 200)])
    result, told = characterized(path, tmp_path / "run")
    assert result.code == 0, result.err
    (found,) = told["streams"]
    assert (found["name"], found["expected"], found["received"], found["lost"]) == ("PMU 7", 300, 297, 3)
    assert found["delay_ms"]["max"] == pytest.approx(46.0, abs=0.001)
    assert found["loss_runs"]["lengths"] == [[1, 1], [2, 1]]


def test_a_recording_without_arrivals_gives_what_it_can(tmp_path: Path) -> None:
    path = tmp_path / "raw.c37118"
    messages = recording(stream(), 300)
    write(path, [message for k, message in enumerate(messages) if k != 100])
    result, told = characterized(path, tmp_path / "run")
    assert result.code == 0
    (found,) = told["streams"]
    assert (found["lost"], found["delay_ms"]["count"], found["budget"]) == (1, 0, [])
    assert found["uncertainty"]["parts"][2]["why"] == "nobody saw the frames come"
    assert "no arrival times" in result.out


def test_several_recordings_are_one_run(tmp_path: Path) -> None:
    for idcode in (7, 8):
        write(tmp_path / f"{idcode}.csv", recording(stream(idcode), 100, latency_ns=20 * MS))
    result = run_here(
        "characterize", tmp_path / "7.csv", tmp_path / "8.csv", "--out", tmp_path / "run", "--no-report", "--json"
    )
    assert [found["idcode"] for found in result.json["streams"]] == [7, 8]
    assert result.json["all"]["alignment"][0]["complete"] == 100


def test_limits_are_judged(tmp_path: Path) -> None:
    result, told = characterized(CJB, tmp_path, "--require", "delay_p99<=90ms,loss<=0.1%")
    assert result.code == 0
    assert "ok   delay_p99<=90ms: all 8 streams" in result.out
    assert len(told["require"]) == 16 and all(row["holds"] for row in told["require"])
    result, told = characterized(CJB, tmp_path, "--require", "N*.delay_p99<=60ms,Q9.loss<=1%")
    assert result.code == 3
    assert "FAIL N1: N*.delay_p99<=60ms" in result.out
    assert "FAIL Q9: Q9.loss<=1% (no such stream" in result.out


def test_two_runs_compared(tmp_path: Path) -> None:
    for name, latency, skip in (("before", 20, 0), ("after", 30, 50)):
        messages = recording(stream(), 1000, latency_ns=latency * MS)
        write(tmp_path / f"{name}.csv", messages[: 1000 - skip] if not skip else messages[:500] + messages[550:])
    characterized(tmp_path / "before.csv", tmp_path / "a")
    result, told = characterized(tmp_path / "after.csv", tmp_path / "b", "--compare", tmp_path / "a")
    assert result.code == 0
    rows = {(row["stream"], row["metric"]): row["verdict"] for row in told["compare"]}
    assert rows["PMU 7", "delay_p99"] == rows["PMU 7", "loss"] == "worse"
    assert "worse   PMU 7: delay_p99 20 ms -> 30 ms" in result.out
    result, told = characterized(tmp_path / "after.csv", tmp_path / "c", "--compare", tmp_path / "b")
    assert "nothing changed beyond 5 %" in result.out


@pytest.mark.parametrize("exact", [False, True])
def test_the_profile_is_one_that_the_player_takes(exact: bool, tmp_path: Path) -> None:
    odd = replace(stream(), stations=(replace(stream().stations[0], name="[odd] name; N,1"),))
    messages = recording(stream(8), 600, latency_ns=lambda k: 40 * MS + k % 7 * MS)
    write(tmp_path / "log.pcap", interleaved(messages, recording(odd, 600, latency_ns=20 * MS)))
    profile = tmp_path / "measured.ini"
    options = ["--export-profile", profile] + ["--exact-profile"] * exact
    result, _ = characterized(tmp_path / "log.pcap", tmp_path / "run", *options)
    assert result.code == 0, result.err
    read = read_profile_file(profile)
    for names in (("PMU 8", "8"), ("[odd] name; N,1", "7")):
        assert read.treatment(names).stages.delay, profile.read_text()


def test_many_streams_show_the_worst(tmp_path: Path) -> None:
    streams = [
        recording(
            stream(idcode), 60, latency_ns=20 * MS, slots=[slot for slot in range(70) if slot % 7 or idcode != 25][:60]
        )
        for idcode in range(1, 31)
    ]
    write(tmp_path / "many.pcap", interleaved(*streams))
    result, _ = characterized(tmp_path / "many.pcap", tmp_path / "run")
    shown = [line for line in result.out.splitlines() if line.startswith("PMU ")]
    assert shown[0].startswith("PMU 25 ")
    assert len([line for line in shown if " 50 " in line]) == 20
    assert "(10 more streams that fare better" in result.out
    result, _ = characterized(tmp_path / "many.pcap", tmp_path / "run", "-v")
    assert "more streams that fare better" not in result.out


# --- what is wrong with them, from capture files


def changed(message: Message, at: int, data: bytes) -> Message:
    """A frame with other bytes, and a CHK that fits."""
    octets = message.frame.data
    return message._replace(frame=message.frame._replace(data=sealed(octets[:at] + data + octets[at + len(data) : -2])))


def with_stat(stat: int, quality: int = 0) -> list[Message]:
    messages = recording(stream(), 300, latency_ns=40 * MS)
    data = [changed(changed(m, 14, stat.to_bytes(2, "big")), 10, bytes((quality,))) for m in messages[1:]]
    return [messages[0], *data]


NOISE_NS = np.random.default_rng(1).exponential(MS / 2, 9000).astype(np.int64).tolist()


def jittery(k: int) -> int:
    """40 ms, and a little more, drawn anew for each frame."""
    return 40 * MS + int(NOISE_NS[k])


def twice() -> list[Message]:
    """Two devices of one IDCODE send to one address, 8 ms apart."""
    other = recording(stream(), 300, latency_ns=48 * MS, flow=PDC._replace(source="192.0.2.8:4713"))
    return sorted(
        [*recording(stream(), 300, latency_ns=jittery, flow=PDC), *other], key=lambda m: m.frame.arrival_ns or 0
    )


def off_grid() -> list[Message]:
    messages = recording(stream(), 0, latency_ns=0)
    for k in range(300):
        at_ns = START_NS + k * 20 * MS + (k * 7919) % 15 * MS
        frame = Frame(data_frame(stream(), at_ns, value=k), at_ns + 40 * MS, StampSource.CAPTURE, 0)
        messages.append(Message(frame, messages[0].flow, stream()))
    return messages


def stale() -> list[Message]:
    first = recording(stream(), 2, first_ns=START_NS - 63 * 86_400 * NS, latency_ns=63 * 86_400 * NS)
    return [*first, *recording(stream(), 300, latency_ns=jittery, announced=False)]


def restarted() -> list[Message]:
    again = recording(stream(), 100, latency_ns=jittery, first_slot=320, flow=PDC._replace(source="192.0.2.7:50000"))
    return [*recording(stream(), 300, latency_ns=jittery, flow=PDC), *again]


def with_station(**said: Any) -> list[Message]:
    config = stream()
    return recording(replace(config, stations=(replace(config.stations[0], **said),)), 300, latency_ns=jittery)


def leaping() -> list[Message]:
    """The sender's stamps take a second more than the receiver's clock does, for a while."""
    messages = recording(stream(), 600, latency_ns=lambda k: jittery(k) + NS * (200 < k < 400))
    return [messages[0], *(changed(message, 10, b"\x20") for message in messages[1:])]


def smeared() -> list[Message]:
    messages = recording(stream(rate=1), 600, latency_ns=lambda k: jittery(k) + k * 11_600)
    return [messages[0], *(changed(message, 10, b"\x20") for message in messages[1:])]


def forgotten() -> list[Message]:
    """A multicast group that falls silent after 260 s, and comes back."""
    flow = PDC._replace(destination="239.1.2.3:4713")
    return recording(stream(rate=1), 360, latency_ns=jittery, slots=[*range(260), *range(400, 500)], flow=flow)


CASES: dict[str, Callable[[], list[Message]]] = {
    "negative-delays": lambda: recording(stream(), 300, latency_ns=lambda k: jittery(k) - 50 * MS),
    "tai-utc": lambda: recording(stream(), 300, latency_ns=lambda k: jittery(k) - 37 * NS),
    "locked-but-off": lambda: recording(stream(), 300, latency_ns=lambda k: jittery(k) + 3600 * NS),
    "unsynchronised": lambda: with_stat(0x21F0, 0xF),
    "trigger-stuck": lambda: with_stat(0x0800),
    "clock-skew": lambda: recording(stream(), 9000, latency_ns=lambda k: jittery(k) + k * 2000),
    "latency-step": lambda: recording(stream(), 9000, latency_ns=lambda k: jittery(k) + 9 * MS * (k > 5000)),
    "about-a-period": lambda: recording(stream(), 300, latency_ns=lambda k: 20 * MS + k % 5 * 10_000),
    "stale-frames": stale,
    "rate-mismatch": lambda: recording(stream(), 300, latency_ns=jittery, slots=range(0, 600, 2)),
    "off-grid": off_grid,
    "two-senders": twice,
    "reconnects": restarted,
    "pauses": lambda: recording(stream(), 300, latency_ns=jittery, slots=[*range(150), *range(250, 400)]),
    "uneven-arrival": lambda: recording(stream(), 600, latency_ns=lambda k: 40 * MS + k % 2 * 21 * MS),
    "periodic-delay": lambda: recording(stream(), 2000, latency_ns=lambda k: 40 * MS + abs(k % 50 - 25) * MS // 5),
    "late-frames": lambda: recording(stream(), 300, latency_ns=lambda k: 199 * MS + k % 10 * MS),
    "coarse-stamps": lambda: recording(stream(rate=10), 300, latency_ns=lambda k: 40 * MS + k % 7 * MS),
    "odd-time-base": lambda: recording(stream(time_base=0xFFFFFF), 300, latency_ns=jittery),
    "concentrator": lambda: with_station(idcode=61),
    "zero-scale": lambda: with_station(phasors=(replace(stream().stations[0].phasors[0], phunit=0),)),
    "idle-scale": lambda: with_station(format=Format(2)),
    "leap-second": leaping,
    "leap-smear": smeared,
    "multicast-ageing": forgotten,
    "config-changed": lambda: [
        *recording(stream(), 300, latency_ns=jittery),
        *recording(stream(cfgcnt=1), 300, latency_ns=jittery, first_slot=300),
    ],
}


@pytest.mark.parametrize("case", CASES)
def test_a_capture_that_has_it(case: str, tmp_path: Path) -> None:
    write(tmp_path / "sick.pcap", CASES[case]())
    result, told = characterized(tmp_path / "sick.pcap", tmp_path / "run")
    (found,) = told["streams"]
    assert case in ids(found)
    assert all(diagnosis["text"] in result.out for diagnosis in found["diagnoses"])


def test_a_sound_capture_has_none_of_them(tmp_path: Path) -> None:
    write(tmp_path / "sound.pcap", recording(stream(), 9000, latency_ns=jittery))
    _, told = characterized(tmp_path / "sound.pcap", tmp_path / "run")
    assert ids(told["streams"][0]) == set()


QUIRKS = {
    "C37.118_1PMU_TCP.pcap": {"locked-but-off", "odd-time-base", "trigger-stuck", "idle-scale"},
    "C37.118_1PMU_UDP.pcap": {"locked-but-off", "concentrator", "unmasked-digitals", "idle-scale"},
    "C37.118_4in1PMU_TCP.pcap": {
        "locked-but-off",
        "unmasked-digitals",
        "zero-scale",
        "pauses",
        "tcp-batching",
        "uneven-arrival",
        "periodic-delay",
        "idle-scale",
    },
    "c37_1100_fullclean.pcap": {"unsynchronised", "clock-off", "idle-scale"},
}


@pytest.mark.parametrize("name", REAL_CAPTURES)
def test_real_captures_are_told_in_words_without_any_option(name: str, tmp_path: Path) -> None:
    result, told = characterized(capture_path(name), tmp_path / "run")
    assert result.code == 0, result.err
    (found,) = told["streams"]
    assert found["received"] == REAL_CAPTURES[name].data
    assert ids(found) == QUIRKS[name]
    for diagnosis in found["diagnoses"]:
        assert diagnosis["text"] in result.out


# --- the clock of a recording


def test_a_recording_has_no_uncertainty_and_says_why(tmp_path: Path) -> None:
    write(tmp_path / "a.pcap", recording(stream(), 300, latency_ns=jittery))
    result, told = characterized(tmp_path / "a.pcap", tmp_path / "run")
    (found,) = told["streams"]
    why = "a recording does not say how good its clock was"
    assert found["uncertainty_ms"] is None
    assert found["uncertainty_reason"] == f"receiver clock: {why}"
    assert told["clock"]["text"].startswith(f"{why}: delays hold its offset")
    assert told["clock"]["text"] in result.out
    assert "unknown" in result.out


def test_the_user_may_vouch_for_the_clock_of_a_recording(tmp_path: Path) -> None:
    write(tmp_path / "a.pcap", recording(stream(), 300, latency_ns=jittery))
    asked = ("--clock-uncertainty", "0.5", "--interval", "1", "--require", "uncertainty<=1ms")
    result, told = characterized(tmp_path / "a.pcap", tmp_path / "run", *asked)
    (found,) = told["streams"]
    assert result.code == 0
    assert found["uncertainty_ms"] == pytest.approx(0.5 + 0.1 + 0.001)  # and the arrival stamp, and a locked sender
    assert found["uncertainty_reason"] is None
    assert (told["clock"]["source"], told["clock"]["worst_bound_ms"]) == ("user", 0.5)
    assert "receiver clock within 0.5 ms of UTC, by the word of the user" in result.out
    lines = [json.loads(line) for line in (tmp_path / "run" / "intervals.jsonl").read_text().splitlines()]
    assert [line["streams"][0]["uncertainty_ms"] for line in lines] == [pytest.approx(0.601)] * len(lines)


# --- what cannot be done


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        ((), 2, "what is to be measured?"),
        (("a.pcap", "--ini", "b.ini"), 2, "measure one or the other"),
        (("udp://127.0.0.1:1", "a.pcap"), 2, "not both at once"),
        (("udp://127.0.0.1:1", "--clock-uncertainty", "1"), 2, "live, the clock itself is asked"),
        (("a.pcap", "--clock-uncertainty", "-1"), 2, "'--clock-uncertainty': -1 is out of range"),
        (("a.pcap", "--no-samples", "--ledger", "t.parquet"), 2, "leave out --no-samples"),
        (("a.pcap", "--require", "speed<=1"), 2, "is nothing that is measured"),
        (("a.pcap", "--require", ""), 2, "an empty limit"),
        (("a.pcap", "--compare", "nowhere"), 2, "name the folder of a run"),
        (("a.pcap", "--compare", "."), 2, "No such file"),
        (("a.pcap", "--wait", "soon"), 2, "is not a number"),
        (("a.pcap", "--interval", "0"), 2, "at least 1"),
        (("nowhere.pcap",), 1, "nowhere.pcap: No such file"),
        (("udp://nohost", "--duration", "1"), 2, "udp://nohost"),
        (("--ini", "nowhere.ini"), 1, "nowhere.ini: No such file"),
    ],
)
def test_mistakes_are_one_line(
    arguments: tuple[str, ...], code: int, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run_here("characterize", *arguments, "--out", "run")
    assert result.code == code, result.err
    assert said in result.complaint


def test_the_folder_of_the_earlier_run_is_not_overwritten(tmp_path: Path) -> None:
    characterized(CJB, tmp_path / "run", "--duration", 1)
    before = (tmp_path / "run" / "summary.json").read_bytes()
    result = run_here("characterize", CJB, "--out", tmp_path / "run", "--compare", tmp_path / "run")
    assert result.code == 2 and "write to another folder" in result.complaint
    assert (tmp_path / "run" / "summary.json").read_bytes() == before


def test_an_input_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "samples.parquet"
    write(path, recording(stream(), 10, latency_ns=20 * MS))
    before = path.read_bytes()
    result = run_here("characterize", path, "--out", tmp_path)
    assert result.code == 2 and "is an input, and would be overwritten" in result.complaint
    assert path.read_bytes() == before


def test_a_capture_of_something_else_fails_and_says_so(foreign: Path, tmp_path: Path) -> None:
    result = run_here("characterize", foreign, "--out", tmp_path / "run", "--no-report", "--quiet")
    assert result.code == 1
    assert "no C37.118 data frames found" in result.complaint


def test_an_empty_file_is_no_recording(tmp_path: Path) -> None:
    (tmp_path / "empty.pcap").touch()
    result = run_here("characterize", tmp_path / "empty.pcap", "--out", tmp_path / "run")
    assert result.code == 1 and "is empty" in result.complaint


def test_damaged_frames_are_counted_and_are_exit_code_3(tmp_path: Path) -> None:
    messages = recording(stream(), 100, latency_ns=jittery)
    broken = [
        m._replace(frame=m.frame._replace(data=m.frame.data[:-1] + bytes((m.frame.data[-1] ^ 1,))))
        if k % 25 == 5
        else m
        for k, m in enumerate(messages)
    ]
    write(tmp_path / "broken.pcap", broken)
    result, told = characterized(tmp_path / "broken.pcap", tmp_path / "run")
    assert result.code == 3
    (found,) = told["streams"]
    assert (found["corrupt"], found["lost"], told["all"]["corrupt"]) == (4, 4, 4)
    assert "bytes skipped: bad-chk" in result.err
    assert "bad CHK" in result.out and "have a wrong CHK" in result.out


def test_a_capture_that_is_cut_is_told_and_is_exit_code_3(tmp_path: Path) -> None:
    path = tmp_path / "cut.pcap"
    path.write_bytes(CJB.read_bytes()[:-20])
    result, told = characterized(path, tmp_path / "run")
    assert result.code == 3
    assert told["run"]["input"]["defects"]
    assert told["all"]["received"] == 9599


def test_a_ledger_that_is_none_is_told_and_all_else_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pmutools.tools.characterizer.job.LEDGER_NS", 0)
    result, told = characterized(CJB, tmp_path / "run", "--ledger", tmp_path / "none.parquet")
    assert result.code == 1
    assert "there is no such ledger" in result.err
    assert told["all"]["received"] == 9600 and "ledger" not in told


def test_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    result = run_here("characterize", CJB, "--out", tmp_path / "file" / "run")
    assert result.code == 1 and "cannot make the folder" in result.complaint


def test_without_what_a_report_needs_all_else_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "plotly", None)
    result = run_here("characterize", CJB, "--out", tmp_path / "run", "--duration", 1)
    assert result.code == 0
    assert "no report.html and no figures" in result.err
