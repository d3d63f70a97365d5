"""Global state of the process: random generators, threads and memory."""

from __future__ import annotations

import ctypes
import json
import random
from collections.abc import Mapping
from types import TracebackType
from typing import Any

import numpy as np
import torch

# Parameters of glibc's mallopt, in bytes: free memory above the first threshold is returned to the
# system, and blocks above the second are mapped again at every allocation.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_LARGEST = 2**31 - 1

_States = tuple[Any, Any, torch.Tensor, list[torch.Tensor]]
"""States of the random generators of Python, NumPy, PyTorch and CUDA devices."""


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
        outside = _states()
        random.seed(seed)
        np.random.seed(seed)
        torch.manual_seed(seed)
        self._inside = _states()
        self._outside: _States | None = None  # None outside of the context.
        _set_states(outside)

    def __enter__(self) -> None:
        self._outside, self._outside_threads = _states(), torch.get_num_threads()
        _set_states(self._inside)
        torch.set_num_threads(self._threads)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        assert self._outside is not None
        self._inside = _states()
        _set_states(self._outside)
        torch.set_num_threads(self._outside_threads)
        self._outside = None

    def state_dict(self) -> dict[str, Any]:
        """Returns the states of the generators as tensors and JSON."""
        now = self._inside if self._outside is None else _states()
        python, (name, keys, *rest), state, devices = now
        return {
            "python": json.dumps(python),
            "numpy": json.dumps([name, keys.tolist(), *rest]),
            "torch": state,
            "cuda": devices,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores a state of :meth:`state_dict`."""
        version, internal, gauss = json.loads(state["python"])
        name, keys, *rest = json.loads(state["numpy"])
        numpy = (name, np.array(keys, dtype=np.uint32), *rest)
        python = (version, tuple(internal), gauss)
        self._inside = (python, numpy, state["torch"], state.get("cuda", []))
        if self._outside is not None:
            _set_states(self._inside)


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


def _states() -> _States:
    devices = torch.cuda.get_rng_state_all() if torch.cuda.is_available() else []
    return random.getstate(), np.random.get_state(), torch.get_rng_state(), devices


def _set_states(states: _States) -> None:
    random.setstate(states[0])
    np.random.set_state(states[1])
    torch.set_rng_state(states[2])
    if torch.cuda.is_available():  # The states may come from a machine with more devices.
        torch.cuda.set_rng_state_all(states[3][: torch.cuda.device_count()])
