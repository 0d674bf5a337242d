"""Fixtures for all tests. Code that tests import lives in ``tests/support``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from support.requires import requires as _requires


@pytest.fixture
def requires() -> Callable[[str], Path]:
    """``requires("tshark")``: path of an external program; absent, the test is skipped, and fails in CI."""
    return _requires
