"""What a test needs from outside Python: absent, it is skipped with the reason; in CI it fails."""

from __future__ import annotations

import importlib
import os
import shutil
from pathlib import Path
from types import ModuleType
from typing import NoReturn

import pytest


def requires(program: str) -> Path:
    """Path of an external program. In CI (environment ``CI`` set and not ``false``) its absence fails the test."""
    found = shutil.which(program)
    if found is None:
        _absent(f"{program} is not installed")
    return Path(found)


def requires_module(name: str) -> ModuleType:
    """An independent library, imported; same rule."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        _absent(f"{name} is not importable: {error}")


def _absent(reason: str) -> NoReturn:
    if os.environ.get("CI", "false").lower() not in ("", "0", "false"):
        pytest.fail(f"{reason}, and CI must have it", pytrace=False)
    pytest.skip(reason)
