"""Compiling the experiment's hot functions, where a compiler is at hand."""

from __future__ import annotations

import inspect
import re
import shutil
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch._inductor.custom_graph_pass import CustomGraphPass, get_hash_for_files
from torch.fx import Graph


def compiled(
    function: Callable[..., Any], *, takes_gradients: bool = False, constant_closure: bool = False
) -> Callable[..., Any]:
    """Compiles a function into one graph.

    Random numbers are drawn as without compilation.

    Args:
        function (Callable): what is compiled, at its first call.

    Keyword Args:
        takes_gradients (bool): whether the function calls ``torch.autograd.grad``. Default
            ``False``.
        constant_closure (bool): whether all that the function reaches other than by its arguments
            stays as it is at the first call, but for what is written *into* its tensors. It is
            then not checked at every call, which for an agent's hundreds of tensors takes longer
            than the smallest networks; a setting changed or a tensor replaced later would be
            overlooked. Default ``False``.

    Returns:
        Callable: the compiled function.
    """
    # The sizes of the inputs are checked before the graph is chosen: once is enough.
    options: dict[str, Any] = {"fallback_random": True, "size_asserts": False}
    options["post_grad_custom_post_pass"] = _BiasesApart()
    if constant_closure:
        options["guard_filter_fn"] = _only_arguments_of(function)
    # Every run of a sweep compiles the same code for objects of its own: counted together, they
    # would soon meet the limit of recompilations.
    graph = torch.compile(  # type: ignore[call-overload]  # The stubs lack isolate_recompiles.
        function, fullgraph=True, isolate_recompiles=True, options=options
    )
    # Not for all: setting and resetting takes as long as a smaller network's layer.
    return _tracing_gradients(graph) if takes_gradients else graph


def _tracing_gradients(function: Callable[..., Any]) -> Callable[..., Any]:
    """Lets Dynamo trace gradients while the function runs, which may be when it is compiled.

    Without it the graph ends at the gradient, and the step is several small ones. The setting is
    of the whole process: others find it as they left it.
    """
    config = torch._dynamo.config

    def call(*args: Any) -> Any:
        before = config.trace_autograd_ops
        config.trace_autograd_ops = True
        try:
            return function(*args)
        finally:
            config.trace_autograd_ops = before

    return call


class _BiasesApart(CustomGraphPass):
    """Takes biases out of matrix products, into the kernels of what follows.

    A product with a bias begins with a copy of the bias into every row of its result: a call and a
    pass over memory that the kernel after it, which reads the result anyway, makes superfluous.
    Torch's own pass of this kind is for GPUs alone.
    """

    def __call__(self, graph: Graph) -> None:
        aten = torch.ops.aten
        for node in graph.find_nodes(op="call_function", target=aten.addmm.default):
            if node.kwargs:  # factors other than 1
                continue
            bias, left, right = node.args
            with graph.inserting_before(node):
                product = graph.call_function(aten.mm.default, (left, right))
                total = graph.call_function(aten.add.Tensor, (product, bias))
            for new in (product, total):
                new.meta.update(node.meta)
            node.replace_all_uses_with(total)
            graph.erase_node(node)

    def uuid(self) -> bytes:
        """What the compiler's cache knows the pass by: the contents of this file."""
        return get_hash_for_files((__file__,))


def _only_arguments_of(function: Callable[..., Any]) -> Callable[[Sequence[Any]], list[bool]]:
    """Keeps the checks of a function's arguments and of torch's global state."""
    code = function.__code__
    # A check of torch's own state, such as the gradient mode, has no name.
    arguments = code.co_argcount + bool(code.co_flags & inspect.CO_VARARGS)
    kept = {"", *code.co_varnames[:arguments]}
    return lambda guards: [re.split(r"[.\[]", guard.name)[0] in kept for guard in guards]


def compiler_available() -> bool:
    """Whether the C++ compiler is there that ``torch.compile`` needs on the CPU."""
    return any(shutil.which(name) for name in ("g++", "clang++", "c++"))
