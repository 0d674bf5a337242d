"""``dcon run``: starts the processes, starts again what ends, and ends them in order."""
