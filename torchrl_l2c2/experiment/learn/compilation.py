"""Compilation of the experiment's hot functions.

A function is traced once with fake tensors, and Inductor compiles the graph. Tensors that are not
arguments, such as parameters, become inputs of the graph. ``torch.compile`` analyzes Python
bytecode instead: it takes several times longer at the start of a run and checks more at every call.
"""

from __future__ import annotations

import os
import re
import shutil
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.fx import GraphModule
from torch.fx.experimental.proxy_tensor import get_proxy_mode, make_fx, track_tensor_tree
from torch.fx.experimental.symbolic_shapes import ShapeEnv

from torchrl_l2c2.experiment.errors import CompilerError
from torchrl_l2c2.experiment.learn._torch_internals import (
    FakeTensor,
    FakeTensorMode,
    TorchDispatchMode,
    compile_graph,
    disable_current_modes,
    marked_as_compiling,
    tree_flatten,
    tree_map_only,
    tree_unflatten,
)
from torchrl_l2c2.experiment.learn.products import onednn_is_faster, use_onednn


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compiles a function, including its calls of ``torch.autograd.grad``, into one graph.

    Random numbers are the same as without compilation. Outputs have no gradient.

    The first call fixes everything except for the arguments and the contents of tensors: in-place
    changes of tensors take effect, but later changes of settings and replaced tensors are ignored.
    Other shapes of tensor arguments, and other values of other arguments, are compiled separately.

    Args:
        function (Callable): Function to compile, traced at its first call. Its control flow must
            not depend on tensor values, and it must not store its tensors.

    Returns:
        Callable: The compiled function. It raises :class:`CompilerError` if compilation fails.
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
    """A function compiled for arguments of the given shapes and values.

    Args:
        function (Callable): Function to compile.
        args (tuple): Example arguments.

    Attributes:
        spec: Nesting of the arguments.
    """

    def __init__(self, function: Callable[..., Any], args: tuple[Any, ...]) -> None:
        tensors, rest, self.spec = _split(args)
        # The compiler's cache needs a ShapeEnv, even if all sizes are static.
        mode = FakeTensorMode(allow_non_fake_inputs=True, shape_env=ShapeEnv())
        inputs = [_to_fake(mode, tensor) for tensor in tensors]
        captured = _CapturedTensors(mode)

        def on_tensors(*tensors: Tensor) -> list[Tensor]:
            with captured:
                returned = function(*_join(tensors, rest, self.spec))
            written, *self._returned = _split(returned)
            return written

        with _compiling(), mode:
            module = make_fx(on_tensors)(*inputs)
        self._captured = captured.tensors
        self._run = _compile(module, [*inputs, *captured.inputs], mode)

    def __call__(self, tensors: list[Tensor]) -> Any:
        with torch.no_grad():
            written = self._run(*tensors, *self._captured)
        return _join(written, *self._returned)


def _split(tree: Any) -> tuple[list[Tensor], list[Any], Any]:
    """Splits nested values into tensors, all values without tensors, and the nesting.

    The nesting of a tuple of tensors is its length: ``tree_flatten`` is slow for a policy that is
    called at every frame.
    """
    if type(tree) is tuple and all(isinstance(leaf, Tensor) for leaf in tree):
        return list(tree), [Tensor] * len(tree), len(tree)
    leaves, spec = tree_flatten(tree)
    tensors = [leaf for leaf in leaves if isinstance(leaf, Tensor)]
    return tensors, [Tensor if isinstance(leaf, Tensor) else leaf for leaf in leaves], spec


def _join(tensors: Iterable[Tensor], rest: list[Any], spec: Any) -> Any:
    """Rebuilds the nested values of :func:`_split`."""
    if isinstance(spec, int):
        return tuple(tensors)
    given = iter(tensors)
    return tree_unflatten([next(given) if leaf is Tensor else leaf for leaf in rest], spec)


def _to_fake(mode: FakeTensorMode, tensor: Tensor) -> Tensor:
    return mode.from_tensor(tensor, static_shapes=True)


@contextmanager
def _compiling() -> Iterator[None]:
    """Marks the block as compiling: losses and distributions then skip checks of tensor values."""
    with marked_as_compiling(), warnings.catch_warnings():
        # TensorDict warns about locks and about a setting of torch.
        warnings.filterwarnings("ignore", module="tensordict")
        yield


class _CapturedTensors(TorchDispatchMode):
    """Turns tensors that a traced function uses without being arguments into graph inputs.

    Args:
        mode (FakeTensorMode): Mode that creates their fake tensors.

    Attributes:
        tensors: Captured tensors. Tensors with the same memory, shape and strides, such as a
            parameter and its ``data``, are captured once.
        inputs: Fake tensors of ``tensors``, in the same order.
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
        # Constants are part of the graph.
        if func is not torch.ops.aten.lift_fresh.default:
            args, kwargs = tree_map_only(Tensor, self._input, (args, kwargs))
        return func(*args, **(kwargs or {}))

    def _input(self, tensor: Tensor) -> Tensor:
        if isinstance(tensor, FakeTensor):
            if tensor.fake_mode is not self._mode:
                raise RuntimeError(
                    f"the function uses a fake tensor of shape {tuple(tensor.shape)} of an earlier "
                    "trace: a compiled function must not store its tensors."
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
            self.inputs.append(_to_fake(self._mode, self.tensors[-1]))
        proxy = proxies.tracer.create_proxy("placeholder", f"captured_{len(self.inputs)}", (), {})
        track_tensor_tree(self.inputs[-1], proxy, constant=None, tracer=proxies.tracer)
        return self.inputs[-1]


def _compile(
    module: GraphModule, inputs: list[Any], mode: FakeTensorMode
) -> Callable[..., Sequence[Tensor]]:
    graph = module.graph
    first, *others = graph.find_nodes(op="placeholder")
    for placeholder in reversed(others):  # Placeholders of captured tensors are between the nodes.
        first.append(placeholder)
    for node in reversed(graph.nodes):
        # Profiler marks of torch's optimizers cannot be compiled.
        if getattr(node.target, "namespace", None) == "profiler":
            graph.erase_node(node)
    if onednn_is_faster():
        use_onednn(graph)
    module.recompile()
    options = {
        "fallback_random": True,
        # compiled() has already checked the sizes to choose the program.
        "size_asserts": False,
    }
    try:
        with torch.no_grad():
            try:
                return compile_graph(module, inputs, mode, options)
            except Exception as error:
                if not _remove_damaged_library(str(error)):
                    raise
                return compile_graph(module, inputs, mode, options)
    # Inductor's own bugs raise errors of any class.
    except Exception as error:
        raise CompilerError(_failure(str(error).splitlines())) from error


def _remove_damaged_library(message: str) -> bool:
    """Removes the library that an error names from the compiler's cache, if there is one.

    A process that is killed while it compiles may leave an incomplete library, which every later
    process would fail to load.
    """
    named = re.search(r"(/\S+\.so): ", message)
    cache = os.environ.get("TORCHINDUCTOR_CACHE_DIR")  # Inductor sets it, too.
    if named is None or cache is None or not Path(named[1]).is_relative_to(cache):
        return False
    Path(named[1]).unlink(missing_ok=True)
    return True


def _failure(lines: Sequence[str]) -> str:
    errors = [line.strip() for line in lines if "error:" in line]
    return (
        f"the compiler failed ({(errors or lines or ['no message'])[0]}): set compile=false to "
        "train without it, several times slower."
    )


def compiler_available() -> bool:
    """Checks whether a C++ compiler is installed, which ``torch.compile`` needs on the CPU."""
    return any(shutil.which(name) for name in ("g++", "clang++", "c++"))
