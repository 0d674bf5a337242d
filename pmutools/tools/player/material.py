"""From what a person names to what is played: sources opened, recast, read, timed anew, and shared among PMUs."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from pmutools.c37118.demux import Loss, Message
from pmutools.errors import SettingsError
from pmutools.formats.source import Block, Source
from pmutools.tools.player.cast import Cast, Spread, as_recorded, emulated
from pmutools.tools.player.reel import Reel, at_interval, at_rate, record, without_gaps
from pmutools.tools.recast import Changes, Form, concentrated, described, reformatted, renamed, renumbered
from pmutools.tools.recordings import losses, open_recordings
from pmutools.tools.synth import PlantSource, Recipe
from pmutools.tools.window import Window

Items = Iterable[Block | Message | Loss]


@dataclass(frozen=True)
class Choice:
    """What to play; fields as on the command line of ``pmu play``. Either ``files`` or a ``plant``."""

    files: Sequence[str] = ()
    plant: Recipe | None = None
    data_rate: int | None = None
    fnom_hz: float | None = None
    window: Window = field(default_factory=Window)
    timing: str | None = None
    select: Sequence[str] = ()
    exclude: Sequence[str] = ()
    idcodes: Mapping[int, int] = field(default_factory=dict)
    names: Mapping[str, int] = field(default_factory=dict)
    """New IDCODEs by the streams' names: those that share one can be told apart so."""
    stations: Mapping[str, str] = field(default_factory=dict)
    form: Form | None = None
    pdc_idcode: int | None = None
    skip_gaps_ns: int | None = None
    interval_ns: int | None = None
    fps: int | None = None
    emulate: int | None = None
    stagger: bool = True
    spread: Spread | None = None
    seed: int = 0


@dataclass(frozen=True)
class Material:
    """What is played, what of the source could not be read, and what a person should know of it."""

    cast: Cast
    losses: Mapping[str, int]
    notes: Sequence[str]


def material(choice: Choice, watched: Callable[[Source], Source] = lambda source: source) -> Material:
    """Read what is to be played; ``watched`` may look on. Raises SourceError and SettingsError."""
    changes = Changes()
    read: list[Source] = []

    def opened() -> Items:
        source = watched(_opened(choice))
        read[:] = [source]
        return source.blocks()

    chosen = (choice.select, choice.exclude) if choice.pdc_idcode is None else ((), ())
    reel = record(_recast(choice, opened, changes), choice.timing, choice.window, *chosen)
    reel, notes = _timed(choice, reel)
    if choice.emulate is None:
        if choice.spread is not None:
            raise SettingsError("--spread makes emulated PMUs differ; give --emulate N too")
        cast = as_recorded(reel, choice.names)
    elif choice.names:
        raise SettingsError("--idcode by name and --emulate clash: emulated PMUs have IDCODEs of their own")
    else:
        cast = emulated(reel, choice.emulate, choice.seed, stagger=choice.stagger, spread=choice.spread)
    return Material(cast, losses(read[0]), [*described(changes), *notes])


def _opened(choice: Choice) -> Source:
    if choice.plant is not None:
        return PlantSource(choice.plant)
    return open_recordings(choice.files, data_rate=choice.data_rate, fnom_hz=choice.fnom_hz)


def _recast(choice: Choice, opened: Callable[[], Items], changes: Changes) -> Items:
    """The source under the names, numbers and FORMATs asked for, all of it in one stream if so asked."""

    def items(changes: Changes | None) -> Items:
        items = opened()
        if choice.stations:
            items = renamed(items, choice.stations, changes)
        if choice.idcodes:
            items = renumbered(items, choice.idcodes, changes)
        if choice.form is not None:
            items = reformatted(items, choice.form, changes)
        if choice.pdc_idcode is not None and (choice.select or choice.exclude):
            items = _members(items, choice.select, choice.exclude)
        return items

    if choice.pdc_idcode is None:
        return items(changes)
    passes = iter((None, changes))  # it is read twice, and told of once
    return concentrated(lambda: items(next(passes)), choice.pdc_idcode, changes=changes)


def _members(items: Items, select: Collection[str], exclude: Collection[str]) -> Iterator[Block | Message | Loss]:
    """The streams of a concentrator-to-be, by IDCODE or station; raises SettingsError for a name that fits none."""
    missing = {*select, *exclude}
    for item in items:
        config = item.batch.config if isinstance(item, Block) else getattr(item, "config", None)
        if config is None:
            yield item
            continue
        names = {str(config.idcode), *(station.name for station in config.stations)}
        missing -= names
        if (not select or names & {*select}) and not names & {*exclude}:
            yield item
    if missing:
        raise SettingsError(f"--select or --exclude {min(missing)}: no stream has this IDCODE or station")


def _timed(choice: Choice, reel: Reel) -> tuple[Reel, list[str]]:
    notes = []
    if choice.skip_gaps_ns is not None:
        reel, count = without_gaps(reel, choice.skip_gaps_ns)
        if count:
            notes.append(f"{count} gap{'s' * (count > 1)} longer than {choice.skip_gaps_ns / 1e9:g} s cut down to it")
    if choice.interval_ns is not None:
        reel = at_interval(reel, choice.interval_ns)
    if choice.fps is not None:
        reel = at_rate(reel, choice.fps)
    return reel, notes
