"""Which configuration a stream's data frames are read by, for the whole process: scapy layers carry no session."""

from __future__ import annotations

from collections import OrderedDict

from pmutools.c37118.config import StreamConfig

MAX_CONFIGS = 1024
"""Configurations kept; the one learned longest ago goes first."""
_configs: OrderedDict[int, StreamConfig] = OrderedDict()


def learn(config: StreamConfig) -> None:
    """Read data frames of ``config.idcode`` by ``config`` from now on."""
    _configs[config.idcode] = config
    _configs.move_to_end(config.idcode)
    if len(_configs) > MAX_CONFIGS:
        _configs.popitem(last=False)


def config_of(idcode: int) -> StreamConfig | None:
    """The configuration in force for a stream, if one is known."""
    return _configs.get(idcode)


def forget(idcode: int | None = None) -> None:
    """Forget one stream's configuration, or all of them."""
    if idcode is None:
        _configs.clear()
    else:
        _configs.pop(idcode, None)
