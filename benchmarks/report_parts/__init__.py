"""Experiments of `report.py`, one per file: functions from the extent of the run to a `Part` of the page."""
