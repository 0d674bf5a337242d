"""The ``gui`` loop: signed orders of operators."""

from __future__ import annotations

import json
import select
import time
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from dcon.aides.aide import ROUND_S, Aide
from dcon.aides.handing import Handing, Reply
from dcon.aides.order_gate import OrderGate, Passed
from dcon.link import paths
from dcon.link.beats import LoopName
from dcon.link.paths import Sender

AGAIN_S = 0.005
"""From one try to hand on an order to the next."""


class GuiAide(Aide):
    """Operators' orders."""

    def __init__(self, gate: OrderGate, run_dir: Path) -> None:
        """Raises SourceError where another process has the place."""
        super().__init__(LoopName.GUI, run_dir)
        self._inbox = paths.bind_datagram(run_dir, paths.AIDE)
        self.gate = gate
        self.handing = Handing()
        self._run_dir = run_dir.resolve()

    def round(self) -> None:
        passed = Passed()
        if select.select([self._inbox], [], [], AGAIN_S if len(self.handing) else ROUND_S)[0]:
            with suppress(BlockingIOError):
                passed = self.gate.take(self._inbox.recv(1 << 16), time.monotonic_ns(), time.time_ns())
        now_ns = time.monotonic_ns()
        self.handing.add(passed, now_ns)
        replies = self.handing.send(self._control.send, now_ns)
        if passed.reply is not None:
            replies.append(Reply(passed.reply_to, passed.reply))
        for path, said in replies:
            self._reply(path, said)

    def counts(self) -> dict[str, int]:
        gate = self.gate
        own = {"orders_refused": gate.refused, "orders_malformed": gate.malformed, "orders_lost": self.handing.lost}
        return super().counts() | own

    def _reply(self, path: str, reply: dict[str, Any]) -> None:
        """To a name in the run folder only: who writes to this loop must not have it write elsewhere."""
        where = Path(path)
        try:
            if where.name and where.parent.resolve() == self._run_dir:
                with closing(Sender(where)) as sender:
                    sender.send(json.dumps(reply).encode())
        except (OSError, ValueError, RuntimeError):  # a NUL, what is no text, links in a ring: no path can be that
            self.gate.malformed += 1

    def release(self) -> None:
        super().release()
        paths.release(self._inbox)
