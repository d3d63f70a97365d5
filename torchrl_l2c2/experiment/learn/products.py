"""Products of large matrices by oneDNN, where torch's own are slower.

For float32, torch calls MKL, which uses only AVX2 on AMD's processors. With AVX-512, oneDNN is
faster there for all but small matrices: ``python -m benchmarks.speed --rows products``.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.fx import Graph, Node

from torchrl_l2c2.experiment.learn._torch_internals import onednn_linear

CPU = Path("/proc/cpuinfo")
# MKL is as fast or faster for smaller matrices.
LEAST_SIDE = 16
LEAST_MULTIPLICATIONS = 2**21


@cache
def onednn_is_faster() -> bool:
    """Checks for an AMD processor with AVX-512, and for oneDNN in torch."""
    wide = torch.backends.cpu.get_cpu_capability() == "AVX512"
    try:
        amd = "AuthenticAMD" in CPU.read_text()
    except OSError:  # Not Linux.
        return False
    return wide and amd and torch.backends.mkldnn.is_available()


def use_onednn(graph: Graph) -> int:
    """Replaces products of large float32 matrices on the CPU in a graph, and returns their number.

    Args:
        graph (Graph): Traced graph of core operators, with fake tensors in its metadata.
    """
    aten, product = torch.ops.aten, _operator()
    replaced = 0
    for target in (aten.mm.default, aten.bmm.default, aten.addmm.default):
        for node in graph.find_nodes(op="call_function", target=target):
            left, right = node.args[-2:]
            if node.kwargs or not _is_large(left, right):
                continue
            with graph.inserting_before(node):
                found = graph.call_function(product, (left, right))
                found.meta.update(node.meta)  # The next product may read it.
                if target is aten.addmm.default:
                    found = graph.call_function(aten.add.Tensor, (found, node.args[0]))
                    found.meta.update(node.meta)
            node.replace_all_uses_with(found)
            graph.erase_node(node)
            replaced += 1
    return replaced


def _is_large(left: Node, right: Node) -> bool:
    a, b = left.meta["val"], right.meta["val"]
    sides = (*a.shape[-2:], b.shape[-1])
    size = sides[0] * sides[1] * sides[2]
    on_cpu = a.device.type == "cpu" and a.dtype == torch.float32
    return on_cpu and min(sides) >= LEAST_SIDE and size >= LEAST_MULTIPLICATIONS


def _operator() -> Any:
    _library()
    return torch.ops.torchrl_l2c2.product.default


@cache  # The operator exists as long as the library does.
def _library() -> torch.library.Library:
    library = torch.library.Library("torchrl_l2c2", "FRAGMENT")
    library.define("product(Tensor left, Tensor right) -> Tensor")
    library.impl("product", _product, "CPU")
    library.impl("product", _empty, "Meta")
    return library


def _product(left: Tensor, right: Tensor) -> Tensor:
    if left.ndim == 2:
        return onednn_linear(left, right.t())
    result = _empty(left, right)
    for one, a, b in zip(result, left, right, strict=True):
        one.copy_(onednn_linear(a, b.t()))
    return result


def _empty(left: Tensor, right: Tensor) -> Tensor:
    return left.new_empty(*left.shape[:-1], right.shape[-1])
