"""Products of large matrices by oneDNN, in compiled functions."""

from __future__ import annotations

import pytest
import torch
from torch.fx.experimental.proxy_tensor import make_fx

from torchrl_l2c2.experiment.learn import compilation, products
from torchrl_l2c2.experiment.learn.compilation import compiled, compiler_available
from torchrl_l2c2.experiment.learn.products import onednn_is_faster, use_onednn

pytestmark = pytest.mark.skipif(
    not torch.backends.mkldnn.is_available(), reason="torch was built without oneDNN"
)
LARGE, SMALL = 160, 100


def traced(function, *args):
    return make_fx(function, tracing_mode="fake")(*args)


def targets(graph):
    return [str(node.target) for node in graph.nodes if node.op == "call_function"]


@pytest.mark.parametrize(
    ("function", "shapes"),
    [
        (torch.mm, [(LARGE, LARGE), (LARGE, LARGE)]),
        (lambda a, b: torch.mm(a.t(), b), [(LARGE, LARGE), (LARGE, LARGE)]),
        (torch.bmm, [(2, LARGE, 96), (2, 96, 256)]),
        (lambda a, b: torch.bmm(a, b.transpose(1, 2)), [(3, LARGE, LARGE), (3, 128, LARGE)]),
        (torch.addmm, [(LARGE,), (LARGE, LARGE), (LARGE, LARGE)]),
    ],
)
def test_large_products_are_replaced_and_stay_equal(function, shapes):
    """Of matrices and of stacks of them, also transposed, and with a bias."""
    torch.manual_seed(0)
    args = [torch.randn(shape) for shape in shapes]
    module = traced(function, *args)
    assert use_onednn(module.graph) == 1
    assert "torchrl_l2c2.product.default" in targets(module.graph)
    module.recompile()
    torch.testing.assert_close(module(*args), function(*args), rtol=1e-4, atol=1e-4)


def test_products_of_products_are_replaced():
    """Also behind a bias, as in two linear layers without an activation between them."""
    torch.manual_seed(0)
    x, weight, bias = torch.randn(LARGE, LARGE), torch.randn(LARGE, LARGE), torch.randn(LARGE)

    def layers(x, weight, bias):
        return torch.addmm(bias, torch.mm(torch.addmm(bias, x, weight), weight), weight) / LARGE

    module = traced(layers, x, weight, bias)
    assert use_onednn(module.graph) == 3
    module.recompile()
    expected = layers(x, weight, bias)
    torch.testing.assert_close(module(x, weight, bias), expected, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize(
    ("function", "args"),
    [
        (torch.mm, [torch.randn(SMALL, SMALL)] * 2),
        (torch.mm, [torch.randn(4096, 4), torch.randn(4, 256)]),
        (torch.mm, [torch.randn(LARGE, LARGE, dtype=torch.float64)] * 2),
        (lambda a: torch.addmm(a, a, a, alpha=2.0), [torch.randn(LARGE, LARGE)]),
    ],
)
def test_other_products_stay(function, args):
    """Small or narrow ones, other precisions, and what is more than a product."""
    module = traced(function, *args)
    before = targets(module.graph)
    assert use_onednn(module.graph) == 0 and targets(module.graph) == before


@pytest.mark.skipif(not compiler_available(), reason="no C++ compiler")
@pytest.mark.parametrize("faster", [True, False])
def test_a_compiled_function_has_them_where_they_are_faster(monkeypatch, faster):
    """Its gradients, too, with the numbers of the function."""
    torch.manual_seed(0)
    calls = []
    linear = products.onednn_linear
    monkeypatch.setattr(compilation, "onednn_is_faster", lambda: faster)
    monkeypatch.setattr(products, "onednn_linear", lambda *of: calls.append(0) or linear(*of))
    weight = torch.randn(LARGE, LARGE, requires_grad=True)

    def slope(x):
        return torch.autograd.grad((x @ weight.t()).square().mean(), [weight])

    x = torch.randn(LARGE, LARGE)
    (found,) = compiled(slope)(x)
    torch.testing.assert_close(found, slope(x)[0], rtol=1e-4, atol=1e-4)
    assert len(calls) == 2 * faster


@pytest.mark.parametrize(
    ("capability", "content", "expected"),
    [
        ("AVX512", "vendor_id : AuthenticAMD", True),
        ("AVX2", "vendor_id : AuthenticAMD", False),
        ("AVX512", "vendor_id : GenuineIntel", False),
        ("AVX512", None, False),
    ],
)
def test_the_choice_is_by_the_processor(monkeypatch, tmp_path, capability, content, expected):
    """AMD's with AVX-512; without Linux the maker is unknown."""
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    monkeypatch.setattr(products, "CPU", tmp_path / "cpuinfo")
    if content is not None:
        products.CPU.write_text(content)
    assert onednn_is_faster.__wrapped__() == expected
