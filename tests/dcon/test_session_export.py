"""``dcon export``: the documented columns, the log's values, whatever the format."""

from __future__ import annotations

import csv
import gzip
import itertools
import json
import math
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.sessions import (
    FLAGS,
    INSTANCES,
    PERIOD_NS,
    PMUS,
    T0,
    Tick,
    bits,
    log_tick,
    log_watchdog,
    open_session,
    random_ticks,
    write_session,
)

from dcon.export import export as export_module
from dcon.export.export import export
from dcon.export.tables import TABLES
from dcon.session.codec import Watchdog
from pmutools.errors import SettingsError, SourceError
from pmutools.schema.messages import MESSAGES

FIRST = [
    *("tick_ns", "state", "mode", "active_instance", "gain_mw_per_mhz", "delta_f_mhz", "command_mw"),
    *("output_v", "pdci_mw", "flags"),
    *(f"f_{name}_hz" for name in PMUS),
    *(f"age_{name}_ms" for name in PMUS),
    "compute_us",
    "late_us",
]
ADDED = ["probe_mw"]
TICKS = random_ticks(150)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_session(tmp_path_factory.mktemp("session") / "s.mcap", TICKS)


def none_if_nan(value: float | None) -> float | None:
    return None if value is None or math.isnan(value) else value


def value(order: Any) -> Any:
    """Only a gain is 0 by being ordered so."""
    return None if order.name != "gain" and order.value == 0 else order.value


def cell(value: Any) -> Any:
    """As a table has it: what is not known, or not said, is null."""
    return none_if_nan(value) if isinstance(value, float) else None if value == "" else value


def expected_tick(tick: Tick) -> dict[str, Any]:
    record = tick.record
    return {
        "tick_ns": record.tick_ns,
        "state": str(record.state),
        "mode": str(record.mode),
        "active_instance": None if record.active is None else INSTANCES[record.active],
        "gain_mw_per_mhz": record.gain_mw_per_mhz,
        "delta_f_mhz": none_if_nan(record.delta_f_mhz),
        "command_mw": record.command_mw,
        "output_v": record.output_v,
        "pdci_mw": None if tick.pdci is None else none_if_nan(tick.pdci.power_mw),
        "flags": record.flags,
        **{f"f_{name}_hz": none_if_nan(value) for name, value in zip(PMUS, record.f_hz, strict=True)},
        **{f"age_{name}_ms": none_if_nan(value) for name, value in zip(PMUS, record.age_ms, strict=True)},
        "compute_us": None if tick.timing is None else none_if_nan(tick.timing.compute_us),
        "late_us": None if tick.timing is None else none_if_nan(tick.timing.late_us),
        "probe_mw": none_if_nan(record.probe_mw),
    }


def exact(rows: list[dict[str, Any]]) -> list[object]:
    return [bits(tuple(row.items())) for row in rows]


def read_csv(path: Path, columns: dict[str, str]) -> list[dict[str, Any]]:
    """Rows with values of the types that Parquet gave the columns."""
    parsers: dict[str, Any] = {"double": float, "string": str, "bool": lambda text: text == "true"}
    data = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
    return [
        {key: None if text == "" else parsers.get(columns[key], int)(text) for key, text in row.items()}
        for row in csv.DictReader(data.decode("utf-8").splitlines())
    ]


@pytest.mark.parametrize("suffix", [".parquet", ".arrow", ".csv", ".csv.gz", ".jsonl"])
@pytest.mark.parametrize("table", ["tick", "instance", "pmu", "event", "flag", "setting", "timing", "pdci"])
def test_every_format_holds_the_same_rows(
    session: Path, tmp_path: Path, table: str, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export_module, "BATCH_ROWS", 64)  # several row groups
    reference = tmp_path / "reference.parquet"
    summary = export(session, reference, table)
    rows = pq.read_table(reference).to_pylist()
    assert summary.rows == len(rows) > 64 and summary.gaps == 0 and not summary.damage
    assert pq.ParquetFile(reference).metadata.num_row_groups == math.ceil(len(rows) / 64)

    out = tmp_path / f"out{suffix}"
    assert export(session, out, table).rows == len(rows)
    if suffix == ".parquet":
        other = pq.read_table(out).to_pylist()
    elif suffix == ".arrow":
        other = pa.ipc.open_file(str(out)).read_all().to_pylist()
    elif suffix == ".jsonl":
        other = [json.loads(line) for line in out.read_text("utf-8").splitlines()]
        rows = [{key: None if value in (math.inf, -math.inf) else value for key, value in row.items()} for row in rows]
    else:
        other = read_csv(out, {field.name: str(field.type) for field in pq.read_schema(reference)})
    assert exact(other) == exact(rows)


def test_tick_columns_are_the_documented_ones(session: Path, tmp_path: Path) -> None:
    out = tmp_path / "t.parquet"
    export(session, out)
    schema = pq.read_schema(out)
    assert schema.names == FIRST + ADDED
    assert schema.field("flags").type == pa.uint64()
    assert schema.field("tick_ns").type == pa.int64()
    assert not schema.field("command_mw").nullable
    assert json.loads(schema.metadata[b"flags"]) == list(FLAGS)
    assert json.loads(schema.metadata[b"session"])["scenario"] == "cjb"


def test_tick_rows_are_the_records_bit_for_bit(session: Path, tmp_path: Path) -> None:
    out = tmp_path / "t.parquet"
    export(session, out)
    table = pq.read_table(out)
    assert exact(table.to_pylist()) == exact([expected_tick(tick) for tick in TICKS])
    assert table["command_mw"].null_count == 0
    ticks = table["tick_ns"].to_pylist()
    assert all(b - a == PERIOD_NS for a, b in itertools.pairwise(ticks))


def test_instance_rows(session: Path, tmp_path: Path) -> None:
    export(session, tmp_path / "i.parquet", "instance")
    expected = [
        {
            "tick_ns": tick.record.tick_ns,
            "instance": name,
            "state": str(instance.state),
            "active": instance.active,
            "delta_f_mhz": none_if_nan(instance.delta_f_mhz),
            "command_mw": none_if_nan(instance.command_mw),
            "reason": instance.reason or None,
        }
        for tick in TICKS
        for name, instance in zip(INSTANCES, tick.record.instances, strict=True)
    ]
    assert exact(pq.read_table(tmp_path / "i.parquet").to_pylist()) == exact(expected)


def test_pmu_rows(session: Path, tmp_path: Path) -> None:
    export(session, tmp_path / "p.parquet", "pmu")
    rows = pq.read_table(tmp_path / "p.parquet").to_pylist()
    frames = [frame for tick in TICKS for frame in tick.frames]
    plain = ["time_ns", "arrival_ns", "tick_ns", "pmu", "stamp_source", "stat", "time_quality"]
    assert [[row[key] for key in plain] for row in rows] == [
        [f.time_ns, f.arrival_ns, f.tick_ns, f.name, str(f.stamp_source), f.stat, f.time_quality] for f in frames
    ]
    for row, frame in zip(rows, frames, strict=True):
        assert bits(row["freq_hz"]) == bits(none_if_nan(frame.frequency_hz))
        assert bits(row["rocof_hz_s"]) == bits(none_if_nan(frame.rocof_hz_s))
        if row["v1.mag"] is not None and row["v1.deg"] is not None and math.isfinite(row["v1.mag"]):
            angle = math.radians(row["v1.deg"])
            scale = max(abs(frame.v1), 1e-300)
            assert row["v1.mag"] * math.cos(angle) == pytest.approx(frame.v1.real, abs=1e-12 * scale)
            assert row["v1.mag"] * math.sin(angle) == pytest.approx(frame.v1.imag, abs=1e-12 * scale)


def test_event_rows(session: Path, tmp_path: Path) -> None:
    export(session, tmp_path / "e.parquet", "event")
    expected = []
    for tick in TICKS:
        at = tick.record.tick_ns
        expected += [(at, "order", order.name, None, None, none_if_nan(value(order))) for order in tick.orders]
        expected += [(at, "event", e.name, e.subject, e.detail, None) for e in tick.record.events]
    rows = pq.read_table(tmp_path / "e.parquet").to_pylist()
    assert bits(tuple(tuple(row.values()) for row in rows)) == bits(tuple(expected))


def test_flag_rows_are_the_changes_of_the_register(session: Path, tmp_path: Path) -> None:
    export(session, tmp_path / "f.parquet", "flag")
    expected = [(tick.record.tick_ns, *map(cell, flag)) for tick in TICKS for flag in tick.record.flag_changes]
    rows = pq.read_table(tmp_path / "f.parquet").to_pylist()
    assert expected
    assert bits(tuple(tuple(row.values()) for row in rows)) == bits(tuple(expected))
    assert list(rows[0]) == [
        *("tick_ns", "name", "subject", "up", "first_ns", "last_ns", "times", "value", "limit", "latched"),
        "acknowledged",
    ]


def test_messages_as_they_are(session: Path, tmp_path: Path) -> None:
    for table, values in (
        ("setting", [(t.record.tick_ns, *map(cell, o._replace(value=value(o)))) for t in TICKS for o in t.orders]),
        ("timing", [(t.record.tick_ns, *map(none_if_nan, t.timing)) for t in TICKS if t.timing]),
        (
            "pdci",
            [(t.record.tick_ns, *map(cell, p)) for t in TICKS if (p := t.pdci or t.surroundings.pdci)],
        ),
    ):
        out = tmp_path / f"{table}.parquet"
        assert export(session, out, table).rows == len(values) > 50
        assert exact(pq.read_table(out).to_pylist()) == [
            tuple((name, bits(value)) for name, value in zip(pq.read_schema(out).names, row, strict=True))
            for row in values
        ]


def test_the_watchdogs_table(tmp_path: Path) -> None:
    with open_session(tmp_path / "s.mcap") as log:
        log_watchdog(log, Watchdog(T0, False, estop=True, reason="E-stop", heartbeats=(("control", 3.5), ("udp", 1.0))))
        log_tick(log, TICKS[0].record)
        log_watchdog(log, Watchdog(T0 + 5, True))
    assert export(tmp_path / "s.mcap", tmp_path / "w.jsonl", "watchdog").rows == 2
    first, last = map(json.loads, (tmp_path / "w.jsonl").read_text().splitlines())
    assert first == {
        "time_ns": T0,
        "relays_closed": False,
        "estop": True,
        "latched": False,
        "reason": "E-stop",
        "heartbeat": '["control", "udp"]',
        "heartbeat_age_ms": "[3.5, 1.0]",
        "silent": False,
    }
    assert (last["time_ns"], last["relays_closed"], last["heartbeat"]) == (T0 + 5, True, "[]")


def test_every_topic_has_its_table() -> None:
    topics = {message.topic.rpartition("/")[2] for message in MESSAGES.values()} - {"frame"}
    assert set(TABLES) == topics | {"pmu"}


def test_a_damaged_log_exports_every_table(session: Path, tmp_path: Path) -> None:
    data = bytearray(session.read_bytes())
    at = data.index(b"\x04\x00\x00\x00zstd", len(data) // 4) + 500
    data[at : at + 3] = b"rot"
    (tmp_path / "damaged.mcap").write_bytes(bytes(data[:-2000]))
    for table in TABLES:
        summary = export(tmp_path / "damaged.mcap", tmp_path / f"{table}.csv", table)
        assert summary.damage.cut and summary.damage.records == 1
        if table in ("watchdog", "checkpoint"):  # none are there, or none on both sides of the damage
            assert summary.gaps == 0 == summary.rows
        else:
            assert summary.gaps == 1 and summary.rows > 10


def test_gaps_are_counted(session: Path, tmp_path: Path) -> None:
    data = bytearray(session.read_bytes())
    at = data.index(b"\x04\x00\x00\x00zstd", len(data) // 4) + 500
    data[at : at + 3] = b"rot"
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(bytes(data))
    summary = export(damaged, tmp_path / "t.csv")
    assert 85 <= summary.rows <= 95 and summary.gaps == 1 and summary.damage.records == 1


def test_mistakes_are_one_line_and_write_nothing(session: Path, tmp_path: Path) -> None:
    out = tmp_path / "t.parquet"
    with pytest.raises(SettingsError, match="no table 'ticks'; there are tick, instance, pmu, event, setting"):
        export(session, out, "ticks")
    with pytest.raises(SettingsError, match=r"t\.xlsx: unknown suffix '\.xlsx'; use one of \.csv, "):
        export(session, tmp_path / "t.xlsx")
    with pytest.raises(SettingsError, match="unknown suffix"):
        export(session, tmp_path / "t.parquet.gz")
    with pytest.raises(SourceError, match="No such file"):
        export(tmp_path / "none.mcap", out)
    with pytest.raises(SourceError, match="holds no tick"):
        export(write_session(tmp_path / "empty.mcap", []), out)
    assert not out.exists()
    for suffix in ("csv", "jsonl", "parquet", "arrow"):
        with pytest.raises(SourceError, match=rf"t\.{suffix}: cannot write: No such file or directory"):
            export(session, tmp_path / "nowhere" / f"t.{suffix}")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("suffix", ["csv", "jsonl", "csv.gz", "parquet", "arrow"])
def test_a_full_disk_is_one_line(session: Path, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"t.{suffix}"
    out.symlink_to("/dev/full")
    with pytest.raises(SourceError, match="cannot write: No space left on device"):
        export(session, out)
