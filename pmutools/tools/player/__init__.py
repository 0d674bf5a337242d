"""Advanced Stream Player, ``pmu play``: recordings live on the wire, restamped, on absolute deadlines, with faults.

``script`` says what a source holds and when each frame is due, ``stamps`` what time it is to carry, ``play`` sends it
on time, ``ledger`` records what became of it.
"""
