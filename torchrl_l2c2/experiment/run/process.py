"""State of the whole process: random generators, threads and memory, for one run at a time."""

from __future__ import annotations

import ctypes
import json
import random
from collections.abc import Mapping
from types import TracebackType
from typing import Any

import numpy as np
import torch

# glibc's mallopt, in bytes up to the largest int: blocks above the one threshold are mapped anew at
# every allocation; free memory above the other is given back to the system.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_LARGEST = 2**31 - 1

_States = tuple[Any, Any, torch.Tensor, list[torch.Tensor]]
"""States of the generators of Python, NumPy, PyTorch and its CUDA devices."""


class ProcessState:
    """The global random generators and the number of threads, as a run of its own has them.

    Within the context they belong to the run; after it the process has its own again. Networks are
    initialized from the generators, and policies sample from them.

    Args:
        seed (int): seed of the generators of Python, NumPy and PyTorch.
        threads (int): number of threads of PyTorch. Default 1.

    Examples:
        >>> import torch
        >>> ours = ProcessState(seed=0)
        >>> with ours:
        ...     first = torch.rand(())
        >>> _ = torch.rand(100)
        >>> with ours:
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
        self._outside: _States | None = None  # While the context is not entered.
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
        """The generators' states, as tensors and text."""
        now = self._inside if self._outside is None else _states()
        python, (name, keys, *rest), state, devices = now
        return {
            "python": json.dumps(python),
            "numpy": json.dumps([name, keys.tolist(), *rest]),
            "torch": state,
            "cuda": devices,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave."""
        version, internal, gauss = json.loads(state["python"])
        name, keys, *rest = json.loads(state["numpy"])
        numpy = (name, np.array(keys, dtype=np.uint32), *rest)
        python = (version, tuple(internal), gauss)
        self._inside = (python, numpy, state["torch"], state.get("cuda", []))
        if self._outside is not None:
            _set_states(self._inside)


def keep_freed_memory() -> bool:
    """Lets the process keep the memory that it frees, for the next update, which needs as much.

    Otherwise the tensors of larger batches are handed out anew by the system at every update, page
    by page, which takes long. The process then holds the most that it ever
    needed, to its end. For processes that train and do little else: ``train.py`` calls it.

    Returns:
        bool: whether the C library took it; others than glibc have settings of their own.
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
    if torch.cuda.is_available():  # A machine with more devices has more states.
        torch.cuda.set_rng_state_all(states[3][: torch.cuda.device_count()])
