"""The controller as a pure function: :func:`dcon.core.step.step` of parameters, memory, inputs and time.

No clock, no socket, no file. Live, simulated and replayed sessions all drive this one function.
"""
