"""Compiling the experiment's hot functions, where a compiler is at hand."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from typing import Any

import torch


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compiles a function, which may take gradients, into one graph.

    Random numbers are drawn as without compilation.
    """
    # Without it the graph ends at the gradient, and the step is several small ones.
    torch._dynamo.config.trace_autograd_ops = True
    # Every run of a sweep compiles the same code for objects of its own: counted together, they
    # would soon meet the limit of recompilations.
    return torch.compile(
        function, fullgraph=True, isolate_recompiles=True, options={"fallback_random": True}
    )


def compiler_available() -> bool:
    """Whether the C++ compiler is there that ``torch.compile`` needs on the CPU."""
    return any(shutil.which(name) for name in ("g++", "clang++", "c++"))
