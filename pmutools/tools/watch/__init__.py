"""What live streams do just now, thousands of them: state, rate, delay, losses, quality, frequency; in bounded memory.

A :class:`~pmutools.tools.watch.watch.Watch` takes what comes (blocks, news) and the time; a
:class:`~pmutools.tools.watch.snapshot.Snapshot` of it is what a display draws. All streams are columns: a round of
frames of all of them costs a few dozen numpy calls and a microsecond or two a block, not a call a frame.
"""

from pmutools.tools.watch.snapshot import Row, Snapshot, StreamState
from pmutools.tools.watch.watch import Watch

__all__ = ["Row", "Snapshot", "StreamState", "Watch"]
