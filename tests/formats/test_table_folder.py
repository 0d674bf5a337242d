"""Several streams: tables side by side in a folder, one source when read again; and tables in long form."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest
from support.frames import random_stream
from support.recordings import STEP_NS, blocks_of, data_of, messages_of, read, write

from pmutools.c37118 import FrameType, Message
from pmutools.errors import SourceError
from pmutools.flow import Flow
from pmutools.formats import open_sink, open_source
from pmutools.formats.source import Block, gather

T0 = 1_700_000_000 * 10**9


def stream(
    idcode: int, port: int = 4713, *, first_ns: int | None = T0, connection: int = 0, seed: int = 1
) -> list[Message]:
    """One station called STATION 0, rectangular floats, 50 a second; stamps and arrivals are unrelated."""
    options: dict[str, Any] = {"frames": 20, "absent": 0.0, "data_rate": 50, "time_base": 1_000_000}
    described = random_stream(random.Random(seed), formats=[0b1110], idcode=idcode, **options)
    flow = Flow("tcp", f"192.0.2.11:{port}", "192.0.2.1:4801", connection)
    return messages_of(described, flow=flow, first_ns=first_ns)


def names(paths: list[Path]) -> list[str]:
    return sorted(path.name for path in paths)


def test_one_stream_is_one_file(tmp_path: Path) -> None:
    assert write(tmp_path / "out.csv", stream(7)) == [tmp_path / "out.csv"]
    assert list(tmp_path.iterdir()) == [tmp_path / "out.csv"]


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz", ".parquet", ".arrow"])
def test_several_streams_lie_side_by_side(suffix: str, tmp_path: Path) -> None:
    """The file that the first stream was begun in moves in with the others, and goes on."""
    one, two = stream(7), stream(8)
    paths = write(tmp_path / f"out{suffix}", [*one[:5], *two, *one[5:]], phasors="rect")
    assert list(tmp_path.iterdir()) == [tmp_path / "out"]
    assert names(paths) == names(list((tmp_path / "out").iterdir())) == [f"STATION_0-{k}{suffix}" for k in (7, 8)]
    back = read(tmp_path / "out")
    assert sorted(data_of(back)) == sorted(data_of([*one, *two]))


def test_what_makes_a_stream(tmp_path: Path) -> None:
    """A flow, an IDCODE, a configuration; but not the connection between the same two endpoints."""
    same = stream(7), stream(7, connection=1)
    assert len(write(tmp_path / "same.csv", [*same[0], *same[1]])) == 1
    other_flow = write(tmp_path / "flow.csv", [*stream(7), *stream(7, 4714)])
    other_config = write(tmp_path / "config.csv", [*stream(7), *stream(7, seed=2)])
    for paths in (other_flow, other_config):
        assert names(paths) == ["STATION_0-7-2.csv", "STATION_0-7.csv"]


def test_where_open_files_cannot_be_moved_it_happens_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(source: Path, target: Path) -> None:
        raise PermissionError(13, "The file is in use")

    one, two = stream(7), stream(8)
    with open_sink(tmp_path / "out.csv") as sink, monkeypatch.context() as windows:
        windows.setattr("pmutools.formats.output.os.replace", refuse)
        for block in gather([*one[:5], *two, *one[5:]]):
            sink.write(block)  # type: ignore[arg-type]
        assert (tmp_path / "out.csv").exists()
        windows.undo()
    assert names(sink.paths) == names(list((tmp_path / "out").iterdir())) == ["STATION_0-7.csv", "STATION_0-8.csv"]
    assert len(data_of(read(tmp_path / "out"))) == 40


def test_names_are_safe_for_file_systems(tmp_path: Path) -> None:
    (tmp_path / "in.csv").write_text(
        'time,idcode,"../a: b?.freq_hz"\n2024-01-01T00:00:00Z,1,50\n2024-01-01T00:00:01Z,2,50\n'
    )
    source = open_source(tmp_path / "in.csv")
    with open_sink(tmp_path / "out.csv") as sink:
        for block in source.blocks():
            sink.write(block)  # type: ignore[arg-type]
    assert names(sink.paths) == ["a_b-1.csv", "a_b-2.csv"]


def test_nothing_of_the_users_is_overwritten_or_mixed(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "precious.csv").write_text("mine")
    paths = write(tmp_path / "out.csv", [*stream(7), *stream(8)])
    assert {path.parent for path in paths} == {tmp_path / "out-2"}
    assert (tmp_path / "out" / "precious.csv").read_text() == "mine"
    write(tmp_path / "out.csv", stream(7))
    assert (tmp_path / "out.csv").exists()


def test_a_sink_without_data_leaves_no_file(tmp_path: Path) -> None:
    assert write(tmp_path / "out.parquet", stream(7)[:1]) == []
    assert list(tmp_path.iterdir()) == []


# --- a folder as a source ---------------------------------------------------------------------------------------


def arrivals(path: Path) -> list[int | None]:
    return [m.frame.arrival_ns for m in read(path) if m.frame.type is FrameType.DATA]


def test_a_folder_is_read_in_order_of_arrival(tmp_path: Path) -> None:
    streams = [stream(idcode, first_ns=T0 + idcode * 1_000_000, seed=idcode) for idcode in (9, 7, 8)]
    write(tmp_path / "out.arrow", [message for each in streams for message in each])
    found = arrivals(tmp_path / "out")
    assert found == sorted(found, key=lambda arrival: arrival or 0)
    assert found[:3] == [T0 + STEP_NS + idcode * 1_000_000 for idcode in (7, 8, 9)]
    source = open_source(tmp_path / "out")
    assert source.kind == "folder"
    firsts = [int(block.batch.arrival_ns[0]) for block in blocks_of(source)]
    assert firsts == sorted(firsts)
    assert source.tally.frames == {FrameType.DATA: 60}
    assert source.tally.fed == source.tally.framed > 0


def test_without_arrivals_it_is_read_in_order_of_stamps(tmp_path: Path) -> None:
    """Also if only one of the streams lacks them."""
    streams = [stream(7), stream(8, first_ns=None, seed=2)]
    write(tmp_path / "out.csv", [message for each in streams for message in each])
    batches = [block.batch for block in blocks_of(open_source(tmp_path / "out"))]
    early = min(batches, key=lambda batch: batch.time_ns[0]).config.idcode
    found = [m.frame.idcode for m in read(tmp_path / "out") if m.frame.type is FrameType.DATA]
    assert found == [early] * 20 + [15 - early] * 20


def test_formats_may_be_mixed_and_other_files_are_left_alone(tmp_path: Path) -> None:
    write(tmp_path / "a.parquet", stream(7))
    write(tmp_path / "b.c37118", stream(8))
    (tmp_path / "README.md").write_text("about")
    (tmp_path / "sub").mkdir()
    assert {m.frame.idcode for m in read(tmp_path)} == {7, 8}


def test_defects_name_their_file(tmp_path: Path) -> None:
    write(tmp_path / "a.csv", stream(7))
    (tmp_path / "b.csv").write_text("time,N.freq_hz\n2024-01-01T00:00:00Z,sixty\n")
    source = open_source(tmp_path)
    assert list(source.items())
    assert source.defects() == {"b.csv: unreadable cells": 1}


def test_an_empty_folder_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="folder without recordings"):
        open_source(tmp_path)


# --- long form --------------------------------------------------------------------------------------------------


def test_long_form_has_one_row_a_value_in_one_file(tmp_path: Path) -> None:
    (tmp_path / "in.csv").write_text(
        "time,idcode,N1.freq_hz,N1.V.mag,N1.V.deg,N1.P\n"
        "2024-01-01T00:00:00Z,1,50,100,-90,\n2024-01-01T00:00:00.1Z,2,50.5,101,-31,7\n"
    )
    out = tmp_path / "out.csv"
    with open_sink(out, long=True) as sink:
        for block in open_source(tmp_path / "in.csv").blocks():
            assert isinstance(block, Block)
            sink.write(block)
    assert sink.paths == [out]
    lines = out.read_text().splitlines()
    assert lines[0] == "time,arrival_ns,stamp_source,idcode,time_quality,station,channel,quantity,value"
    assert len(lines) == 1 + 2 * 6
    assert lines[1:7] == [
        f'"2024-01-01T00:00:00.000000000Z",,"capture",1,0,"N1",{rest}'
        for rest in (',"stat",0', ',"freq_hz",50', ',"rocof_hz_s",', '"V","mag",100', '"V","deg",-90', '"P","analog",')
    ]


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".arrow"])
def test_long_form_holds_all_values_and_does_not_play_back(suffix: str, tmp_path: Path) -> None:
    messages = [*stream(7), *stream(8, seed=3)]
    (path,) = write(tmp_path / f"out{suffix}", messages, long=True, phasors="rect")
    with pytest.raises(SourceError, match="long form"):
        open_source(path)
    if suffix == ".csv":
        return
    rows = rows_of(path)
    for block in gather(messages):
        if isinstance(block, Block):
            batch, station = block.batch, block.batch.config.stations[0]
            for number, phasor in enumerate(station.phasors):
                found = [row["value"] for row in rows[batch.config.idcode, phasor.name, "re"]]
                assert found == batch.phasors[:, number].real.tolist()
            found = [row["value"] for row in rows[batch.config.idcode, None, "freq_hz"]]
            assert found == batch.frequency[:, 0].tolist()


def rows_of(path: Path) -> dict[tuple[int, str | None, str], list[dict[str, Any]]]:
    import pyarrow as pa
    from pyarrow import parquet

    table = parquet.read_table(path) if path.suffix == ".parquet" else pa.ipc.open_file(path).read_all()
    found: dict[tuple[int, str | None, str], list[dict[str, Any]]] = {}
    for row in table.to_pylist():
        found.setdefault((row["idcode"], row["channel"], row["quantity"]), []).append(row)
    return found


# --- memory ------------------------------------------------------------------------------------------------------


def test_what_waits_in_memory_is_written_when_it_is_too_much(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Though that makes small row groups; without it, these would be one."""
    from pyarrow import parquet

    monkeypatch.setattr("pmutools.formats.table_sink.HELD_BYTES", 1000)
    with open_sink(tmp_path / "out.parquet") as sink:
        for block in gather(stream(7), 5):
            if isinstance(block, Block):
                sink.write(block)
                sink.flush()
    assert parquet.ParquetFile(tmp_path / "out.parquet").num_row_groups == 4
    assert len(data_of(read(tmp_path / "out.parquet"))) == 20
