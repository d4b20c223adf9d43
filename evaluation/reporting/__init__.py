"""From measurements to reports: intervals, plots, files."""
