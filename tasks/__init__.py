"""Tasks for the planner, one folder each, found by name."""
