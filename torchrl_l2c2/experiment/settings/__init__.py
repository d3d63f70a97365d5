"""Every setting of a run: default, range, meaning. Without torch."""
