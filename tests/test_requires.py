"""An absent program skips a test on a desk and fails it in CI, saying so either way."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from support import captures
from support.requires import requires_module


@pytest.mark.parametrize("ci", [None, "", "0", "false"])
def test_absent_program_skips(monkeypatch: pytest.MonkeyPatch, requires: Callable[[str], Path], ci: str | None) -> None:
    monkeypatch.delenv("CI", raising=False) if ci is None else monkeypatch.setenv("CI", ci)
    with pytest.raises(pytest.skip.Exception, match="no-such-program is not installed"):
        requires("no-such-program")


def test_absent_program_fails_in_ci(monkeypatch: pytest.MonkeyPatch, requires: Callable[[str], Path]) -> None:
    monkeypatch.setenv("CI", "true")
    with pytest.raises(pytest.fail.Exception, match="no-such-program is not installed, and CI must have it"):
        requires("no-such-program")
    with pytest.raises(pytest.fail.Exception, match="no_such_module is not importable"):
        requires_module("no_such_module")


def test_present_program_is_found(requires: Callable[[str], Path]) -> None:
    assert requires("sh").exists()


def test_absent_capture_skips_even_in_ci(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CI", "true")
    monkeypatch.setattr(captures, "CAPTURE_DIR", tmp_path)
    with pytest.raises(pytest.skip.Exception, match=r"real capture x\.pcap is not in"):
        captures.capture_path("x.pcap")
