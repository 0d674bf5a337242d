"""Which format a file is: by content, then by suffix; what other programs see in ours; errors of one line."""

from __future__ import annotations

import gzip
import random
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from support.frames import random_stream
from support.recordings import blocks_of, data_of, messages_of, read, write

from pmutools.c37118 import decode_config
from pmutools.errors import SettingsError, SourceError
from pmutools.flow import Flow
from pmutools.formats import FORMATS, open_sink, open_source
from pmutools.formats.parquet import ROW_GROUP_ROWS, ParquetRows
from pmutools.formats.table_rows import wide_schema

STREAM = next(
    stream
    for seed in range(100)
    if (stream := random_stream(random.Random(seed), formats=[0b1110], frames=10, idcode=7, data_rate=50, absent=0.0))
    and stream.spec.stations[0].phasors
)
MESSAGES = messages_of(STREAM)


@pytest.mark.parametrize("suffix", [".pcap", ".pcapng", ".mcap", ".parquet", ".arrow", ".c37118", ".pcap.gz"])
@pytest.mark.parametrize("lie", [".csv", ".bin", "", ".parquet", ".pcap"])
def test_content_is_believed_before_the_suffix(suffix: str, lie: str, tmp_path: Path) -> None:
    honest, lying = tmp_path / f"a{suffix}", tmp_path / f"b{lie}"
    if suffix in (".parquet", ".arrow"):
        write(honest, MESSAGES, phasors="rect")
    else:
        write(honest, MESSAGES)
    honest.rename(lying)
    assert data_of(read(lying)) == list(STREAM.data)


def test_suffixes_in_capitals(tmp_path: Path) -> None:
    write(tmp_path / "A.PMUCAPTURE", MESSAGES)
    write(tmp_path / "A.CSV.GZ", MESSAGES)
    assert open_source(tmp_path / "A.PMUCAPTURE").kind == "raw"
    assert open_source(tmp_path / "A.CSV.GZ").kind == "csv"


def test_a_cut_frame_and_garbage_are_counted_in_raw_files(tmp_path: Path) -> None:
    path = tmp_path / "a.c37118"
    path.write_bytes(b"garbage" + STREAM.config() + b"".join(STREAM.data)[:-1])
    source = open_source(path)
    items = list(source.items())
    assert len(items) == 1 + 1 + 9 + 1
    assert source.tally.skipped_bytes == 7 + len(STREAM.data[0]) - 1
    assert source.tally.fed == path.stat().st_size


def test_raw_data_without_a_configuration_needs_a_known_one(tmp_path: Path) -> None:
    path = tmp_path / "a.c37118"
    path.write_bytes(b"".join(STREAM.data))
    config = decode_config(STREAM.config())[1]
    assert data_of(read(path, [config])) == list(STREAM.data)
    source = open_source(path)
    list(source.items())
    assert source.tally.skipped_bytes == path.stat().st_size


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("missing.csv", None, "No such file"),
        ("a.csv", b"", "empty"),
        ("a.parquet", b"not parquet", "no readable Parquet"),
        ("a.parquet", b"PAR1" + bytes(100), "no readable Parquet"),
        ("a.arrow", b"ARROW1\0\0" + bytes(100), "no readable Arrow"),
        ("a.mcap", b"plain text", "not an MCAP"),
        ("a.pcap", b"plain text, and long enough", "no capture"),
        ("a.csv.gz", b"\x1f\x8b\x08\0", "decompressed"),
    ],
)
def test_unreadable_files_are_one_line(name: str, content: bytes | None, problem: str, tmp_path: Path) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SourceError, match=problem) as raised:
        list(open_source(path).items())
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_unknown_formats_list_the_known(tmp_path: Path) -> None:
    path = tmp_path / "a.xls"
    path.write_bytes(b"whatever this is")
    for attempt in (open_source, open_sink):
        with pytest.raises(SettingsError) as raised:
            attempt(path)
        assert str(path) in str(raised.value)
        forms = [form for form in FORMATS if form.written or attempt is open_source]
        assert all(suffix in str(raised.value) for form in forms for suffix in form.suffixes)


@pytest.mark.parametrize("name", ["a.parquet.gz", "a.mcap.zst", "a.arrow.gz"])
def test_what_is_compressed_in_itself(name: str, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="compressed in itself"):
        open_sink(tmp_path / name)
    plain = tmp_path / name.rpartition(".")[0]
    write(plain, MESSAGES)
    (tmp_path / name).write_bytes(gzip.compress(plain.read_bytes()))
    with pytest.raises(SourceError, match="unpack it first"):
        open_source(tmp_path / name)


def test_importing_the_table_of_formats_is_cheap() -> None:
    heavy = "{'pyarrow', 'mcap', 'scapy', 'google.protobuf'}"
    code = f"import sys, pmutools.formats; sys.exit(bool({heavy} & sys.modules.keys()))"
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == 0


def test_csv_goes_to_standard_output() -> None:
    code = (
        "import sys, random; sys.path[:0] = sys.argv[1:]\n"
        "from support.frames import random_stream\nfrom support.recordings import messages_of, write\n"
        "from pathlib import Path\n"
        "write(Path('-'), messages_of(random_stream(random.Random(4), formats=[0], frames=3, idcode=7)))\n"
        "print('after')"
    )
    command = [sys.executable, "-c", code, str(Path(__file__).parents[1])]
    lines = subprocess.run(command, timeout=60, check=True, capture_output=True, text=True).stdout.splitlines()
    assert lines[0].startswith("time,arrival_ns")
    assert len(lines) == 5
    assert lines[-1] == "after"


@pytest.mark.parametrize("host", ["192.0.2.9", "[2001:db8::9]"])
def test_a_capture_of_connections_whose_other_end_is_unknown(host: str, tmp_path: Path) -> None:
    """As a reader sees them: one after the other, from the same PMU."""
    flows = [Flow("tcp", f"{host}:4712", "", connection) for connection in (0, 1)]
    before = [message for flow in flows for message in messages_of(STREAM, flow=flow)]
    after = read(write(tmp_path / "a.pcapng", before)[0])
    assert [m.frame.data for m in after] == [m.frame.data for m in before]
    assert [(m.flow.source, m.flow.connection) for m in after] == [(m.flow.source, m.flow.connection) for m in before]


def test_a_log_names_each_pmu_once(tmp_path: Path) -> None:
    """Also one that connects again; another of the same name is told apart; a concentrator goes by its IDCODE."""
    pdc = random_stream(random.Random(1), stations=3, frames=2, idcode=60)
    flows = [
        Flow("tcp", "192.0.2.9:4712", ""),
        Flow("tcp", "192.0.2.9:4712", "", 1),
        Flow("tcp", "192.0.2.10:4712", ""),
    ]
    before = [message for flow in flows for message in messages_of(STREAM, flow=flow)]
    (path,) = write(tmp_path / "a.mcap", [*before, *messages_of(pdc)])
    station = STREAM.spec.stations[0].name.under("cfg2")
    counts = Counter(message.flow.source.removeprefix("a.mcap/") for message in read(path))
    assert counts == {station: 22, f"{station}#2": 11, "PDC60": 3}


# --- what other programs see ------------------------------------------------------------------------------------


def test_parquet_columns_have_types_units_and_encodings(tmp_path: Path) -> None:
    from pyarrow import parquet

    (path,) = write(tmp_path / "a.parquet", MESSAGES)
    file = parquet.ParquetFile(path)
    schema = file.schema_arrow
    station = decode_config(STREAM.config())[1].stations[0]
    magnitude = schema.field(f"{station.name}.{station.phasors[0].name}.mag")
    assert magnitude.metadata[b"unit"] == station.phasors[0].kind.replace("I", "A").encode()
    assert [str(schema.field(name).type) for name in ("time_ns", "idcode", "time_quality")] == [
        "int64",
        "uint16",
        "uint8",
    ]
    assert schema.metadata[b"c37118.config"].decode("ascii"), "metadata are text, for readers that insist"
    group = file.metadata.row_group(0)
    encodings = {group.column(k).path_in_schema: group.column(k).encodings for k in range(group.num_columns)}
    assert "BYTE_STREAM_SPLIT" in encodings[magnitude.name]
    assert group.column(0).compression == "ZSTD"


def test_parquet_row_groups_are_bounded(tmp_path: Path) -> None:
    from pyarrow import parquet

    from pmutools.c37118.batch import decode_batch
    from pmutools.formats.output import OutputFile
    from pmutools.formats.table_rows import wide_rows

    config = decode_config(STREAM.config())[1]
    batch = decode_batch(STREAM.data[0] * 10_000, config)
    file = OutputFile(tmp_path / "a.parquet")
    writer = ParquetRows(file, wide_schema(config, "polar"))
    for _ in range(20):
        writer.write(wide_rows(batch, "polar"))
    writer.close()
    file.close()
    metadata = parquet.ParquetFile(file.path).metadata
    sizes = [metadata.row_group(k).num_rows for k in range(metadata.num_row_groups)]
    assert sum(sizes) == 200_000
    assert max(sizes) <= ROW_GROUP_ROWS
    assert np.median(sizes) > ROW_GROUP_ROWS / 2


def test_a_table_edited_elsewhere_still_plays(tmp_path: Path) -> None:
    """Columns left out are absent, columns added are passed over, timestamps and 32-bit floats are understood."""
    import pyarrow as pa
    from pyarrow import parquet

    (path,) = write(tmp_path / "a.parquet", MESSAGES)
    table = parquet.read_table(path)
    station = decode_config(STREAM.config())[1].stations[0]
    left_out = f"{station.name}.rocof_hz_s"
    stamps = table.column("time_ns").cast(pa.timestamp("ns", "UTC"))
    table = table.drop_columns([left_out, "time_ns"]).append_column("time", stamps)
    table = table.append_column("note", pa.array(["edited"] * len(table)))
    frequency = f"{station.name}.freq_hz"
    at = table.schema.get_field_index(frequency)
    table = table.set_column(at, frequency, table.column(frequency).cast(pa.float32()))
    parquet.write_table(table, path)
    (block,) = blocks_of(open_source(path))
    batch = block.batch
    assert batch.config == decode_config(STREAM.config())[1]
    assert len(batch) == 10
    assert np.isnan(batch.rocof).all()
    assert [item["time_ns"] for item in STREAM.expected_data()] == batch.time_ns.tolist()
    expected = [item["stations"][0]["frequency"] for item in STREAM.expected_data()]
    assert batch.frequency[:, 0].tolist() == pytest.approx(expected)


def test_a_table_without_metadata_is_inferred(tmp_path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    path = tmp_path / "bus.parquet"
    columns = {"time_ns": [10**18, 10**18 + 10**8, None], "N1.V.mag": [1.0, None, 3.0], "N1.V.deg": [0.0, 0.0, 0.0]}
    parquet.write_table(pa.table(columns), path)
    source = open_source(path)
    (block,) = blocks_of(source)
    batch = block.batch
    assert (batch.config.idcode, batch.config.data_rate) == (1, 10)
    assert batch.valid[:, 0].tolist() == [True, False]
    assert batch.stat[:, 0].tolist() == [0, 0x8000]
    assert source.defects() == {"rows without a time": 1}


@pytest.mark.parametrize("suffix", [".parquet", ".arrow"])
def test_tables_without_a_time_or_rows_are_one_line(suffix: str, tmp_path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    for number, (table, problem) in enumerate(
        [(pa.table({"a": [1]}), "no column time_ns"), (pa.table({"time_ns": pa.array([], pa.int64())}), "no rows")]
    ):
        path = tmp_path / f"{number}{suffix}"
        if suffix == ".parquet":
            parquet.write_table(table, path)
        else:
            with pa.ipc.new_file(path, table.schema) as file:
                file.write_table(table)
        with pytest.raises(SourceError, match=problem):
            open_source(path)


def test_arrow_streams_without_the_files_frame(tmp_path: Path) -> None:
    import pyarrow as pa

    (path,) = write(tmp_path / "a.arrow", MESSAGES, phasors="rect")
    table = pa.ipc.open_file(path).read_all()
    with pa.ipc.new_stream(tmp_path / "b.arrow", table.schema) as stream:
        stream.write_table(table)
    assert data_of(read(tmp_path / "b.arrow")) == list(STREAM.data)
