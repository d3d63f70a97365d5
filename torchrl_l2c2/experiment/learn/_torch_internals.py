"""Private names of torch that the experiment uses. No other file of it may use one.

:mod:`~torchrl_l2c2.experiment.learn.compilation` puts parts of torch's compiler together, which
has no public way to compile a graph that was traced by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch._guards import TracingContext, tracing
from torch._inductor import config as inductor_config
from torch._inductor.custom_graph_pass import CustomGraphPass, get_hash_for_files
from torch._subclasses import FakeTensor, FakeTensorMode
from torch.fx import GraphModule
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_flatten, tree_map_only, tree_unflatten

__all__ = [
    "CustomGraphPass",  # changes the graph before its kernels are made
    "FakeTensor",  # a tensor without contents, with which a function is traced
    "FakeTensorMode",  # makes them
    "TorchDispatchMode",  # sees every operation, and the tensors that it reaches
    "compile_graph",
    "disable_current_modes",
    "get_hash_for_files",  # the compiler's cache knows a pass by it
    "marked_as_compiling",
    "tree_flatten",  # arguments and results are nested
    "tree_map_only",
    "tree_unflatten",
]

# Makes a stand-in of a tensor without tracing how it is made.
disable_current_modes = _disable_current_modes


@contextmanager
def marked_as_compiling() -> Iterator[None]:
    """Has ``torch.compiler.is_compiling()`` be true, which nothing public sets."""
    before = torch.compiler._is_compiling_flag
    torch.compiler._is_compiling_flag = True
    try:
        yield
    finally:
        torch.compiler._is_compiling_flag = before


def compile_graph(
    module: GraphModule, inputs: list[Any], mode: FakeTensorMode, options: Mapping[str, Any]
) -> Callable[..., Sequence[Tensor]]:
    """Compiles a traced graph by inductor; ``torch.compile`` takes only functions."""
    # Takes a second to import, which those who compile nothing need not wait.
    from torch._inductor.compile_fx import compile_fx

    with tracing(TracingContext(mode)), inductor_config.patch(dict(options)):
        program: Any = compile_fx(module, inputs)
    return program
