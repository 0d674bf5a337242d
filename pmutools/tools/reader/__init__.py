"""StreamReader, ``pmu read``: live streams into recordings.

::

    LiveSource.rounds() -> read: counts, observers -> Recorder
                                                      Log      one recording
                                                      Rolling  numbered recordings, one after the other
                                                      Ring     a history; a recording around each trigger

A round is what came within some part of a second, a block a stream; a recorder is given one round after the other.
"""

from pmutools.tools.reader.reading import Reading
from pmutools.tools.reader.run import read

__all__ = ["Reading", "read"]
