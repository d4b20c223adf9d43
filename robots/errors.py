"""The root of all errors that whoever started a command can mend."""

from __future__ import annotations


class PilotError(ValueError):
    """Something that whoever started the command can mend; the message says in one sentence what and how.

    Commands end with that sentence alone. Every other exception is a bug and keeps its traceback.
    """
