"""How fast things are: what the benchmark measures, and what it compares with."""
