"""Networks, losses and optimizers of algorithms."""
