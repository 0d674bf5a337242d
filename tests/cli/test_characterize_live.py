"""``pmu characterize`` as a process beside a player, a device of another maker, and what may happen to it."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.commands import ended, run_pmu, started, wait_for_tcp, wait_for_udp
from support.live import free_udp_port
from support.peers import free_port, pyc37_stream, start_pyc37_pmu
from support.playing import interleaved, recording, stream
from support.recordings import write
from support.sending import MS, Plan, beside, config, planned, spec, udp_to

from pmutools.timebase import NS, slots_array

pytestmark = pytest.mark.realtime
FAULTS = ("--delay", "normal(30,3)", "--loss", "gemodel(2%,40%)", "--duplicate", "2%", "--drop", "10,50-52")


@pytest.fixture
def mixed(tmp_path: Path) -> Path:
    """Two seconds of streams at 10, 30, 60 and 120 frames/s."""
    path = tmp_path / "mixed.c37118"
    rates = (10, 30, 60, 120)
    write(path, interleaved(*(recording(stream(rate, name=f"R{rate}", rate=rate), 2 * rate) for rate in rates)))
    return path


def told(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return found


def by_ledger(path: Path, rate: int) -> dict[str, int]:
    """What a receiver must have seen of a stream, by the ledger's columns alone."""
    table = pq.read_table(path).to_pylist()
    rows = [row for row in table if row["stream"] == f"R{rate}" and row["fate"] == "sent"]
    slots = slots_array(np.array([row["time_ns"] for row in rows]), stream(rate=rate).rate)
    order = np.argsort([row["tx_stamp_ns"] or row["sent_ns"] for row in rows], kind="stable")
    seen, highest, reordered, duplicated = set[int](), -1, 0, 0
    for slot in slots[order].tolist():
        if slot in seen:
            duplicated += 1
            continue
        reordered += slot < highest
        seen.add(slot)
        highest = max(highest, slot)
    expected = max(seen) - min(seen) + 1
    return {"expected": expected, "received": len(seen), "duplicated": duplicated, "reordered": reordered}


def test_against_a_player_s_ledger_over_udp(mixed: Path, tmp_path: Path) -> None:
    """Counts exactly; delays as the player's own stamps of departure have them; each copy met its fate."""
    port, out, ledger = free_udp_port(), tmp_path / "run", tmp_path / "truth.parquet"
    url = f"udp://127.0.0.1:{port}"
    options = ("--interval", 1, "--ledger", ledger, "--require", "loss<=50%", "--no-report")
    with started("characterize", url, "--out", out, *options) as running:
        wait_for_udp(port, running)
        played = run_pmu("play", mixed, "--to", url, *FAULTS, "--seed", 3, "--ledger", ledger, "--quiet")
        time.sleep(0.3)  # for what is in the kernel to be taken
        running.send_signal(signal.SIGINT)
        result = ended(running)
    assert (played.code, result.code) == (0, 130), result.err
    summary = told(out)
    table = pq.read_table(ledger).to_pylist()
    for found in summary["streams"]:
        rate = round(found["rate_hz"])
        truth = by_ledger(ledger, rate)
        assert {key: found[key] for key in truth} == truth
        sent = {}
        for row in table:
            if row["stream"] == f"R{rate}" and row["fate"] == "sent":
                departed = row["tx_stamp_ns"] or row["sent_ns"]
                sent[row["time_ns"]] = min(sent.get(row["time_ns"], departed), departed)
        delays = np.sort([(departed - stamp) / MS for stamp, departed in sent.items()])
        for key, share in (("p50", 0.5), ("p90", 0.9)):
            assert found["delay_ms"][key] == pytest.approx(delays[int(np.ceil(share * len(delays))) - 1], abs=0.3)
        assert 0 < found["one_way_ms"]["p50"] < 1
        assert [row["how"] for row in found["budget"][:2]] == [
            "stamp to departure, seen at the sender",
            "departure to arrival, frame by frame",
        ]
    whole = summary["ledger"]["all"]
    fates = {fate: sum(row["fate"] == fate for row in table) for fate in ("sent", "lost", "dropped")}
    assert whole["received"] == {"sent": fates["sent"]}
    assert whole["missing"] == {fate: count for fate, count in fates.items() if fate != "sent" and count}
    assert (whole["unknown"], whole["outside"], whole["contradictions"]) == (0, 0, 0)
    lines = [json.loads(line) for line in (out / "intervals.jsonl").read_text().splitlines()]
    assert sum(line["all"]["received"] for line in lines) == summary["all"]["received"]
    assert all(row["holds"] for row in summary["require"])
    assert all(line["clock"]["text"] for line in lines)
    assert f"{fates['sent']} sent and received" in result.out


def received(out: Path, name: str) -> int:
    """Frames of a stream in the intervals that are over."""
    path = out / "intervals.jsonl"
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    told = [row for line in lines if line.endswith("\n") for row in json.loads(line)["streams"]]
    return sum(row["received"] for row in told if row["name"] == name)


def test_an_initialisation_file_with_a_site_that_is_silent(mixed: Path, tmp_path: Path) -> None:
    """Over TCP, ended by Ctrl-C: every site is told of, under the name it has in the file."""
    port, silent, out, ini = free_port(), free_udp_port(), tmp_path / "run", tmp_path / "pmus.ini"
    ini.write_text(
        f"[DEFAULT]\nrate = 60\n"
        f"[pmu north]\nurl = tcp://127.0.0.1:{port}\nidcode = 60\n"
        f"[pmu slow]\nurl = tcp://127.0.0.1:{port}\nidcode = 30\n"
        f"[pmu gone]\nurl = udp://127.0.0.1:{silent}\n"
    )
    with started("play", mixed, "--listen", f"tcp://127.0.0.1:{port}", "--loop", 0) as player:
        wait_for_tcp(port, player)
        with started("characterize", "--ini", ini, "--out", out, "--no-report", "--interval", 1) as running:
            deadline = time.monotonic() + 30
            while min(received(out, name) for name in ("north", "slow")) <= 20 and time.monotonic() < deadline:
                assert running.poll() is None
                time.sleep(0.05)
            running.send_signal(signal.SIGINT)
            result = ended(running)
        player.send_signal(signal.SIGINT)
        ended(player)
    assert result.code == 130, result.err
    found = {row["name"]: row for row in told(out)["streams"]}
    assert list(found) == ["north", "slow", "gone"]
    assert found["north"]["received"] > 20 and found["north"]["lost"] == 0
    assert "R60" in found["north"]["other_names"]
    ids = {name: {diagnosis["id"] for diagnosis in row["diagnoses"]} for name, row in found.items()}
    assert "unexpected-rate" in ids["slow"] and "silent" in ids["gone"]
    assert "60 frames/s are expected" in result.out
    assert "Traceback" not in result.err


@pytest.fixture
def sender() -> Iterator[tuple[int, Plan]]:
    """A port, and a steady sender to it for as long as the test runs."""
    port, of = free_udp_port(), spec()
    plan = planned(of, time.time_ns() + NS // 2, [[20.0]] * 600)

    def send() -> None:
        with udp_to(port) as put:
            for number, (at_ns, frame) in enumerate(plan.frames):
                if number % 30 == 0:
                    put(config(of))
                time.sleep(max(0.0, (at_ns - time.time_ns()) / NS))
                if stopped:
                    return
                put(frame)

    stopped: list[bool] = []
    with beside(send):
        yield port, plan
        stopped.append(True)


def test_a_run_that_is_killed_leaves_what_it_had_flushed(sender: tuple[int, Plan], tmp_path: Path) -> None:
    port, out = sender[0], tmp_path / "run"
    with started("characterize", f"udp://127.0.0.1:{port}", "--out", out, "--interval", 1) as running:
        deadline = time.monotonic() + 30
        while time.monotonic() < deadline and not (out / "summary.json").exists():
            time.sleep(0.05)
        time.sleep(1.2)
        running.kill()
    summary = told(out)
    assert not summary["run"]["complete"]
    assert summary["streams"][0]["received"] > 10
    lines = (out / "intervals.jsonl").read_text().splitlines()
    assert json.loads(lines[-1])["all"]["received"] > 10
    rows = 0
    with pa.OSFile(str(out / "samples.parquet.journal")) as file:
        try:
            for part in pa.ipc.open_stream(file):
                rows += part.num_rows
        except (OSError, pa.ArrowInvalid):
            pass
    assert rows >= summary["streams"][0]["received"]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 256 KiB."""
    place = tmp_path / "small"
    place.mkdir()
    mount = shutil.which("mount")
    if os.geteuid() or mount is None:
        pytest.skip("to mount a small file system takes root")
    if subprocess.run([mount, "-t", "tmpfs", "-o", "size=256k", "none", place], check=False).returncode:
        pytest.skip("no file system may be mounted here")
    yield place
    subprocess.run(["umount", place], check=True)


def test_a_full_disk_is_told_and_the_rest_is_measured(
    sender: tuple[int, Plan], small_disk: Path, tmp_path: Path
) -> None:
    port, out = sender[0], small_disk / "run"
    with started("characterize", f"udp://127.0.0.1:{port}", "--out", out, "--no-report") as running:
        wait_for_udp(port, running)
        time.sleep(1.5)  # something is written before
        ballast = small_disk / "ballast"
        with ballast.open("wb", buffering=0) as file:
            try:
                while True:
                    file.write(bytes(4096))
            except OSError:
                pass
        deadline = time.monotonic() + 20
        while (out / "samples.parquet").exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        ballast.unlink()
        running.send_signal(signal.SIGINT)
        result = ended(running)
    assert result.code == 130
    assert "samples.parquet" in result.err and "No space left on device" in result.err
    summary = told(out)
    assert summary["streams"][0]["received"] > 60
    assert any("No space left" in line for _, line in summary["run"]["news"])
    assert not (out / "samples.parquet").exists()


@pytest.mark.peer
def test_another_maker_s_pmu_is_measured_without_any_option(tmp_path: Path) -> None:
    """pyc37 serves some 8 frames/s of a stream that claims 30, at the time they leave."""
    made = pyc37_stream(random.Random(5), frames=400)
    port, out = free_port(), tmp_path / "run"
    with start_pyc37_pmu(port, made.config(), made.data, stamp_now=True):
        url = f"tcp://127.0.0.1:{port}?idcode={made.spec.idcode}"
        result = run_pmu("characterize", url, "--out", out, "--duration", 5, "--no-report")
    assert result.code == 0, result.err
    (found,) = told(out)["streams"]
    assert found["received"] > 12
    ids = {diagnosis["id"] for diagnosis in found["diagnoses"]}
    assert "rate-mismatch" in ids, result.out
    assert 0 <= found["delay_ms"]["p50"] < 200


def test_nothing_at_all_is_exit_code_1_with_the_reason(tmp_path: Path) -> None:
    url = f"udp://127.0.0.1:{free_udp_port()}"
    result = run_pmu("characterize", url, "--out", tmp_path / "run", "--duration", 0.5, "--quiet", "--no-report")
    assert result.code == 1
    assert result.complaint.startswith(f"pmu: no data from {url}: nothing came; is the sender on")
    (found,) = told(tmp_path / "run")["streams"]
    assert found["received"] == 0


def test_it_binds_before_it_imports_what_is_slow(tmp_path: Path) -> None:
    """Judged by the reader's start on the same machine."""
    bound_s = []
    for command in ("read", "characterize"):
        port = free_udp_port()
        with started(command, f"udp://127.0.0.1:{port}", "--out", tmp_path / "out.csv", "--duration", 5) as running:
            bound_s.append(wait_for_udp(port, running))
            running.kill()
        (tmp_path / "out.csv").unlink(missing_ok=True)
    assert bound_s[1] < 2 * bound_s[0] + 0.3
