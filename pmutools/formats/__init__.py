"""Files that hold measurements: captures, raw frames, tables, logs. One module a format, one row a format below.

A file is opened by its content where that is unmistakable (the magic numbers of the table, gzip and zstd looked
through), else by its suffix; a folder is the files in it, merged on time. What is written follows the suffix.

A new format is a module with ``read(path, configs) -> Source`` and, if it is written, ``create(path, options) ->
Sink``, and its row in :data:`FORMATS`. Modules are imported when a file of theirs is opened.
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple, cast

from pmutools.errors import SettingsError, SourceError
from pmutools.formats.sink import Sink, SinkOptions

if TYPE_CHECKING:
    from pmutools.c37118.config import StreamConfig
    from pmutools.formats.source import Source

__all__ = ["FORMATS", "FileFormat", "Sink", "SinkOptions", "open_sink", "open_source"]

COMPRESSIONS = (".gz", ".zst")
_COMPRESSED = (b"\x1f\x8b", b"\x28\xb5\x2f\xfd")


class FileFormat(NamedTuple):
    """One kind of file: its suffixes, its module, the bytes it may begin with, and whether it may be compressed."""

    kind: str
    suffixes: tuple[str, ...]
    module: str
    magics: tuple[bytes, ...] = ()
    compressible: bool = False
    written: bool = True


_PCAP_MAGICS = tuple(
    bytes.fromhex(magic) for magic in ("a1b2c3d4", "d4c3b2a1", "a1b23c4d", "4d3cb2a1", "a1b2cd34", "34cdb2a1")
)
_FRAME_MAGICS = tuple(bytes((0xAA, kind << 4 | version)) for kind in range(6) for version in (1, 2))

FORMATS = (
    FileFormat("pcap", (".pcap",), "pcap", _PCAP_MAGICS, compressible=True),
    FileFormat("pcapng", (".pcapng",), "pcap", (b"\n\r\r\n",), compressible=True),
    FileFormat("mcap", (".mcap",), "mcap", (b"\x89MCAP0\r\n",)),
    FileFormat("parquet", (".parquet",), "parquet", (b"PAR1",)),
    FileFormat("arrow", (".arrow",), "arrow", (b"ARROW1",)),
    FileFormat("raw", (".c37118", ".pmucapture"), "raw", _FRAME_MAGICS, compressible=True),
    FileFormat("csv", (".csv",), "csv", compressible=True),
)


def open_source(path: str | Path, *, configs: Iterable[StreamConfig] = ()) -> Source:
    """Open a recording, or a folder of them, for reading once.

    ``configs`` are used for streams that the recording has no configuration of.

    Raises
    ------
    SourceError
        The file cannot be read, is empty, or is not what its content or suffix promises.
    SettingsError
        Neither content nor suffix tells what it is.
    """
    path = Path(path)
    if path.is_dir():
        return _open_folder(path, configs)
    head, compressed = _head(path)
    form = _by_content(head) or _by_suffix(path)
    if form is None:
        raise SettingsError(f"{path} is of no known format; known are {known_suffixes()}")
    if compressed and not form.compressible:
        raise SourceError(f"{path} is a compressed {form.kind} file, which is not read; unpack it first")
    return cast("Source", import_module(f"{__name__}.{form.module}").read(path, configs))


def open_sink(path: str | Path, *, phasors: Literal["polar", "rect"] = "polar", long: bool = False) -> Sink:
    """Begin a recording whose format is told by its suffix; ``-`` is CSV to standard output.

    ``phasors`` and ``long`` concern tables only.

    Raises
    ------
    SettingsError
        The suffix is not known, or not one that is written.
    SourceError
        The file cannot be written.
    """
    path = Path(path)
    form = _by_suffix(path) if path.name != "-" else next(form for form in FORMATS if form.kind == "csv")
    if form is None or not form.written:
        raise SettingsError(f"cannot write {path}: its suffix is not one of {known_suffixes(written=True)}")
    if path.suffix.lower() in COMPRESSIONS and not form.compressible:
        raise SettingsError(f"cannot write {path}: {form.kind} is compressed in itself; leave out {path.suffix}")
    return cast("Sink", import_module(f"{__name__}.{form.module}").create(path, SinkOptions(phasors, long)))


def known_suffixes(*, written: bool = False) -> str:
    """The suffixes of all formats, for a message."""
    suffixes = [suffix for form in FORMATS if form.written or not written for suffix in form.suffixes]
    return " ".join(suffixes) + " (and .gz, .zst after those of text, captures and raw frames)"


def _by_content(head: bytes) -> FileFormat | None:
    return next((form for form in FORMATS if head.startswith(form.magics)), None)


def _by_suffix(path: Path) -> FileFormat | None:
    name = path.name.lower()
    for compression in COMPRESSIONS:
        name = name.removesuffix(compression)
    return next((form for form in FORMATS if name.endswith(form.suffixes)), None)


def _head(path: Path) -> tuple[bytes, bool]:
    """The first bytes of a file, decompressed, and whether they had to be."""
    from pmutools.formats.capture.window import Window

    with Window(path) as window:
        if not window.size and path.is_file():
            raise SourceError(f"{path} is empty; record it again or name another file")
        window.advance(0, 16)
        if not window.data:
            raise SourceError(f"{path} holds nothing that can be decompressed; copy it anew")
        with path.open("rb") as file:
            return window.data[:16], file.read(4).startswith(_COMPRESSED)


def _open_folder(path: Path, configs: Iterable[StreamConfig]) -> Source:
    from pmutools.formats.folder import MergedSource

    known = tuple(configs)
    files = sorted(file for file in path.iterdir() if file.is_file() and _by_suffix(file))
    if not files:
        raise SourceError(f"{path} is a folder without recordings; name a file, or a folder of {known_suffixes()}")
    return MergedSource(path, "folder", [open_source(file, configs=known) for file in files])
