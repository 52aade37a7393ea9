"""Numbers and pictures -> one page that needs nothing else: pictures are inside it, and so is the program that shows the model.

Sections whose numbers the metrics do not hold are left out. The metrics' layout:

    {"stages": [{"name", "seconds", "peak_memory_mb", "status"?}], "rounds": [{"round", "residual", ...}],
     "status": {"name", "text"}, "model": {"components": [{"name", "kept", "gain", "noise", "seconds"}]}, "truth": {name: number}}
"""

from mvps.report.page import report_html, write_report

__all__ = ["report_html", "write_report"]
