"""Bytes from a terminal to keys, and keys to a line of text; no terminal, no clock."""

from __future__ import annotations

import re
from collections.abc import Sequence

LINE_CHARACTERS = 1000


def edited(text: str, key: str) -> str:
    """A line being typed, after one more key; keys that write nothing leave it as it is."""
    match key:
        case "BACKSPACE":
            return text[:-1]
        case "ERASE":
            return ""
        case "SPACE":
            return f"{text} "[:LINE_CHARACTERS]
        case _ if len(key) == 1:
            return f"{text}{key}"[:LINE_CHARACTERS]
    return text


def help_words(labels: Sequence[str], width: int) -> list[str]:
    """As many labels of keys as fit a line; the last two always."""
    words = [label for label in labels if label]
    while len(words) > 2 and len(" ".join(words)) > width:
        del words[-3]
    return words


# --- bytes to keys -----------------------------------------------------------------------------------------------

_SEQUENCES = {
    **{
        f"\x1b{lead}{end}".encode(): name
        for lead in "[O"
        for end, name in zip("ABCDHF", ("UP", "DOWN", "RIGHT", "LEFT", "HOME", "END"), strict=True)
    },
    b"\x1b[5~": "PGUP",
    b"\x1b[6~": "PGDN",
    b"\x1b[Z": "BACKTAB",
}
_SEQUENCE = re.compile(rb"\x1b(?:\[[0-?]*[ -/]*[@-~]|O[ -~])")
_BEGUN = re.compile(rb"\x1b(?:\[[0-?]*[ -/]*|O)?")
_LONGEST = 32
"""Bytes of a sequence begun, after which it is taken for none."""
_CONTROLS = {
    0x08: "BACKSPACE",
    0x7F: "BACKSPACE",
    0x09: "TAB",
    0x0A: "ENTER",
    0x0D: "ENTER",
    0x15: "ERASE",
    0x20: "SPACE",
}


def decode(data: bytes, *, final: bool = False) -> tuple[list[str], bytes]:
    """Keys in ``data``, and what may be the beginning of one; ``final``: nothing more comes with it."""
    keys: list[str] = []
    at = 0
    while at < len(data):
        first = data[at]
        if first == 0x1B:
            if match := _SEQUENCE.match(data, at):
                if name := _SEQUENCES.get(match[0]):
                    keys.append(name)
                at = match.end()
                continue
            begun = _BEGUN.match(data, at)
            if begun is not None and begun.end() == len(data) and not final and begun.end() - at < _LONGEST:
                break
            keys.append("ESC")
            at += 1
        elif first in _CONTROLS:
            keys.append(_CONTROLS[first])
            at += 1
        elif first < 0x80:
            keys += [chr(first)] if first >= 0x20 else []
            at += 1
        else:
            length = 2 if 0xC2 <= first < 0xE0 else 3 if 0xE0 <= first < 0xF0 else 4 if 0xF0 <= first < 0xF5 else 1
            if at + length > len(data) and not final:
                break
            text = data[at : at + length].decode("utf-8", "ignore")
            keys += [text] if text.isprintable() and text else []
            at += length if text else 1
    return keys, data[at:]
