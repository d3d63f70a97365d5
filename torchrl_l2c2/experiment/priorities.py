"""Drawing by priority from TorchRL's trees, and setting priorities in them, without detours."""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.data import PrioritizedSampler


def draw_by_priority(
    sampler: PrioritizedSampler, stored: int, batch_size: int
) -> tuple[Tensor, Tensor]:
    """What ``sampler.sample`` gives, to the bit, for one-dimensional storages on the CPU.

    Most of its time goes into finding out that an index is a tensor on the CPU: the trees take
    NumPy's arrays at once.

    Args:
        sampler (PrioritizedSampler): with a generator of its own.
        stored (int): rows that hold something, at least 1.
        batch_size (int): rows to draw.

    Returns:
        tuple: rows and their importance weights, each ``[batch_size]``.

    Raises:
        FloatingPointError: the priorities do not allow to draw.
    """
    tree = sampler._sum_tree
    total, least = tree.query(0, stored), sampler._min_tree.query(0, stored)
    if total <= 0 or least <= 0:
        raise FloatingPointError(
            f"priorities must be positive, got a sum of {total}, a least of {least}: a smaller "
            f"replay.alpha than {sampler._alpha} keeps small errors apart from 0."
        )
    mass = torch.rand(batch_size, generator=sampler._rng) * total
    rows = torch.from_numpy(tree.scan_lower_bound(mass.numpy())).clamp_max_(stored - 1)
    priorities = tree[rows.numpy()]
    while not priorities.all():  # Rounding has led to one that cannot be drawn.
        rows = rows - torch.from_numpy(priorities == 0).long()
        if int(rows.min()) < 0:  # The first rows have none.
            known = torch.from_numpy(tree[torch.arange(stored).numpy()])
            rows = torch.where(rows < 0, known.nonzero()[0], rows)
        priorities = tree[rows.numpy()]
    return rows, torch.pow(torch.from_numpy(priorities) / least, -sampler._beta)


def set_priorities(sampler: PrioritizedSampler, rows: Tensor, priority: Tensor) -> None:
    """What ``sampler.update_priority`` does, for the rows of :func:`draw_by_priority`.

    Args:
        sampler (PrioritizedSampler): written to.
        rows (Tensor): ``[B]``.
        priority (Tensor): at least 0, ``[B]``, without a gradient.
    """
    highest, place = priority.max(dim=0)
    known, _ = sampler._max_priority
    if known is None or highest > known:
        sampler._max_priority = highest, rows[place]
    transformed = torch.pow(priority + sampler._eps, sampler._alpha).numpy()
    for tree in (sampler._sum_tree, sampler._min_tree):
        tree[rows.numpy()] = transformed


def leave_out(sampler: PrioritizedSampler, rows: Tensor) -> None:
    """Has rows drawn no more, until something else is stored in their place.

    They count for no other row's importance weight, either.
    """
    sampler._sum_tree[rows.numpy()] = torch.zeros(len(rows)).numpy()
    sampler._min_tree[rows.numpy()] = torch.full((len(rows),), torch.inf).numpy()
