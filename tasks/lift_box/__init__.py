"""Lift-box: the paper's autonomous task (IV-B-2)."""

from tasks.lift_box.expert import LiftBoxExpert as EXPERT
from tasks.lift_box.task import LiftBox as TASK

__all__ = ["EXPERT", "TASK"]
