"""Logged messages: one table (:mod:`.messages`), its protobuf form, and MCAP logs that carry it.

:mod:`.log_writer` and :mod:`.log_reader` know MCAP and nothing of the messages; :mod:`.pmu_log` puts PMU frames in
and takes them out again as wire bytes.
"""
