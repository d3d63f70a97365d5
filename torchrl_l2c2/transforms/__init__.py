"""TorchRL transforms: neighbors for replayed batches, noise for observations."""

from torchrl_l2c2.transforms.neighbors import NeighborTransform, draw_neighbors
from torchrl_l2c2.transforms.noise import ObservationNoise

__all__ = ["NeighborTransform", "ObservationNoise", "draw_neighbors"]
