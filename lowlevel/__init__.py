"""PILOT's low-level policy: batch simulation, environment, networks, PPO and the frozen controller."""

from lowlevel.runs import processes as processes
from robots import startup as startup  # before MuJoCo is imported
