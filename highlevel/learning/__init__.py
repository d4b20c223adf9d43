"""How planners learn: demonstrations, cloning and PPO."""
