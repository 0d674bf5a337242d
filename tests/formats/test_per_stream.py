"""One file a stream, in a folder, for every format; names given by who opens the sink."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from support.frames import random_stream
from support.recordings import data_of, messages_of, read, write

from pmutools.c37118 import Message
from pmutools.c37118.config import StreamConfig
from pmutools.errors import SettingsError
from pmutools.flow import Flow
from pmutools.formats import open_sink

SUFFIXES = (".csv", ".parquet", ".arrow", ".mcap", ".jsonl", ".pcap", ".pcapng.gz", ".c37118", ".c37118.zst")


def stream(idcode: int) -> list[Message]:
    described = random_stream(
        random.Random(1), formats=[0b1110], idcode=idcode, data_rate=50, time_base=1_000_000, frames=10, absent=0.0
    )
    return messages_of(described, flow=Flow("udp", f"192.0.2.{idcode}:4713", "192.0.2.1:4713"))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_each_stream_has_its_file_from_the_first_on(suffix: str, tmp_path: Path) -> None:
    streams = [stream(7), stream(8)]
    mixed = [message for pair in zip(*streams, strict=True) for message in pair]
    for count in (1, 2):
        out = tmp_path / f"out{count}{suffix}"
        paths = (
            write(out, streams[0] if count == 1 else mixed, per_stream=True, phasors="rect")
            if (suffix in (".csv", ".parquet", ".arrow"))
            else write(out, streams[0] if count == 1 else mixed, per_stream=True)
        )
        assert [path.name for path in paths] == [f"STATION_0-{7 + k}{suffix}" for k in range(count)]
        assert {path.parent for path in paths} == {tmp_path / f"out{count}"}
        for path, messages in zip(paths, streams, strict=False):
            assert data_of(read(path)) == data_of(messages)
        assert sorted(data_of(read(tmp_path / f"out{count}"))) == sorted(
            data_of([message for each in streams[:count] for message in each])
        )


@pytest.mark.parametrize("suffix", [".csv", ".pcap"])
def test_names_are_given_and_stay_unique(suffix: str, tmp_path: Path) -> None:
    def name(flow: Flow, config: StreamConfig) -> str:
        return "SITE"

    paths = write(tmp_path / f"out{suffix}", [*stream(7), *stream(8)], per_stream=True, name=name)
    assert [path.name for path in paths] == [f"SITE{suffix}", f"SITE-2{suffix}"]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_nothing_is_left_where_nothing_came(suffix: str, tmp_path: Path) -> None:
    assert write(tmp_path / f"out{suffix}", [], per_stream=True) == []
    assert list(tmp_path.iterdir()) == []


def test_frames_before_a_configuration_wait_for_the_name(tmp_path: Path) -> None:
    opening, *data = stream(7)
    early = opening._replace(frame=opening.frame, config=None)
    (path,) = write(tmp_path / "out.c37118", [early, opening, *data], per_stream=True)
    assert path.name == "STATION_0-7.c37118"
    assert len(read(path)) == 12
    (path,) = write(tmp_path / "other.c37118", [early], per_stream=True)
    assert path.name == "stream-7.c37118"


def test_what_does_not_go_together(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="standard output"):
        open_sink("-", per_stream=True)
    with pytest.raises(SettingsError, match="choose one"):
        open_sink(tmp_path / "a.csv", per_stream=True, long=True)
