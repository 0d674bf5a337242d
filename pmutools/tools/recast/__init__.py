"""Streams made into other streams on their way to a player or a file: IDCODE, names, FORMAT, concentration.

Each function takes the blocks, frames and losses of a source (:meth:`~pmutools.formats.source.Source.blocks`) and
yields the same kinds of items. None holds more than a part of the source. What they did, and could not do, is counted
in a :class:`Changes` that the caller hands in, and told by :func:`described`.

Data frames keep stamps, arrivals and time quality; their CHK is made anew.
"""

from pmutools.tools.recast.changes import Changes, described
from pmutools.tools.recast.concentrate import concentrated
from pmutools.tools.recast.form import Form, parse_form, reformatted
from pmutools.tools.recast.identity import check_renumbering, renamed, renumbered

__all__ = [
    "Changes",
    "Form",
    "check_renumbering",
    "concentrated",
    "described",
    "parse_form",
    "reformatted",
    "renamed",
    "renumbered",
]
