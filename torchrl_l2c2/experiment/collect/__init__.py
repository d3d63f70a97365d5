"""Episodes and rollouts of environments."""
