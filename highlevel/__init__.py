"""High level: planners that drive the frozen controller with whole-body commands.

Importing this package registers every task as a Gymnasium environment, such as ``pilot/LiftBox-v0``.
"""

from highlevel.registry import register_tasks
from robots import startup as startup  # before MuJoCo is imported

register_tasks()
