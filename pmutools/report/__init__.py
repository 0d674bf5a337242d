"""Reports for people: one HTML page that works offline, and the same figures as PNG and SVG.

What a figure shows is plain data (:mod:`~pmutools.report.figures`), drawn by plotly's JavaScript on the page and by
matplotlib in files, so that the two cannot differ. :mod:`~pmutools.report.page` is the page's shell, for any report;
:mod:`~pmutools.report.characterizer` is the report of a measured run.
"""

from pmutools.report.characterizer import write_report

__all__ = ["write_report"]
