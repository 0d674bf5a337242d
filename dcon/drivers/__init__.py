"""Where the command goes, and where the line's status comes from: one small module a kind.

:class:`~dcon.drivers.driver.Driver` is what every output looks like to its caller.
"""
