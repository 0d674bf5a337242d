"""Power systems small enough to run beside the tools: plants, emulated PMUs, disturbances.

A :class:`~pmutools.grid.grid.Grid` is a plant that lives through a scenario, in virtual time or in step with a clock;
:mod:`~pmutools.grid.pmu_model` turns its buses into what PMUs would report.
"""
