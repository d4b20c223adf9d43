"""The networks of the paper (section III-B)."""
