"""What the files of a run are called, in its folder."""

from __future__ import annotations

SUMMARY, SAMPLES, INTERVALS, REPORT = "summary.json", "samples.parquet", "intervals.jsonl", "report.html"
JOURNAL = SAMPLES + ".journal"
FILES = (SUMMARY, SAMPLES, JOURNAL, INTERVALS, REPORT)
"""Those that a run takes away when it begins."""
