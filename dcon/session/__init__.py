"""Session logs: what a controller run was given, decided and took, in one MCAP file.

:mod:`.log` writes and reads them, :mod:`.export` makes tables of them.
"""
