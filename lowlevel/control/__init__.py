"""What travels to a robot: observation, reference, one control step, the frozen controller."""
