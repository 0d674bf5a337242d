"""Bytes from a terminal to keys, keys to a line of text."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmutools.cli.keys import LINE_CHARACTERS, decode, edited, help_words


@pytest.mark.parametrize(
    ("data", "keys"),
    [
        (b"a+ \t\r\n\x7f\x08\x15", ["a", "+", "SPACE", "TAB", "ENTER", "ENTER", "BACKSPACE", "BACKSPACE", "ERASE"]),
        (b"\x1b[A\x1bOB\x1b[C\x1b[D", ["UP", "DOWN", "RIGHT", "LEFT"]),
        (b"\x1b[5~\x1b[6~\x1b[Z", ["PGUP", "PGDN", "BACKTAB"]),
        (b"\x1b[1;5Cx\x1b[200~y\x1b[15~\x1bOP", ["x", "y"]),
        ("é東𝄞".encode(), ["é", "東", "𝄞"]),
        (b"\xff\xc3a\x80\x01\x00z", ["a", "z"]),
        (b"\x1bx", ["ESC", "x"]),
    ],
)
def test_bytes_are_keys_whole_and_in_pieces(data: bytes, keys: list[str]) -> None:
    assert decode(data) == (keys, b"")
    found, rest = list[str](), b""
    for byte in data:
        more, rest = decode(rest + bytes([byte]))
        found += more
    assert (found, rest) == (keys, b"")


def test_escape_alone_is_a_key_once_nothing_follows() -> None:
    assert decode(b"\x1b") == ([], b"\x1b")
    assert decode(b"\x1b", final=True) == (["ESC"], b"")
    assert decode(b"\x1b[1;") == ([], b"\x1b[1;")


@given(st.binary(max_size=300))
def test_any_bytes_are_keys(data: bytes) -> None:
    keys, rest = decode(data)
    assert len(rest) < 32
    text = ""
    for key in keys:
        text = edited(text, key)
    assert len(text) <= LINE_CHARACTERS
    assert decode(rest, final=True)[1] == b""


def test_a_line_is_edited() -> None:
    text = ""
    for key in ("a", "SPACE", "é", "UP", "BACKSPACE", "b", "ESC"):
        text = edited(text, key)
    assert text == "a b"
    assert edited(text, "ERASE") == edited("", "BACKSPACE") == ""
    assert len(edited("x" * LINE_CHARACTERS, "y")) == LINE_CHARACTERS


def test_as_many_words_of_help_as_fit() -> None:
    labels = ("a one", "", "b two", "c three", "? help", "q quit")
    assert help_words(labels, 80) == ["a one", "b two", "c three", "? help", "q quit"]
    assert help_words(labels, 20) == ["a one", "? help", "q quit"]
    assert help_words(labels, 1) == ["? help", "q quit"]
