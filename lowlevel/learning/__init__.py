"""How the networks learn: PPO and the estimator."""
