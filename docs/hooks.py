"""mkdocs hook: a marker ``<!-- generated: NAME -->`` becomes what the code's own tables say (see ``generate``).

Diagrams become SVG, so that the pages need no network.
"""

from __future__ import annotations

import re
from typing import Any

from generate import GENERATORS
from generate.drawing import drawn

MARKER = re.compile(r"^<!-- generated: ([a-z0-9-]+) -->$", re.MULTILINE)


def filled(markdown: str) -> str:
    """``markdown`` with every marker replaced; raises KeyError for a name that there is not."""
    return MARKER.sub(lambda match: GENERATORS[match[1]](), markdown)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Called by mkdocs for every page."""
    return drawn(filled(markdown))
