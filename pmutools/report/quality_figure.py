"""The heat map of quality: which stream was good when."""

from __future__ import annotations

import math

import numpy as np

from pmutools.measure.histogram import NS_PER_MS
from pmutools.report import theme
from pmutools.report.figures import Axis, Figure, Floats, Heat, Panel, time_axis
from pmutools.report.text import plural, span
from pmutools.report.view import Stream, View
from pmutools.timebase import NS

COLUMNS, FEWER_COLUMNS = 240, 120
ROWS = 1000
"""More streams are not drawn."""
_MANY = 300
LEAST_NS = NS
"""A column is no shorter: of few frames one lost is a large share."""
_LIMITS = (1.0, 0.999, 0.99, 0.95, 0.5, 1e-9)
CLASSES = tuple(
    zip(("all", "99.9 %", "99 %", "95 %", "50 %", "less", "nothing"), theme.STEPS, strict=True),
)
"""By the least share of the due frames that can be used."""


def quality_figure(view: View) -> Figure | None:
    """A row a stream, a column a stretch of time; None where nothing came at a known time."""
    streams = [each for each in view.measured if each.course is not None and each.course.frames.any()][:ROWS]
    if not streams or view.shown_ms is None:
        return None
    begin, end = (round(bound * NS_PER_MS) for bound in view.shown_ms)
    columns = COLUMNS if len(streams) <= _MANY else FEWER_COLUMNS
    width = max((each.course.width_ns for each in streams if each.course is not None), default=1)
    width *= max(1, math.ceil(max((end - begin) / columns, LEAST_NS) / width))
    columns = max(1, math.ceil((end - begin) / width))
    share = np.stack([usable_share(each, begin, width, columns) for each in streams])
    level = np.where(np.isnan(share), -1, np.searchsorted(-np.array(_LIMITS), -share)).astype(np.int8)
    rows = len(streams)
    return Figure(
        "quality",
        "Quality over time",
        f"Share of the due frames of {plural(rows, 'stream')} that can be used, in stretches of {span(width)}: "
        f"{np.count_nonzero(level > 0)} of {np.count_nonzero(level >= 0)} cells are less than all",
        time_axis("time", view.shown_ms),
        [
            Panel(
                Axis("", names=[each.label for each in streams]),
                [
                    Heat(
                        (begin + width * (np.arange(columns) + 0.5)).astype(np.float64) / NS_PER_MS,
                        level,
                        100 * share,
                        "% of the due frames can be used",
                        CLASSES,
                    )
                ],
            )
        ],
        f"At least so many of the frames due in {span(width)} came with data that STAT calls valid and synchronised. "
        "White: before the first frame, or after the last.",
        min(900, 105 + 19 * max(2, rows)),
        wide=True,
    )


def usable_share(stream: Stream, begin_ns: int, width_ns: int, columns: int) -> Floats:
    """(C,) share of the due frames that can be used; NaN where none is due. In a silence between frames it is 0."""
    course = stream.course
    assert course is not None
    at = np.clip((course.time_ns - begin_ns) // width_ns, 0, columns - 1)
    bad = np.maximum(course.unsynchronised, course.unusable)
    came = np.maximum(course.frames - course.duplicated, 0)
    usable, due, frames = (
        np.bincount(at, part, columns) for part in (np.maximum(came - bad, 0), came + course.lost, course.frames)
    )
    share: Floats = np.divide(usable, due, out=np.full(columns, np.nan), where=due > 0)
    if stream.result.rate and stream.result.period_ns < width_ns:
        some = np.flatnonzero(frames)
        inside = slice(int(some[0]), int(some[-1]) + 1)
        share[inside] = np.nan_to_num(share[inside], nan=0.0)
    return share
