"""Delay, loss, order, quality: what can be told of PMU streams from their frames' stamps and arrivals.

A :class:`~pmutools.measure.stream.StreamMeter` takes batches of one stream in order of arrival and counts in constant
memory; its counts merge. :mod:`~pmutools.measure.summary` tells the result as ``summary.json``. Pure: no clock, no I/O.
"""
