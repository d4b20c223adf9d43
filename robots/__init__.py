"""Robot definitions; each sub-package holds one robot."""

from robots import startup as startup
