"""Who can say how good this machine's clock is: the kernel, chrony, ptp4l, gpsd. They are asked, never changed.

Each module has a pure reader of a program's words and the question itself. What is not installed, does not run or
answers nonsense is :class:`~pmutools.clocksources.asking.NoAnswer` with the reason; every question has a time-out.
:class:`~pmutools.clocksources.watch.ClockWatch` asks all of them from time to time, beside whatever else runs.
"""
