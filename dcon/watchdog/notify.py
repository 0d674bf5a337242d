"""``sd_notify(3)``, in the few lines that this process needs of it."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from typing import Final

from dcon.watchdog.links import Post

READY: Final = "READY=1"
ALIVE: Final = "WATCHDOG=1"
STOPPING: Final = "STOPPING=1"


class Notify:
    """Tells systemd, where it has asked for it. Never waits, never raises."""

    def __init__(self, environ: Mapping[str, str] = os.environ) -> None:
        name = environ.get("NOTIFY_SOCKET", "")
        path = "\0" + name[1:] if name.startswith("@") else name
        self._post = Post(socket.AF_UNIX, path) if name else None

    def tell(self, *lines: str) -> None:
        """Assignments, ``NAME=VALUE`` each."""
        if self._post is not None:
            self._post.send("\n".join(lines).encode())
