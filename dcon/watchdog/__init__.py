"""The watchdog: its own process, clock and code. The command passes through it, and it opens the relays when in doubt.

It imports the standard library only, nothing of ours. :mod:`~dcon.watchdog.core` decides, without clock or socket;
:mod:`~dcon.watchdog.loop` is the process around it. Run as ``python -m dcon.watchdog``, or by ``dcon watchdog``.
"""
