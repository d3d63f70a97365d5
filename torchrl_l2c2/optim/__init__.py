"""Optimizers."""

from torchrl_l2c2.optim.adaterm import AdaTerm

__all__ = ["AdaTerm"]
