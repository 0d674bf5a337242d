"""Streams under other IDCODEs, stations under other names."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from pmutools.c37118.batch import Batch
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import FIRST_IDCODE, LAST_IDCODE, NAME_SIZE, FrameType
from pmutools.c37118.demux import Loss, Message
from pmutools.c37118.frames import restamp
from pmutools.c37118.prefix import decode_prefix
from pmutools.errors import SettingsError
from pmutools.formats.source import Block
from pmutools.tools.recast.changes import Changes, Item, configured, sealed_frames

NAME_SIZE_CFG3 = 255


def check_renumbering(idcodes: Mapping[int, int], there: Iterable[int] = ()) -> None:
    """Hold ``idcodes`` (old to new) against the standard, each other and the streams that are ``there``.

    Raises SettingsError for an IDCODE outside 1..65534 and for one that two streams would have.
    """
    streams = set(there) | set(idcodes)
    owners: dict[int, int] = {}
    for old, new in idcodes.items():
        if not FIRST_IDCODE <= new <= LAST_IDCODE:
            raise SettingsError(f"IDCODE {old}={new}: an IDCODE is {FIRST_IDCODE} to {LAST_IDCODE}")
        if new in owners:
            raise SettingsError(f"IDCODE {old}={new}: stream {owners[new]} becomes {new} too; choose another")
        owners[new] = old
    for old, new in idcodes.items():
        if new in streams and new not in idcodes:
            raise SettingsError(f"IDCODE {old}={new}: the source has a stream {new} already; choose another")


def renumbered(items: Iterable[Item], idcodes: Mapping[int, int], changes: Changes | None = None) -> Iterator[Item]:
    """Streams under other IDCODEs, old to new; a single station of the same IDCODE moves along.

    Commands to a stream move too. Raises SettingsError as :func:`check_renumbering` does, for the streams of the
    source when they turn up.
    """
    check_renumbering(idcodes)
    done = Changes() if changes is None else changes
    done.missing |= {f"IDCODE {old}" for old in idcodes}
    moved: dict[StreamConfig, StreamConfig] = {}
    seen: set[int] = set()
    for item in items:
        if isinstance(item, Loss):
            yield item
            continue
        old = item.batch.config.idcode if isinstance(item, Block) else item.frame.idcode
        if old not in seen:
            seen.add(old)
            check_renumbering({known: new for known, new in idcodes.items() if known in seen}, seen)
            if old in idcodes:
                done.renumbered[old] = idcodes[old]
                done.missing.discard(f"IDCODE {old}")
        if old not in idcodes:
            yield item
        elif isinstance(item, Block):
            yield item._replace(batch=_renumbered_batch(item.batch, idcodes[old], moved))
        else:
            yield _renumbered_message(item, idcodes[old], moved)


def _renumbered_batch(batch: Batch, new: int, moved: dict[StreamConfig, StreamConfig]) -> Batch:
    config = _renumbered_config(batch.config, new, moved)
    if batch.wire is None or not len(batch):
        return replace(batch, config=config)
    wire = batch.wire.copy()
    wire["idcode"] = new
    return replace(batch, config=config, wire=sealed_frames(wire, config))


def _renumbered_config(config: StreamConfig, new: int, moved: dict[StreamConfig, StreamConfig]) -> StreamConfig:
    if config not in moved:
        stations = config.stations
        if len(stations) == 1 and stations[0].idcode == config.idcode:
            stations = (replace(stations[0], idcode=new),)
        moved[config] = replace(config, idcode=new, stations=stations)
    return moved[config]


def _renumbered_message(message: Message, new: int, moved: dict[StreamConfig, StreamConfig]) -> Message:
    frame, _, config = message
    own = None if config is None else _renumbered_config(config, new, moved)
    if own is not None and frame.type.is_config:
        return configured(message, own)
    prefix = decode_prefix(frame.data)
    data = restamp(frame.data, prefix.soc, prefix.fracsec, idcode=new)
    return message._replace(frame=frame._replace(data=data), config=own)


def renamed(items: Iterable[Item], names: Mapping[str, str], changes: Changes | None = None) -> Iterator[Item]:
    """Stations under other names, old to new, in every stream that has one of that name.

    Raises SettingsError for a name that is empty or too long (16 bytes of UTF-8 in CFG-1 and CFG-2, 255 in CFG-3),
    and for one that another station of the stream has.
    """
    for old, new in names.items():
        if not new.strip():
            raise SettingsError(f"name {old}={new}: a station's name cannot be empty")
        if len(new.encode()) > NAME_SIZE_CFG3:
            raise SettingsError(f"name {old}={new[:20]}...: {len(new.encode())} bytes, at most {NAME_SIZE_CFG3} fit")
    done = Changes() if changes is None else changes
    done.missing |= {f"station {old}" for old in names}
    made: dict[StreamConfig, StreamConfig] = {}

    def config_of(config: StreamConfig) -> StreamConfig:
        if config not in made:
            made[config] = _renamed_config(config, names, done)
        return made[config]

    for item in items:
        if isinstance(item, Block):
            config = config_of(item.batch.config)
            yield item if config is item.batch.config else item._replace(batch=replace(item.batch, config=config))
        elif isinstance(item, Message) and item.config is not None:
            config = config_of(item.config)
            if config is item.config:
                yield item
            else:
                yield configured(item, config) if item.frame.type.is_config else item._replace(config=config)
        else:
            yield item


def _renamed_config(config: StreamConfig, names: Mapping[str, str], done: Changes) -> StreamConfig:
    """``config`` itself where none of its stations is named anew."""
    if not any(station.name in names for station in config.stations):
        return config
    limit = NAME_SIZE_CFG3 if config.kind is FrameType.CFG3 else NAME_SIZE
    stations = []
    for station in config.stations:
        new = names.get(station.name)
        if new is None:
            stations.append(station)
            continue
        if len(new.encode()) > limit:
            size = len(new.encode())
            raise SettingsError(f"name {station.name}={new}: {size} bytes, {config.kind.name} has room for {limit}")
        done.renamed[station.name] = new
        done.missing.discard(f"station {station.name}")
        stations.append(replace(station, name=new, wire_name=None))
    counts = Counter(station.name for station in stations)
    for station in config.stations:
        if (new := names.get(station.name)) is not None and counts[new] > 1:
            raise SettingsError(f"name {station.name}={new}: stream {config.idcode} would have two stations {new}")
    return replace(config, stations=tuple(stations))
