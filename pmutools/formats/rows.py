"""Rows of a table file -> blocks, by the configuration found in the file, known beforehand, or inferred."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.c37118.batch import STAMP_SOURCES, Batch
from pmutools.c37118.config import StreamConfig
from pmutools.errors import SourceError
from pmutools.flow import Flow, StampSource
from pmutools.formats import UNSAID, Nominal
from pmutools.formats.columns import FrameValues, Phasors, batch_of, columns_of
from pmutools.formats.infer import Plan, columns_from_names, data_rate_of, infer, nominal_hz_of
from pmutools.formats.source import Block, TableSource

NO_IDCODE = 1
"""IDCODE of a stream that nobody gave one."""
_STYLES: tuple[Phasors, ...] = ("polar", "rect")


class Rows(NamedTuple):
    """Some consecutive rows: their frame columns, IDCODE (N,), and all other columns by name, as floats (N,)."""

    frames: FrameValues
    idcode: npt.NDArray[np.int64]
    values: Callable[[str], npt.NDArray[Any] | None]


def table_source(
    path: Path,
    kind: str,
    names: Sequence[str],
    rows: Iterable[Rows],
    *,
    own: StreamConfig | None = None,
    configs: Iterable[StreamConfig] = (),
    defects: Counter[str] | None = None,
    nominal: Nominal = UNSAID,
) -> TableSource:
    """A source of a file's rows. ``own`` is the configuration in the file, ``configs`` are those known beforehand.

    Without any that fits the columns, one is inferred from the first rows, but for what ``nominal`` says. Raises
    SourceError where there are none, SettingsError where ``nominal`` says something of a known configuration.
    """
    walk = iter(rows)
    first = next(walk, None)
    if first is None:
        found = ", ".join(f"{name}: {count}" for name, count in (defects or {}).items())
        raise SourceError(f"{path} holds no rows of measurements{found and f' ({found})'}; name another file")
    plan = _known(names, [own] if own else []) or _known(
        names, [config for config in configs if config.idcode == int(first.idcode[0])]
    )
    if plan is not None:
        nominal.refuse(path)
    try:
        plan = plan or _inferred(names, first, path, nominal)
    except SourceError as error:
        raise SourceError(f"{path}: {error}") from None
    return planned_source(path, kind, plan, chain([first], walk), defects)


def planned_source(
    path: Path, kind: str, plan: Plan, rows: Iterable[Rows], defects: Counter[str] | None = None
) -> TableSource:
    """A source of rows whose configuration is decided."""
    counts = Counter[str]() if defects is None else defects
    return TableSource(path, kind, _blocks(plan, rows, Flow("file", path.name)), lambda: dict(+counts))


def _known(names: Sequence[str], configs: Iterable[StreamConfig]) -> Plan | None:
    """The first configuration whose columns the file has; a file may lack some of them, and is read all the same."""
    present = set(names)
    for config in configs:
        styles = [columns_of(config, style) for style in _STYLES]
        best = max(styles, key=lambda columns: sum(column.name in present for column in columns))
        if any(column.name in present for column in best):
            return Plan(config, best, exact=True)
    return None


def _inferred(names: Sequence[str], first: Rows, path: Path, nominal: Nominal) -> Plan:
    columns = columns_from_names(names, path.name.partition(".")[0])
    rate = nominal.data_rate or data_rate_of(first.frames.time_ns)
    frequencies = [first.values(column.name) for column in columns if column.quantity == "freq_hz"]
    given = [values for values in frequencies if values is not None]
    fnom_hz = nominal.fnom_hz or nominal_hz_of(np.concatenate(given) if given else np.empty(0), rate)
    return infer(columns, idcode=int(first.idcode[0]), data_rate=rate or round(fnom_hz), fnom_hz=fnom_hz)


def _blocks(plan: Plan, rows: Iterable[Rows], flow: Flow) -> Iterator[Block]:
    """One block for each run of rows; several where the rows have several IDCODEs."""
    configs: dict[int, StreamConfig] = {plan.config.idcode: plan.config}
    for part in rows:
        for idcode in np.unique(part.idcode).tolist():
            if idcode not in configs:
                configs[idcode] = replace(plan.config, idcode=idcode)
            chosen = part.idcode == idcode
            here = plan._replace(config=configs[idcode])
            yield Block(flow, _batch(here, part, None if chosen.all() else chosen))


def _batch(plan: Plan, rows: Rows, chosen: npt.NDArray[np.bool_] | None) -> Batch:
    config, columns, exact = plan
    if chosen is None:
        return batch_of(config, columns, rows.frames, rows.values, exact=exact)
    time_ns, arrival_ns, stamp_source, time_quality = rows.frames
    frames = FrameValues(time_ns[chosen], arrival_ns[chosen], stamp_source[chosen], time_quality[chosen])

    def values(name: str) -> npt.NDArray[Any] | None:
        found = rows.values(name)
        return None if found is None else found[chosen]

    return batch_of(config, columns, frames, values, exact=exact)


def idcodes_of(numbers: npt.NDArray[np.float64] | None, count: int, default: int = NO_IDCODE) -> npt.NDArray[np.int64]:
    """(N,) IDCODEs, ``default`` where the file gives none."""
    if numbers is None:
        return np.full(count, default)
    whole = np.where(np.isfinite(numbers), numbers, default)
    return np.clip(whole, 0, 0xFFFF).astype(np.int64)


def qualities_of(numbers: npt.NDArray[np.float64] | None, count: int) -> npt.NDArray[np.uint8]:
    """(N,) time quality bytes, 0 where the file gives none."""
    if numbers is None:
        return np.zeros(count, np.uint8)
    return np.clip(np.nan_to_num(numbers), 0, 0xFF).astype(np.uint8)


def stamp_code(name: str | None) -> int:
    """Index of a stamp source by its name; ``capture`` for an unknown one."""
    try:
        return STAMP_SOURCES.index(StampSource(name or ""))
    except ValueError:
        return STAMP_SOURCES.index(StampSource.CAPTURE)
