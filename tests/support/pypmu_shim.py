"""pypmu (PyPI ``synchrophasor`` 1.0.0a0) made to run on Python >= 3.10, for comparison and benchmarks.

What it can: decode and encode data, header, command, CFG-1 and CFG-2 frames one at a time (``CommonFrame``).
What it cannot: see :data:`support.peers.PYC37_LIMITS`, whose codec is the same code.
"""

from __future__ import annotations

import collections.abc
from types import ModuleType, SimpleNamespace

from support.requires import requires_module


def pypmu_frame() -> ModuleType:
    """The module ``synchrophasor.frame``; its only use of ``collections`` is ``Sequence``, gone since Python 3.10."""
    module = requires_module("synchrophasor.frame")
    module.collections = SimpleNamespace(Sequence=collections.abc.Sequence)  # type: ignore[attr-defined]
    return module
