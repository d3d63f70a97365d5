"""Global state of the process: random generators, threads and memory."""

from __future__ import annotations

import ctypes
import random
from collections.abc import Mapping
from types import TracebackType
from typing import Any

import numpy as np
import torch
from torchrl.checkpoint import GlobalRNGState

# Parameters of glibc's mallopt, in bytes: free memory above TRIM_THRESHOLD is returned to the
# system, and blocks above MMAP_THRESHOLD are mapped again at every allocation.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_LARGEST = 2**31 - 1

_GENERATORS = GlobalRNGState()


class ProcessState:
    """Context manager with a run's own global random generators and number of threads.

    The previous state of the process is restored at exit. The generators initialize networks and
    sample actions.

    Args:
        seed (int): Seed of the generators of Python, NumPy and PyTorch.
        threads (int): Number of PyTorch threads. Default 1.

    Examples:
        >>> import torch
        >>> process = ProcessState(seed=0)
        >>> with process:
        ...     first = torch.rand(())
        >>> _ = torch.rand(100)
        >>> with process:
        ...     second = torch.rand(())
        >>> generator = torch.Generator().manual_seed(0)
        >>> both = [torch.rand((), generator=generator) for _ in range(2)]
        >>> [first, second] == both
        True
    """

    def __init__(self, seed: int, threads: int = 1) -> None:
        self._threads = threads
        outside = _GENERATORS.state_dict()
        random.seed(seed)
        np.random.seed(seed)
        torch.manual_seed(seed)
        self._inside = _GENERATORS.state_dict()
        self._outside: dict[str, Any] | None = None  # Set while the context is entered.
        _restore(outside)

    def __enter__(self) -> None:
        self._outside, self._outside_threads = _GENERATORS.state_dict(), torch.get_num_threads()
        _restore(self._inside)
        torch.set_num_threads(self._threads)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        assert self._outside is not None
        self._inside = _GENERATORS.state_dict()
        _restore(self._outside)
        torch.set_num_threads(self._outside_threads)
        self._outside = None

    def state_dict(self) -> dict[str, Any]:
        """Returns the states of the run's generators, as TorchRL's ``GlobalRNGState``."""
        return self._inside if self._outside is None else _GENERATORS.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores a state of :meth:`state_dict`."""
        self._inside = dict(state)
        if self._outside is not None:
            _restore(self._inside)


def keep_freed_memory() -> bool:
    """Lets the process keep freed memory for the next update.

    Otherwise the system maps the tensors of large batches again at every update, which is slow. The
    process then keeps its peak memory until its end. Intended for processes that mainly train:
    ``train.py`` calls it.

    Returns:
        bool: Whether the C library supports it; only glibc does.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False
    kept = mallopt(_TRIM_THRESHOLD, _LARGEST) and mallopt(_MMAP_THRESHOLD, _LARGEST // 2)
    return bool(kept)


def _restore(state: Mapping[str, Any]) -> None:
    """Sets the generators. GPU generators are set only if the number of GPUs is the same."""
    gpus = len(state.get("torch_cuda", ()))
    if gpus and gpus != torch.cuda.device_count():
        state = {name: each for name, each in state.items() if name != "torch_cuda"}
    _GENERATORS.load_state_dict(state)
