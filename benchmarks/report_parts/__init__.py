"""The experiments of `report.py`: one a file, each a function from the extent of the run to a `Part` of the page."""
