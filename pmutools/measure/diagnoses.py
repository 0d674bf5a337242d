"""What is most likely wrong, in words: a table of symptoms, each with its numbers and a remedy.

A row looks at one stream's result beside the receiver's clock and the other streams, and says a sentence or nothing.
"""

from __future__ import annotations

from pmutools.measure import arrival_signs, clock_signs, device_signs, period_signs
from pmutools.measure.scene import Diagnosis, Row, Scene

ROWS: tuple[Row, ...] = (
    *clock_signs.ROWS,
    *device_signs.ROWS,
    *period_signs.ROWS,
    *arrival_signs.ROWS,
    *period_signs.NOTES,
    *device_signs.NOTES,
)


def diagnose(scene: Scene) -> list[Diagnosis]:
    """All rows that have something to say, in the table's order: clocks first, as they colour all else; notes last."""
    return [Diagnosis(row.id, text, row.level) for row in ROWS if (text := row.test(scene))]
