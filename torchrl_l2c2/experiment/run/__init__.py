"""A run: the loop, tests during training, the folder, checkpoints and resuming."""
