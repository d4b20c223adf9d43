"""Robot definitions; each sub-package holds one robot."""
