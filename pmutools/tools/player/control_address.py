"""Where a player is controlled: the path of a unix socket, or ``HOST:PORT``."""

from __future__ import annotations

import ipaddress
import os
import re
import socket
from typing import NamedTuple

from pmutools.errors import SettingsError
from pmutools.net.endpoint import join_host

PATH_BYTES = 107
"""The longest path that fits ``sun_path`` of Linux, with its closing zero (macOS: 103)."""


class ControlAddress(NamedTuple):
    """A path, or a host and a port; ``str()`` gives it back."""

    path: str = ""
    host: str = ""
    port: int = 0

    def __str__(self) -> str:
        return self.path or join_host(self.host, self.port)

    @property
    def loopback(self) -> bool:
        """Whether only this machine can reach it."""
        if self.path or self.host.lower() == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False


_HOST_PORT = re.compile(r"(?:\[([^\[\]]+)\]|([^:/\[\]]+)):(\w+)")


def parse_control_address(text: str) -> ControlAddress:
    """``HOST:PORT``, ``[IPV6]:PORT``, or else a path; raises SettingsError."""
    text = text.strip()
    if not text:
        raise SettingsError("no address; write a path such as ./player.sock, or 127.0.0.1:PORT")
    if "://" in text:
        raise SettingsError(f"{text}: control has no URL; write a path, or HOST:PORT")
    if "/" not in text and ":" in text:
        match = _HOST_PORT.fullmatch(text)
        if match is None:
            raise SettingsError(f"{text}: neither a path nor HOST:PORT; IPv6 addresses stand in brackets, [::1]:PORT")
        if not match[3].isdecimal() or int(match[3]) > 0xFFFF:
            raise SettingsError(f"{text}: {match[3]!r} is no port; ports are 0..65535")
        return ControlAddress(host=match[1] or match[2], port=int(match[3]))
    if re.fullmatch(r"\d{1,3}(\.\d{1,3}){3}|localhost|\d{1,5}", text):
        raise SettingsError(f"{text}: no path, and no port; write 127.0.0.1:PORT, or ./{text} if a path is meant")
    if not hasattr(socket, "AF_UNIX"):
        raise SettingsError(f"{text}: this system has no unix sockets; write 127.0.0.1:PORT")
    if "\0" in text:
        raise SettingsError(f"{text}: a path has no NUL character; choose another")
    if (length := len(os.fsencode(text))) > PATH_BYTES:
        raise SettingsError(
            f"{text}: {length} bytes are too long for a socket's path, {PATH_BYTES} at most; choose a shorter one"
        )
    return ControlAddress(path=text)
