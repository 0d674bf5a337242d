"""``make bench``: measure, print a table, and write ``docs/speed-table.md``.

Exit code 1 where a budget of codec, capture or start-up is missed. ``--quick`` runs everything on next to nothing, to
see that it runs; it writes and judges nothing.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

NEEDED = ("pmutools", "pytest", "synchrophasor", "pyc37", "fastcrc")


def main() -> int:
    """Exits with one line where something is not installed that is measured."""
    if lacking := [name for name in NEEDED if importlib.util.find_spec(name) is None]:
        sys.exit(f"bench: not installed: {', '.join(lacking)}; pip install -e '.[dev]' brings all that is measured")
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # processor time is counted: idle threads must not spin
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from bench import suite

    return suite.main()


if __name__ == "__main__":
    sys.exit(main())
