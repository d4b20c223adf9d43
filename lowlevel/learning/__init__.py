"""How the networks learn: PPO, the estimator and absorption of the gait prior."""
