"""Frames of one stream that came together, as columns by the names that they have in tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from pmutools.c37118.batch import Batch
from pmutools.c37118.config import StreamConfig
from pmutools.c37118.frames import Data
from pmutools.flow import Flow
from pmutools.formats.columns import columns_of, quantities
from pmutools.parsers import suggestion
from pmutools.sites import Site


@dataclass(frozen=True, eq=False)
class StreamBatch:
    """Data frames of one stream that came together, as columns of numpy arrays."""

    flow: Flow
    """Where they came from and to."""
    batch: Batch
    """All columns by number: see :class:`pmutools.c37118.batch.Batch`."""
    sites: tuple[Site, ...] = ()
    """What the initialisation file has of this stream, where it was opened from one."""

    def __len__(self) -> int:
        return len(self.batch)

    @property
    def idcode(self) -> int:
        """Of the stream."""
        return self.batch.config.idcode

    @property
    def config(self) -> StreamConfig:
        """The configuration that the frames were sent by."""
        return self.batch.config

    @property
    def time_ns(self) -> npt.NDArray[np.int64]:
        """(N,) POSIX UTC, ns."""
        return self.batch.time_ns

    @property
    def arrival_ns(self) -> npt.NDArray[np.int64]:
        """(N,) POSIX UTC, ns; :data:`pmutools.c37118.batch.NO_TIME` where unknown."""
        return self.batch.arrival_ns

    @property
    def names(self) -> list[str]:
        """The columns that :meth:`column` knows."""
        return list(self._places)

    @cached_property
    def _places(self) -> Mapping[str, tuple[str, int]]:
        return _places(self.config)

    def column(self, name: str) -> npt.NDArray[Any]:
        """(N,) one quantity: ``STATION.freq_hz``, ``.rocof_hz_s``, ``.stat``; ``STATION.CHANNEL`` of an analog, a
        digital word (``STATION.WORD1``) or, complex in V or A RMS, a phasor.

        Raises KeyError, which names what is like it.
        """
        place = self._places.get(name)
        if place is None:
            raise KeyError(f"{name}: no such column; {suggestion(name, self._places)}")
        quantity, at = place
        if quantity == "phasor":
            return self.batch.phasors[:, at]
        return quantities(self.batch, "rect", (quantity,))[quantity][:, at]

    def to_arrow(self, phasors: str = "polar") -> Any:
        """A pyarrow.RecordBatch with the columns of the tables that ``pmu read`` writes; phasors polar or rect."""
        from pmutools.formats.table_rows import wide_rows

        return wide_rows(self.batch, "rect" if phasors == "rect" else "polar")

    def to_pandas(self, phasors: str = "polar") -> Any:
        """The same as a pandas.DataFrame; needs pandas, which pmutools does not bring."""
        return self.to_arrow(phasors).to_pandas()

    def frames(self) -> Iterator[Data]:
        """Each frame's values by number."""
        return self.batch.data()


@lru_cache(maxsize=1024)
def _places(config: StreamConfig) -> dict[str, tuple[str, int]]:
    found = {}
    for column in columns_of(config, "rect"):
        if column.quantity == "re":
            found[f"{column.station}.{column.channel}"] = ("phasor", column.at)
        elif column.quantity != "im":
            found[column.name] = (column.quantity, column.at)
    return found
