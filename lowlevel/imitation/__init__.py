"""A better way of acting cloned into the policy: the gait prior's, or that of a policy that is told something else."""
