"""One loop of the aides: rounds, beats, and words to the control process."""

from __future__ import annotations

import json
import logging
import threading
import time
from pathlib import Path
from typing import Any

from dcon.link import paths
from dcon.link.beats import LoopName, LoopState
from dcon.link.paths import Sender
from dcon.link.pulse import Pulse

LOG = logging.getLogger(__name__)
ROUND_S = 0.1
"""Longest wait of a loop."""


class Aide(threading.Thread):
    """One loop: its rounds, its beats, and its words to the control process."""

    def __init__(self, loop: LoopName, run_dir: Path) -> None:
        super().__init__(name=loop, daemon=True)
        self._watchdog, self._control = Sender(run_dir / paths.WATCHDOG), Sender(run_dir / paths.CONTROL)
        self._pulse = Pulse(loop, self._watchdog)
        self._stopped = threading.Event()
        self.failure = ""
        """Why the loop has ended by itself."""

    def run(self) -> None:
        try:
            while not self._stopped.is_set():
                self.round()
                self._pulse.beat(time.monotonic_ns())
        except Exception as error:  # the edge of the loop: its beats stop, and the process ends
            LOG.exception("the %s loop failed", self.name)
            self.failure = f"{type(error).__name__}: {error}"
        finally:
            self._pulse.due_ns = 0
            self._pulse.beat(time.monotonic_ns(), LoopState.FAILED if self.failure else LoopState.ENDING)
            self.release()

    def stop(self) -> None:
        """Ask for the end of the loop."""
        self._stopped.set()

    def round(self) -> None:
        """Do what there is to do, and wait for :data:`ROUND_S` at most."""
        raise NotImplementedError

    def release(self) -> None:
        """Let go of what the loop holds."""
        self._watchdog.close()
        self._control.close()

    def tell(self, news: dict[str, Any]) -> None:
        """To the control process."""
        self._control.send(json.dumps(news, allow_nan=False).encode())
