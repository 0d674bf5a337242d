"""Files that hold measurements: captures, raw frames, tables, logs. One module a format, one row a format below.

A file is opened by its content where that is unmistakable (the magic numbers of the table, gzip and zstd looked
through), else by its suffix; a folder is the files in it, merged on time. What is written follows the suffix.

A new format is a module with ``read(path, configs) -> Source`` and, if it is written, ``create(path, options) ->
Sink``, and its row in :data:`FORMATS`. Where it may lack a configuration, the row says ``inferred`` and ``read`` takes
a third argument, :class:`Nominal`. Modules are imported when a file of theirs is opened.
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple, cast

from pmutools.errors import SettingsError, SourceError
from pmutools.formats.naming import Namer, stream_name
from pmutools.formats.sink import Sink, SinkOptions

if TYPE_CHECKING:
    from pmutools.c37118.config import StreamConfig
    from pmutools.formats.fields import Fields
    from pmutools.formats.source import Source

__all__ = ["FORMATS", "UNSAID", "FileFormat", "Nominal", "Sink", "SinkOptions", "open_sink", "open_source"]

JOURNAL = ".journal"
"""What follows the name of a recording while it is not finished, where it needs an end: its frames."""
COMPRESSIONS = (".gz", ".zst")
_COMPRESSED = (b"\x1f\x8b", b"\x28\xb5\x2f\xfd")


class FileFormat(NamedTuple):
    """One kind of file: its suffixes, its module, the bytes it may begin with, and whether it may be compressed.

    ``inferred`` says that its configuration may have to be inferred, ``tabular`` that it is made of columns,
    ``streamed`` that it may go to standard output, ``end_needed`` that it cannot be read before it is finished.
    """

    kind: str
    suffixes: tuple[str, ...]
    module: str
    magics: tuple[bytes, ...] = ()
    compressible: bool = False
    written: bool = True
    inferred: bool = False
    tabular: bool = False
    streamed: bool = False
    end_needed: bool = False


class Nominal(NamedTuple):
    """What the user says of a recording that does not say it: DATA_RATE and nominal frequency; None: infer it."""

    data_rate: int | None = None
    fnom_hz: float | None = None

    @property
    def given(self) -> bool:
        return self != (None, None)

    def refuse(self, path: Path) -> None:
        """Raises SettingsError where something was given for a recording that brings its configuration."""
        if self.given:
            raise SettingsError(f"{path} brings its configuration: no rate or nominal frequency can be chosen for it")


UNSAID = Nominal()
_PCAP_MAGICS = tuple(
    bytes.fromhex(magic) for magic in ("a1b2c3d4", "d4c3b2a1", "a1b23c4d", "4d3cb2a1", "a1b2cd34", "34cdb2a1")
)
_FRAME_MAGICS = tuple(bytes((0xAA, kind << 4 | version)) for kind in range(6) for version in (1, 2))

FORMATS = (
    FileFormat("pcap", (".pcap",), "pcap", _PCAP_MAGICS, compressible=True, streamed=True),
    FileFormat("pcapng", (".pcapng",), "pcap", (b"\n\r\r\n",), compressible=True, streamed=True),
    FileFormat("mcap", (".mcap",), "mcap", (b"\x89MCAP0\r\n",)),
    FileFormat("parquet", (".parquet",), "parquet", (b"PAR1",), inferred=True, tabular=True, end_needed=True),
    FileFormat("arrow", (".arrow",), "arrow", (b"ARROW1",), inferred=True, tabular=True, streamed=True),
    FileFormat("raw", (".c37118", ".pmucapture"), "raw", _FRAME_MAGICS, compressible=True, streamed=True),
    FileFormat("csv", (".csv",), "csv", compressible=True, inferred=True, tabular=True, streamed=True),
    FileFormat("jsonl", (".jsonl",), "jsonl", compressible=True, inferred=True, streamed=True),
    FileFormat("journal", (".journal",), "journal", written=False),
    FileFormat("comtrade", (".cfg", ".dat", ".cff"), "comtrade", written=False, inferred=True),
)


def open_source(
    path: str | Path,
    *,
    configs: Iterable[StreamConfig] = (),
    data_rate: int | None = None,
    fnom_hz: float | None = None,
) -> Source:
    """Open a recording, or a folder of them, for reading once.

    ``configs`` are used for streams that the recording has no configuration of. ``data_rate`` (> 0 frames/s, < 0
    seconds a frame) and ``fnom_hz`` (50 or 60) are what such streams are taken to have; None: what their numbers show.

    Raises
    ------
    SourceError
        The file cannot be read, is empty, or is not what its content or suffix promises.
    SettingsError
        Neither content nor suffix tells what it is; a rate is chosen for a recording that has one.
    """
    path, nominal = Path(path), Nominal(data_rate, fnom_hz)
    if data_rate is not None and not (0 < abs(data_rate) <= 0x7FFF):
        raise SettingsError(f"DATA_RATE {data_rate}: 1 to 32767 frames a second, or -1 to -32767 for seconds a frame")
    if fnom_hz is not None and fnom_hz not in (50, 60):
        raise SettingsError(f"nominal frequency {fnom_hz:g} Hz: C37.118 knows 50 and 60")
    if path.is_dir():
        return _open_folder(path, configs, nominal)
    path = _readable(path)
    head, compressed = _head(path)
    form = _by_content(head) or _by_suffix(path)
    if form is None:
        raise SettingsError(f"{path} is of no known format; known are {known_suffixes()}")
    if compressed and not form.compressible:
        raise SourceError(f"{path} is a compressed {form.kind} file, which is not read; unpack it first")
    module = import_module(f"{__name__}.{form.module}")
    if form.inferred:
        return cast("Source", module.read(path, configs, nominal))
    nominal.refuse(path)
    return cast("Source", module.read(path, configs))


def open_sink(
    path: str | Path,
    *,
    form: str | None = None,
    phasors: Literal["polar", "rect"] = "polar",
    long: bool = False,
    fields: Fields | None = None,
    per_stream: bool = False,
    name: Namer = stream_name,
    journal: bool = False,
) -> Sink:
    """Begin a recording whose format is told by its suffix; ``-`` is standard output, as CSV unless ``form`` is given.

    ``form`` is a kind of :data:`FORMATS`. With ``journal`` there is a journal beside a recording that cannot be read
    before it is finished. The other arguments are those of :class:`SinkOptions`.

    Raises
    ------
    SettingsError
        The suffix is not known, or not one that is written; something is asked for that the format has not.
    SourceError
        The file cannot be written.
    """
    path = Path(path)
    stdout = path.name == "-"
    found = _streamed(form or "csv") if stdout else _by_suffix(path)
    if found is None or not found.written:
        raise SettingsError(f"cannot write {path}: its suffix is not one of {known_suffixes(written=True)}")
    if path.suffix.lower() in COMPRESSIONS and not found.compressible:
        raise SettingsError(f"cannot write {path}: {found.kind} is compressed in itself; leave out {path.suffix}")
    if form is not None and form != found.kind:
        raise SettingsError(f"cannot write {path} as {form}: its suffix says {found.kind}")
    if stdout and per_stream:
        raise SettingsError("several files cannot go to standard output; name a file")
    tables = ", ".join(each.suffixes[0] for each in FORMATS if each.tabular)
    if (long or fields is not None) and not found.tabular:
        raise SettingsError(f"{path}: {found.kind} holds whole frames; fields and long form are for {tables}")
    if phasors == "rect" and not found.tabular:
        raise SettingsError(f"{path}: {found.kind} has one notation of phasors; to choose it is for {tables}")
    if long and per_stream:
        raise SettingsError("long form is one file of all streams, and none a stream; choose one")
    options = SinkOptions(phasors, long, fields, per_stream, name, found.suffixes[0])
    create = import_module(f"{__name__}.{found.module}").create
    if per_stream and not found.tabular:
        from pmutools.formats.per_stream import PerStreamSink

        return PerStreamSink(path, suffix_of(path), create, options)
    sink = cast("Sink", create(path, options))
    if journal and found.end_needed:
        from pmutools.formats.journal import JournalledSink

        return JournalledSink(sink, path)
    return sink


def _streamed(form: str) -> FileFormat:
    kinds = [each.kind for each in FORMATS if each.streamed]
    if form not in kinds:
        raise SettingsError(f"{form} cannot go to standard output; one of {', '.join(kinds)} can")
    return next(each for each in FORMATS if each.kind == form)


def suffix_of(path: Path) -> str:
    """The end of a name that tells its format, with that of a compression; empty where it tells none."""
    name = path.name.lower()
    packed = next((each for each in COMPRESSIONS if name.endswith(each)), "")
    plain = name.removesuffix(packed)
    known = next((suffix for form in FORMATS for suffix in form.suffixes if plain.endswith(suffix)), "")
    return path.name[-len(known + packed) :] if known else ""


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


def _readable(path: Path) -> Path:
    """``path``, or what stands for it where it was never finished. Raises SourceError where that is a folder's."""
    if not _is_unfinished(path):
        return path
    journal = path.with_name(path.name + JOURNAL)
    if journal.is_file():
        return journal
    if others := sorted(path.parent.glob(f"*{JOURNAL}")):
        raise SourceError(f"{path} was never finished; its frames are in {others[0]}")
    return path


def _is_unfinished(path: Path) -> bool:
    """Whether a file lacks the end that its format needs, which is its first bytes again."""
    form = _by_suffix(path)
    if form is None or not form.end_needed or not path.is_file():
        return False
    with path.open("rb") as file:
        file.seek(max(4, path.stat().st_size - 4))  # the first four are the beginning's
        return file.read(4) not in form.magics


def _open_folder(path: Path, configs: Iterable[StreamConfig], nominal: Nominal) -> Source:
    from pmutools.formats.folder import MergedSource

    known = tuple(configs)
    files = sorted(file for file in path.iterdir() if file.is_file() and _by_suffix(file) and not _is_second(file))
    journals = [file for file in files if file.suffix == JOURNAL]
    if journals:  # they have what unfinished files have; that of the folder's own recording has finished ones too
        whole = {Path(file.stem).suffix for file in journals if Path(file.stem).stem == path.name}
        files = [file for file in files if file.suffix not in whole and not _is_unfinished(file)]
    if not files:
        raise SourceError(f"{path} is a folder without recordings; name a file, or a folder of {known_suffixes()}")
    sources = [open_source(file, configs=known, data_rate=nominal.data_rate, fnom_hz=nominal.fnom_hz) for file in files]
    return MergedSource(path, "folder", sources)


def _is_second(path: Path) -> bool:
    """Whether a file is the data of a COMTRADE record, whose header stands for both."""
    return path.suffix.lower() == ".dat"
