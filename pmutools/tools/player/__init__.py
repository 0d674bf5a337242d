"""Advanced Stream Player, ``pmu play``: recordings live on the wire, restamped, on absolute deadlines, with faults.

``material`` opens what a person names; ``reel`` holds it, each frame with the time at which it is due; ``cast`` says
which PMUs play it. ``plan`` makes ``sheet`` after ``sheet`` of it, in virtual time: ``dress`` gives frames the stamps
of ``stamps``, ``route`` takes them through their faults. ``play`` is the loop, ``delivery`` sends, ``results`` and
``ledger`` record what became of each frame. ``control``, its server and its client tell a running player what to do.
"""
