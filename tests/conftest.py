"""Fixtures for all tests. Code that tests import lives in ``tests/support``."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: matrices here are small, and threads that wait spin

from support.requires import requires as _requires

pytest.register_assert_rewrite("support.logged", "support.paper_facts", "support.trial_facts", "support.wire_judges")


@pytest.fixture
def requires() -> Callable[[str], Path]:
    """``requires("tshark")``: path of an external program; absent, the test is skipped, and fails in CI."""
    return _requires
