"""What happened, line by line, in bounded memory: the first lines and the last."""

from __future__ import annotations

from collections import deque

FIRST, LAST = 200, 800


class Chronicle:
    """(UTC ns, line), at most :data:`FIRST` + :data:`LAST`; what is left out between is counted."""

    def __init__(self) -> None:
        self._first: list[tuple[int, str]] = []
        self._last: deque[tuple[int, str]] = deque(maxlen=LAST)
        self.count = 0

    def add(self, at_ns: int, line: str) -> None:
        """Take down a line."""
        self.count += 1
        (self._first if len(self._first) < FIRST else self._last).append((at_ns, line))

    @property
    def left_out(self) -> int:
        return self.count - len(self._first) - len(self._last)

    def lines(self) -> list[tuple[int, str]]:
        """All that is kept, in order."""
        gap = [(self._last[0][0], f"({self.left_out} lines left out)")] if self.left_out else []
        return [*self._first, *gap, *self._last]
