"""Settings of a run, with defaults, ranges and descriptions. Does not import torch."""
