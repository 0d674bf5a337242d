"""Numbered recordings: each complete in itself, nothing lost between them, nothing of the user's touched."""

from __future__ import annotations

from itertools import chain
from pathlib import Path
from typing import Any

import pytest
from support.reading import START_NS, Item, Rounds, rounds_of, stamps_in, stream

from pmutools.formats import open_sink, open_source
from pmutools.timebase import NS
from pmutools.tools.reader import read
from pmutools.tools.reader.rolling import Rolling
from pmutools.tools.reader.split import Split, parse_split

CONFIG = stream(7)
SUFFIXES = (".csv", ".parquet", ".arrow", ".mcap", ".jsonl", ".pcapng", ".c37118", ".c37118.zst")


def roll(out: Path, given: list[list[Item]], split: Split, **options: Any) -> list[Path]:
    source = Rounds(given)
    keep = options.pop("keep", None)
    rolling = Rolling(
        out, lambda path: open_sink(path, journal=True, **options), split, source.clock.realtime_ns, keep=keep
    )
    read(source, rolling)  # type: ignore[arg-type]
    rolling.close()
    rolling.close()
    return rolling.paths


@pytest.mark.parametrize(
    ("text", "split"),
    [
        ("100MB", Split(100_000_000, None)),
        ("1h", Split(None, 3600 * NS)),
        ("100MB,1h", Split(100_000_000, 3600 * NS)),
        ("1.5 MiB, 90s", Split(1_572_864, 90 * NS)),
        ("15min", Split(None, 900 * NS)),
        ("2gb", Split(2_000_000_000, None)),
        ("1d", Split(None, 86400 * NS)),
    ],
)
def test_sizes_and_spans(text: str, split: Split) -> None:
    assert parse_split(text) == split


@pytest.mark.parametrize("text", ["", "100", "1 week", "1h,2h", "1MB,2MB", "-1h", "0s", "MB", "1h,,"])
def test_what_is_neither(text: str) -> None:
    with pytest.raises(ValueError, match=r"\S"):
        parse_split(text)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_files_end_at_multiples_of_utc_and_play_alone(suffix: str, tmp_path: Path) -> None:
    paths = roll(tmp_path / f"log{suffix}", rounds_of(CONFIG, 20), Split(span_ns=2 * NS))
    assert [path.name for path in paths] == [f"log-{k:04d}{suffix}" for k in (1, 2, 3, 4)]
    parts = [stamps_in(path) for path in paths]
    assert list(chain.from_iterable(parts)) == list(range(240)), "nothing is lost and nothing twice"
    assert START_NS // NS % 2 == 1, "so the first part is over after a second: with the round that ends then"
    assert [len(part) for part in parts] == [36, 96, 96, 12]
    for path in paths:
        assert open_source(path).defects() == {}
        (config,) = {item.batch.config for item in open_source(path).blocks() if hasattr(item, "batch")}
        assert suffix == ".csv" or config == CONFIG, "its configuration is in it"


@pytest.mark.parametrize("suffix", [".csv", ".c37118", ".pcap"])
def test_files_end_when_they_are_large(suffix: str, tmp_path: Path) -> None:
    limit = 4000
    paths = roll(tmp_path / f"log{suffix}", rounds_of(CONFIG, 60), Split(nbytes=limit))
    assert len(paths) > 3
    sizes = [path.stat().st_size for path in paths]
    assert all(limit <= size < 4 * limit for size in sizes[:-1]), sizes
    assert list(chain.from_iterable(map(stamps_in, paths))) == list(range(720))


def test_several_streams_have_a_folder_for_each_part(tmp_path: Path) -> None:
    given = [[*one, *two] for one, two in zip(rounds_of(CONFIG, 12), rounds_of(stream(8), 12), strict=True)]
    paths = roll(tmp_path / "log.parquet", given, Split(span_ns=NS))
    assert sorted({path.parent.name for path in paths}) == ["log-0001", "log-0002", "log-0003", "log-0004"]
    assert sum(len(stamps_in(path)) for path in paths) == 288


def test_the_oldest_are_deleted_with_their_folders(tmp_path: Path) -> None:
    (tmp_path / "log-0001.csv").write_text("of another run")
    (tmp_path / "log-0002").mkdir()
    (tmp_path / "log-0002" / "precious.csv").write_text("mine")
    given = [[*one, *two] for one, two in zip(rounds_of(CONFIG, 24), rounds_of(stream(8), 24), strict=True)]
    paths = roll(tmp_path / "log.csv", given, Split(span_ns=NS), keep=2)
    assert sorted({path.parent.name for path in paths}) == ["log-0008", "log-0009"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log-0001.csv", "log-0002", "log-0008", "log-0009"]
    assert (tmp_path / "log-0002" / "precious.csv").exists()
    single = roll(tmp_path / "one.csv", rounds_of(CONFIG, 24), Split(span_ns=NS), keep=1)
    assert [path.name for path in single] == ["one-0007.csv"]
    assert tmp_path.exists()


def test_numbers_go_on_after_those_that_are_there(tmp_path: Path) -> None:
    first = roll(tmp_path / "log.csv", rounds_of(CONFIG, 8), Split(span_ns=NS))
    again = roll(tmp_path / "log.csv", rounds_of(CONFIG, 8), Split(span_ns=NS))
    assert [path.name for path in (*first, *again)] == [f"log-{k:04d}.csv" for k in range(1, len(first) * 2 + 1)]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_parts_without_data_are_none(suffix: str, tmp_path: Path) -> None:
    given: list[list[Item]] = [*rounds_of(CONFIG, 4), *[[] for _ in range(40)]]
    paths = roll(tmp_path / f"log{suffix}", given, Split(span_ns=2 * NS))
    assert paths == [tmp_path / f"log-0001{suffix}", *paths[1:]]
    assert all(stamps_in(path) for path in paths)
    assert sorted(tmp_path.iterdir()) == sorted(paths)
    assert roll(tmp_path / f"none{suffix}", [], Split(span_ns=NS)) == []
