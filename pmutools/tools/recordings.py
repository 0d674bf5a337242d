"""One or several recordings as one source; what of them could not be read; configurations kept in them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.demux import Message
from pmutools.errors import SettingsError
from pmutools.formats import open_source
from pmutools.formats.source import Block, Source
from pmutools.sites import Site


def open_recordings(
    paths: Sequence[str | Path],
    *,
    configs: Iterable[StreamConfig] = (),
    data_rate: int | None = None,
    fnom_hz: float | None = None,
) -> Source:
    """The recordings merged on time; arguments, SourceError and SettingsError as of :func:`open_source`."""
    known = tuple(configs)
    sources = [open_source(path, configs=known, data_rate=data_rate, fnom_hz=fnom_hz) for path in paths]
    if len(sources) == 1:
        return sources[0]
    from pmutools.formats.folder import MergedSource

    return MergedSource(Path(f"{len(sources)} recordings"), "several", sources)


def losses(source: Source) -> dict[str, int]:
    """What a source that has been read to its end held beside frames, by name: bytes skipped, container defects."""
    return {f"bytes skipped, {reason}": nbytes for reason, nbytes in source.tally.skipped.items()} | source.defects()


def saved_configs(sites: Iterable[Site]) -> tuple[StreamConfig, ...]:
    """What ``config =`` of the sites refers to: configurations for streams that may never send theirs.

    Raises SourceError where such a recording cannot be read, SettingsError where it holds no configuration of the
    site's stream, or two sites give one IDCODE two configurations: they are found by their IDCODE.
    """
    found: dict[int, tuple[StreamConfig, Site]] = {}
    for site in sites:
        for config in _configs_for(site) if site.config else ():
            known, owner = found.setdefault(config.idcode, (config, site))
            if known != config:
                raise SettingsError(
                    f"[pmu {site.name}] and [pmu {owner.name}]: two configurations saved for IDCODE {config.idcode}; "
                    "keep one (saved configurations are found by their IDCODE)"
                )
    return tuple(config for config, _ in found.values())


def _configs_for(site: Site) -> list[StreamConfig]:
    """The configuration of the site's stream; all that the recording holds, where the site names no IDCODE."""
    assert site.config is not None
    found: dict[int, StreamConfig] = {}
    for config in _configs_in(open_source(site.config)):
        found[config.idcode] = config
        if config.idcode == site.stream:
            return [config]
    if site.stream is None and found:
        return list(found.values())
    there = ", ".join(map(str, found)) or "none"
    wanted = "" if site.stream is None else f" of stream {site.stream}"
    raise SettingsError(f"[pmu {site.name}] config: {site.config} holds no configuration{wanted}; it has {there}")


def _configs_in(source: Source) -> Iterator[StreamConfig]:
    for item in source.blocks():
        if isinstance(item, Block):
            yield item.batch.config
        elif isinstance(item, Message) and item.config is not None and item.frame.type.rules_data:
            yield item.config
