"""Compiling the experiment's hot functions, where a compiler is at hand.

A function runs once with tensors that have no contents, and what it does to them is a graph;
tensors that it reached by itself become inputs of that; torch's compiler makes a program of it.
``torch.compile`` would read the Python instead, instruction by instruction, which takes several
times as long at the start of every run, and it checks more at every call.
"""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.fx import Graph, GraphModule
from torch.fx.experimental.proxy_tensor import get_proxy_mode, make_fx, track_tensor_tree
from torch.fx.experimental.symbolic_shapes import ShapeEnv

from torchrl_l2c2.experiment.errors import CompilerError
from torchrl_l2c2.experiment.learn._torch_internals import (
    CustomGraphPass,
    FakeTensor,
    FakeTensorMode,
    TorchDispatchMode,
    compile_graph,
    disable_current_modes,
    get_hash_for_files,
    marked_as_compiling,
    tree_flatten,
    tree_map_only,
    tree_unflatten,
)


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compiles a function into one graph, with the gradients that it takes.

    Random numbers are drawn as without compilation. What comes out has no gradient.

    Whatever the function reaches other than by its arguments has to stay as it is at the first
    call, but for what is written *into* tensors: a setting changed or a tensor replaced later is
    overlooked. Arguments of other shapes, and other values of those that are no tensors, have
    graphs of their own.

    Args:
        function (Callable): what is compiled, at its first call. What it does may not depend on
            what its tensors hold, and it may keep none of them.

    Returns:
        Callable: the compiled function. It raises :class:`CompilerError` where there is none.
    """
    programs: dict[tuple[Any, ...], _Program] = {}

    def call(*args: Any) -> Any:
        tensors, rest, spec = _split(args)
        key = (*rest, *((t.shape, t.stride(), t.dtype, t.device) for t in tensors))
        program = programs.get(key)
        if program is None or program.spec != spec:
            program = programs[key] = _Program(function, args)
        return program(tensors)

    return call


class _Program:
    """A function compiled for arguments like these.

    Args:
        function (Callable): what is compiled.
        args (tuple): the arguments.

    Attributes:
        spec: how the arguments are nested.
    """

    def __init__(self, function: Callable[..., Any], args: tuple[Any, ...]) -> None:
        tensors, rest, self.spec = _split(args)
        # The compiler's cache wants to know that no size is unknown.
        mode = FakeTensorMode(allow_non_fake_inputs=True, shape_env=ShapeEnv())
        inputs = [_without_contents(mode, tensor) for tensor in tensors]
        reached = _Reached(mode)

        def on_tensors(*tensors: Tensor) -> list[Tensor]:
            with reached:
                returned = function(*_join(tensors, rest, self.spec))
            written, *self._returned = _split(returned)
            return written

        with _compiling(), mode:
            module = make_fx(on_tensors)(*inputs)
        self._reached = reached.tensors
        self._run = _compile(module, [*inputs, *reached.inputs], mode)

    def __call__(self, tensors: list[Tensor]) -> Any:
        with torch.no_grad():
            written = self._run(*tensors, *self._reached)
        return _join(written, *self._returned)


def _split(tree: Any) -> tuple[list[Tensor], list[Any], Any]:
    """The tensors of nested values, the others with marks in their places, and the nesting."""
    leaves, spec = tree_flatten(tree)
    tensors = [leaf for leaf in leaves if isinstance(leaf, Tensor)]
    return tensors, [Tensor if isinstance(leaf, Tensor) else leaf for leaf in leaves], spec


def _join(tensors: Iterable[Tensor], rest: list[Any], spec: Any) -> Any:
    """What :func:`_split` took apart."""
    given = iter(tensors)
    return tree_unflatten([next(given) if leaf is Tensor else leaf for leaf in rest], spec)


def _without_contents(mode: FakeTensorMode, tensor: Tensor) -> Tensor:
    return mode.from_tensor(tensor, static_shapes=True)


@contextmanager
def _compiling() -> Iterator[None]:
    """Tells losses and distributions that they are traced: they then ask nothing of contents."""
    with marked_as_compiling(), warnings.catch_warnings():
        # That locks are not watched meanwhile, and of a setting of torch's that it reads.
        warnings.filterwarnings("ignore", module="tensordict")
        yield


class _Reached(TorchDispatchMode):
    """Makes inputs of a graph of the tensors that the traced function reaches by itself.

    Args:
        mode (FakeTensorMode): which gives them stand-ins without contents.

    Attributes:
        tensors: that were reached, each piece of memory once for every form: a parameter and its
            ``data`` are one.
        inputs: their stand-ins, in that order.
    """

    def __init__(self, mode: FakeTensorMode) -> None:
        super().__init__()
        self.tensors: list[Tensor] = []
        self.inputs: list[Tensor] = []
        self._mode = mode
        self._known: dict[tuple[Any, ...], Tensor] = {}

    def __torch_dispatch__(
        self,
        func: Any,
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        # Numbers that become tensors are a part of the graph.
        if func is not torch.ops.aten.lift_fresh.default:
            args, kwargs = tree_map_only(Tensor, self._input, (args, kwargs))
        return func(*args, **(kwargs or {}))

    def _input(self, tensor: Tensor) -> Tensor:
        if isinstance(tensor, FakeTensor):
            if tensor.fake_mode is not self._mode:
                raise RuntimeError(
                    f"a tensor of shape {tuple(tensor.shape)} without contents was kept when an "
                    "earlier graph was made: what is compiled may keep none of its tensors."
                )
            return tensor
        where = (tensor.data_ptr() or id(tensor), tensor.shape, tensor.stride(), tensor.dtype)
        if where not in self._known:
            self._known[where] = self._new_input(tensor)
        return self._known[where]

    def _new_input(self, tensor: Tensor) -> Tensor:
        proxies = get_proxy_mode()
        assert proxies is not None
        with disable_current_modes():
            self.tensors.append(tensor.detach())
            self.inputs.append(_without_contents(self._mode, self.tensors[-1]))
        proxy = proxies.tracer.create_proxy("placeholder", f"reached_{len(self.inputs)}", (), {})
        track_tensor_tree(self.inputs[-1], proxy, constant=None, tracer=proxies.tracer)
        return self.inputs[-1]


def _compile(
    module: GraphModule, inputs: list[Any], mode: FakeTensorMode
) -> Callable[..., Sequence[Tensor]]:
    graph = module.graph
    first, *others = graph.find_nodes(op="placeholder")
    for placeholder in reversed(others):  # Some were reached in the midst of it.
        first.append(placeholder)
    for node in reversed(graph.nodes):
        # Marks for the profiler, which torch's optimizers set.
        if getattr(node.target, "namespace", None) == "profiler":
            graph.erase_node(node)
    module.recompile()
    options = {
        "fallback_random": True,
        # The sizes of the inputs are checked before the program is chosen: once is enough.
        "size_asserts": False,
        "post_grad_custom_post_pass": _BiasesApart(),
    }
    try:
        with torch.no_grad():
            return compile_graph(module, inputs, mode, options)
    # Of any kind: inductor's own mistakes are such as any program makes.
    except Exception as error:
        raise CompilerError(_failure(str(error).splitlines())) from error


def _failure(lines: Sequence[str]) -> str:
    wrong = [line.strip() for line in lines if "error:" in line]
    return (
        f"the compiler failed ({(wrong or lines or ['it says nothing'])[0]}): compile=false trains "
        "without it, several times slower."
    )


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


def compiler_available() -> bool:
    """Whether the C++ compiler is there that ``torch.compile`` needs on the CPU."""
    return any(shutil.which(name) for name in ("g++", "clang++", "c++"))
