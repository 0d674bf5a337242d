"""Every stream's way through its fault pipeline: frames in columns go in, what becomes of them comes out.

Streams to which nothing happens pass as columns, so do those whose frames are only delayed, each by a time that its
index decides; all others go frame by frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np
import numpy.typing as npt

from pmutools.flow import Hangup
from pmutools.impair.outgoing import Outgoing
from pmutools.impair.pipeline import Pipeline
from pmutools.impair.profile import Action
from pmutools.tools.player.cast import Cast
from pmutools.tools.player.dress import Dressed
from pmutools.tools.player.reel import I64
from pmutools.tools.player.sheet import EMPTY, FATES, Extra, Sheet, changes, clean, joined

_FATE_CODES = {fate: code for code, fate in enumerate(FATES)}


class Gate(NamedTuple):
    """At ``offset_ns`` TCP clients of ``part`` are hung up on; None: they may come back."""

    offset_ns: int
    part: int
    hangup: Hangup | None


class _Origin(NamedTuple):
    """Whose a frame is that a pipeline may hold back, and what a ledger wants to know of it."""

    part: int
    source_ns: int
    stamp_ns: int
    edition: int


_CLEAR, _DELAYED, _BUSY = range(3)


class Route:
    """Every stream's way through its pipeline; what is held back there keeps its origin here."""

    def __init__(self, cast_: Cast, pipelines: Sequence[Pipeline], *, marks: bool) -> None:
        self._cast, self._pipelines, self._marks = cast_, pipelines, marks
        self._edition = cast_.editions.copy()
        self.gates: list[Gate] = []
        self.warnings: list[str] = []
        self._hung: dict[int, Hangup | None] = {}
        self._mode = np.array([_mode(pipeline) for pipeline in pipelines], np.int8)

    def act(self, action: Action) -> list[int]:
        # of several streams, all or none
        concerned = [part for part, pipeline in enumerate(self._pipelines) if pipeline.check(action)]
        for part in concerned:
            if self._mode[part] == _CLEAR:
                self._pipelines[part].passed()
            self._pipelines[part].act(action)
            self._set_mode(part)
        return concerned

    def through(
        self,
        rows: I64,
        parts: npt.NDArray[np.int32],
        index: I64,
        offsets: I64,
        stream_ns: I64,
        stamps: I64,
        dressed: Dressed,
    ) -> Sheet:
        """What becomes of frames (N,) given in the order in which they are due."""
        reel = self._cast.reel
        editions, sources = reel.rows.edition[rows], reel.rows.source_ns[rows]
        sheet = clean(offsets, parts, index, sources, stamps, editions, dressed.at, dressed.nbytes, dressed.wire)
        if not self._mode.any() and np.array_equal(self._edition[parts], editions):
            return sheet
        pieces, first = [], 0
        for row in changes(self._edition, parts, editions):
            pieces.append(self._faulty(sheet.take(slice(first, row)), stream_ns[first:row]))
            first = row
            self._configure(int(parts[row]), int(editions[row]))
        pieces.append(self._faulty(sheet.take(slice(first, None)), stream_ns[first:]))
        return joined(pieces)

    def _configure(self, part: int, edition: int) -> None:
        self._edition[part] = edition
        self.warnings += self._pipelines[part].adapt(self._cast.config(part, edition))
        self._set_mode(part)

    def _set_mode(self, part: int) -> None:
        """How frames of ``part`` pass; one by one too until clients that were hung up on may come back."""
        self._mode[part] = _BUSY if self._hung.get(part) is not None else _mode(self._pipelines[part])

    def _faulty(self, sheet: Sheet, stream_ns: I64) -> Sheet:
        modes = self._mode[sheet.part]
        if not modes.any():
            return sheet
        delayed = np.flatnonzero(modes == _DELAYED)
        if len(delayed):
            sheet = self._delay(sheet, delayed)
        busy = np.flatnonzero(modes == _BUSY)
        if not len(busy):
            return sheet
        return joined([sheet.take(modes != _BUSY), self._apply(sheet, busy, stream_ns)])

    def _delay(self, sheet: Sheet, rows: npt.NDArray[np.int64]) -> Sheet:
        """With the delays of frames whose index alone decides them."""
        offsets, faults = sheet.offset_ns.copy(), sheet.faults.copy()
        parts = sheet.part[rows]
        for part in np.unique(parts):
            own = rows[parts == part]
            delays = self._pipelines[part].delays_ns(sheet.index[own])
            assert delays is not None
            offsets[own] += delays
            if self._marks:
                faults[own] = [f"delay:{delay / 1e6:.6g}ms" if delay else "" for delay in delays.tolist()]
        return replace(sheet, offset_ns=offsets, faults=faults)

    def _apply(self, sheet: Sheet, rows: npt.NDArray[np.int64], stream_ns: I64) -> Sheet:
        """Frames that go through their pipelines one by one."""
        out: list[Outgoing] = []
        for row in rows.tolist():
            part, source_ns, offset_ns = int(sheet.part[row]), int(sheet.source_ns[row]), int(sheet.offset_ns[row])
            pipeline = self._pipelines[part]
            origin = _Origin(part, source_ns, int(sheet.stamp_ns[row]), int(sheet.edition[row]))
            index, frame = int(sheet.index[row]), sheet.frame(row)
            out += pipeline.apply(index, frame, offset_ns, int(stream_ns[row]), stamp_ns=source_ns, tag=origin)
            hangup = None if pipeline.hangup is Hangup.SILENCE else pipeline.hangup
            if hangup is not self._hung.get(part):
                self._hung[part] = hangup
                self.gates.append(Gate(offset_ns, part, hangup))
            if pipeline.refused:
                self.warnings += pipeline.refused
                pipeline.refused.clear()
            if not pipeline.holding:
                self._set_mode(part)
        return self._sheet(out)

    def end(self) -> Sheet:
        """What the pipelines still hold back."""
        busy = np.flatnonzero(self._mode == _BUSY).tolist()
        return self._sheet([copy for part in busy for copy in self._pipelines[part].close()])

    def _sheet(self, out: Sequence[Outgoing]) -> Sheet:
        if not out:
            return EMPTY
        origins = [cast(_Origin, copy.tag) for copy in out]
        nbytes = np.array([len(copy.data) for copy in out], np.int64)
        faults, extra = np.empty(len(out), np.object_), np.empty(len(out), np.object_)
        faults[:] = [copy.faults if self._marks else "" for copy in out]
        extra[:] = [_extra(copy) for copy in out]
        editions = [
            self._cast.edition_of(origin.part, copy.config, origin.edition)
            for copy, origin in zip(out, origins, strict=True)
        ]
        return Sheet(
            offset_ns=np.array([copy.offset_ns for copy in out], np.int64),
            part=np.array([origin.part for origin in origins], np.int32),
            index=np.array([copy.index for copy in out], np.int64),
            copy=np.array([copy.copy for copy in out], np.int32),
            source_ns=np.array([origin.source_ns for origin in origins], np.int64),
            stamp_ns=np.array([origin.stamp_ns for origin in origins], np.int64),
            fate=np.array([_FATE_CODES[copy.fate] for copy in out], np.uint8),
            edition=np.array(editions, np.int32),
            faults=faults,
            extra=extra,
            at=np.cumsum(nbytes) - nbytes,
            nbytes=nbytes,
            wire=np.frombuffer(b"".join(copy.data for copy in out), np.uint8),
        )


def _extra(copy: Outgoing) -> Extra | None:
    extra = Extra(copy.write, copy.notice)
    return None if extra == _ORDINARY else extra


_ORDINARY = Extra()


def _mode(pipeline: Pipeline) -> int:
    if pipeline.clear:
        return _CLEAR
    return _DELAYED if pipeline.by_index else _BUSY
