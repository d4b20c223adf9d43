"""PILOT's low-level policy: batch simulation, environment, networks, PPO and the frozen controller."""
