"""The journal beside a Parquet recording: all frames to the last flush, for all streams; gone when it is finished."""

from __future__ import annotations

import random
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.frames import random_stream
from support.recordings import blocks_of, data_of, messages_of, write

from pmutools.c37118 import Message
from pmutools.c37118.batch import NO_TIME
from pmutools.errors import SourceError
from pmutools.flow import Flow, StampSource
from pmutools.formats import open_sink, open_source
from pmutools.formats.source import Block, gather
from pmutools.tools.inventory import take_inventory

OPTIONS: dict[str, Any] = {"data_rate": 50, "time_base": 1_000_000, "frames": 30}


def stream(idcode: int) -> list[Message]:
    described = random_stream(random.Random(idcode), stations=2, idcode=idcode, **OPTIONS)
    return messages_of(described, flow=Flow("udp", f"192.0.2.{idcode}:4713", "192.0.2.1:4713"))


def blocks(messages: list[Message]) -> list[Block]:
    return [item for item in gather(messages, 10) if isinstance(item, Block)]


def killed(tmp_path: Path, messages: list[Message], **options: Any) -> Path:
    """A copy of what is on the disk after a flush, while the recording goes on."""
    place, copy = tmp_path / "live", tmp_path / "killed"
    place.mkdir()
    with open_sink(place / "log.parquet", journal=True, **options) as sink:
        for block in blocks(messages):
            sink.write(block)
        sink.flush()
        shutil.copytree(place, copy)
    assert not list(place.rglob("*.journal")), "it goes when the recording is finished"
    assert all(path.exists() for path in sink.paths)
    return copy


def frames_in(path: Path) -> list[bytes]:
    return data_of(item for item in open_source(path).items() if isinstance(item, Message))


@pytest.mark.parametrize("options", [{}, {"long": True}, {"phasors": "rect"}], ids=str)
def test_one_stream_is_read_by_the_name_of_its_file(options: dict[str, Any], tmp_path: Path) -> None:
    messages = stream(7)
    place = killed(tmp_path, messages, **options)
    source = open_source(place / "log.parquet")
    assert source.kind == "journal"
    assert data_of(item for item in source.items() if isinstance(item, Message)) == data_of(messages)
    assert source.defects() == {"recording without an end": 1}
    assert frames_in(place) == data_of(messages)


@pytest.mark.parametrize("per_stream", [False, True])
def test_several_streams_are_read_by_the_folder_of_their_files(per_stream: bool, tmp_path: Path) -> None:
    one, two = stream(7), stream(8)
    place = killed(tmp_path, [*one[:12], *two, *one[12:]], per_stream=per_stream)
    folder = place / "log"
    if per_stream:
        assert (place / "log.parquet.journal").exists() or list(folder.glob("*.journal"))
    assert sorted(frames_in(folder)) == sorted(data_of([*one, *two]))
    found = {each.idcode: each.frames for each in take_inventory(open_source(folder)).streams}
    assert found == {7: 30, 8: 30}
    (table,) = [path for path in folder.iterdir() if path.name.endswith("-7.parquet")]
    with pytest.raises(SourceError, match=r"never finished; its frames are in .*log\.parquet\.journal"):
        open_source(table)


def test_arrivals_flows_and_who_stamped_are_kept(tmp_path: Path) -> None:
    messages = stream(7)
    changed = [
        message._replace(
            frame=message.frame._replace(
                stamp_source=StampSource.KERNEL_BATCHED if k % 3 else StampSource.KERNEL,
                arrival_ns=None if k == 5 else message.frame.arrival_ns,
            )
        )
        for k, message in enumerate(messages)
    ]
    place = killed(tmp_path, changed)
    before, after = blocks(changed), blocks_of(open_source(place / "log.parquet"))
    for name in ("time_ns", "arrival_ns", "stamp_source", "stat", "frequency"):
        expected = np.concatenate([getattr(block.batch, name) for block in before])
        found = np.concatenate([getattr(block.batch, name) for block in after])
        assert np.array_equal(expected, found, equal_nan=name == "frequency"), name
    assert {block.flow for block in after} == {messages[0].flow}
    assert NO_TIME in np.concatenate([block.batch.arrival_ns for block in after])


def test_a_journal_is_read_up_to_a_cut(tmp_path: Path) -> None:
    messages = stream(7)
    journal = killed(tmp_path, messages) / "log.parquet.journal"
    whole = journal.read_bytes()
    for size in range(0, len(whole), 97):
        journal.write_bytes(whole[:size])
        try:
            found = frames_in(journal)
        except SourceError as error:
            assert "\n" not in str(error)
            continue
        assert found == data_of(messages)[: len(found)]


def test_a_finished_recording_needs_none(tmp_path: Path) -> None:
    """Even if one is left beside it, by a writer that was killed between the two."""
    place = killed(tmp_path, stream(7))
    write(place / "log.parquet", stream(7))
    assert open_source(place / "log.parquet").kind == "parquet"


def test_a_finished_table_beside_an_unfinished_one_is_read_too(tmp_path: Path) -> None:
    place = killed(tmp_path, stream(7))
    write(place / "other.parquet", stream(8))
    assert sorted({item.frame.idcode for item in open_source(place).items() if isinstance(item, Message)}) == [7, 8]


def test_frames_of_tables_that_a_full_disk_let_finish_are_not_read_twice(tmp_path: Path) -> None:
    """Closing has failed at a later table: the journal stays, with the frames of all."""
    messages = stream(7) + stream(8)
    place = tmp_path / "live"
    place.mkdir()
    with open_sink(place / "log.parquet", journal=True, per_stream=True) as sink:
        for block in blocks(messages):
            sink.write(block)
        sink.flush()
        (journal,) = place.rglob("*.journal")
        kept = journal.read_bytes()
    journal.write_bytes(kept)
    sink.paths[-1].unlink()
    assert sorted(frames_in(journal.parent)) == sorted(data_of(messages))


def test_other_arrow_streams_are_no_journals(tmp_path: Path) -> None:
    import pyarrow as pa

    path = tmp_path / "a.journal"
    with pa.OSFile(str(path), "wb") as file, pa.ipc.new_stream(file, pa.schema([("x", pa.int8())])):
        pass
    with pytest.raises(SourceError, match="no journal of frames"):
        open_source(path)


def test_conversions_keep_none(tmp_path: Path) -> None:
    with open_sink(tmp_path / "a.parquet") as sink:
        for block in blocks(stream(7)):
            sink.write(block)
        sink.flush()
        assert [path.name for path in tmp_path.iterdir()] == ["a.parquet"]
