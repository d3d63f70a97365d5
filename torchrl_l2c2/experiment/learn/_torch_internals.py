"""Private torch names that the experiment uses. No other file of it may use any.

:mod:`~torchrl_l2c2.experiment.learn.compilation` needs them: torch has no public function that
compiles an already traced graph.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch._guards import TracingContext, tracing
from torch._inductor import config as inductor_config
from torch._subclasses import FakeTensor, FakeTensorMode
from torch.fx import GraphModule
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_flatten, tree_map_only, tree_unflatten

__all__ = [
    "FakeTensor",  # Tensor without data, for tracing.
    "FakeTensorMode",  # Creates fake tensors.
    "TorchDispatchMode",  # Intercepts every operation.
    "compile_graph",
    "disable_current_modes",
    "marked_as_compiling",
    "onednn_linear",
    "tree_flatten",  # Arguments and results are nested.
    "tree_map_only",
    "tree_unflatten",
]

# Creates a fake tensor without tracing its creation.
disable_current_modes = _disable_current_modes


@contextmanager
def marked_as_compiling() -> Iterator[None]:
    """Makes ``torch.compiler.is_compiling()`` return true; there is no public setter."""
    before = torch.compiler._is_compiling_flag
    torch.compiler._is_compiling_flag = True
    try:
        yield
    finally:
        torch.compiler._is_compiling_flag = before


def compile_graph(
    module: GraphModule, inputs: list[Any], mode: FakeTensorMode, options: Mapping[str, Any]
) -> Callable[..., Sequence[Tensor]]:
    """Compiles a traced graph with Inductor; ``torch.compile`` supports only functions."""
    # A slow import of about a second, only needed for compilation.
    from torch._inductor.compile_fx import compile_fx

    with tracing(TracingContext(mode)), inductor_config.patch(dict(options)):
        program: Any = compile_fx(module, inputs)
    return program


def onednn_linear(rows: Tensor, weight: Tensor) -> Tensor:
    """Product ``rows @ weight.T`` of float32 matrices by oneDNN; torch has no public function."""
    product: Tensor = torch.ops.mkldnn._linear_pointwise(rows, weight, None, "none", [], "")
    return product
