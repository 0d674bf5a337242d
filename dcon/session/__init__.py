"""Session logs: what a controller run was given, decided and took, in one MCAP file. They are written and read here.

What is made of them is elsewhere: :mod:`dcon.replay`, :mod:`dcon.export`, :mod:`dcon.columns`.
"""
