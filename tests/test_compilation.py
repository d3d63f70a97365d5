"""Compiled functions: for every run of a sweep, with the same random numbers."""

import pytest
import torch
from torch._inductor.utils import run_and_get_code

from torchrl_l2c2.experiment.compilation import compiled, compiler_available

pytestmark = pytest.mark.skipif(not compiler_available(), reason="no C++ compiler")


def make(size):
    network = torch.nn.Linear(2, size)

    def act(observation):
        return network(observation)

    return compiled(act)


def test_a_sweep_compiles_the_same_code_as_often_as_it_has_runs():
    """Beyond the number of recompilations that one function is allowed."""
    limit = torch._dynamo.config.recompile_limit
    for size in range(1, limit + 3):
        assert make(size)(torch.ones(2)).shape == (size,)


def test_random_numbers_and_gradients_are_those_of_the_plain_function():
    """PyTorch's own generator, and one graph with the gradient in it."""

    def noisy_slope(x):
        y = (x * torch.rand_like(x)).square().sum()
        return torch.autograd.grad(y, [x])[0]

    x = torch.arange(4.0, requires_grad=True)
    torch.manual_seed(0)
    expected = noisy_slope(x)
    torch.manual_seed(0)
    torch.testing.assert_close(compiled(noisy_slope, takes_gradients=True)(x), expected)


def test_a_constant_closure_is_looked_at_once_and_arguments_always():
    """Written into, its tensors are followed; other arguments are another graph."""
    weight, setting = torch.ones(2), {"scale": 1.0}

    def scaled(x, double):
        return (2.0 if double else 1.0) * setting["scale"] * weight * x

    ours = compiled(scaled, constant_closure=True)
    assert ours(torch.ones(2), False).tolist() == [1.0, 1.0]
    assert ours(torch.ones(2), True).tolist() == [2.0, 2.0]
    weight.fill_(3.0)
    assert ours(torch.ones(2), False).tolist() == [3.0, 3.0]
    assert ours(torch.ones(3, 2), True).shape == (3, 2)
    setting["scale"] = 10.0
    assert ours(torch.ones(2), False).tolist() == [3.0, 3.0]
    assert compiled(scaled)(torch.ones(2), False).tolist() == [30.0, 30.0]


def test_biases_are_added_where_the_product_is_used():
    """No addmm is left, whose first step is a copy of the bias; the numbers are the same."""
    torch.manual_seed(0)
    network, x = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.Tanh()), torch.randn(5, 3)

    def slopes(x):
        y = network(x)
        return y.detach(), *torch.autograd.grad(y.square().sum(), list(network.parameters()))

    found, (code,) = run_and_get_code(compiled(slopes, takes_gradients=True), x)
    torch.testing.assert_close(found, slopes(x))
    assert "addmm(" not in code and "extern_kernels.mm(" in code
    with torch._dynamo.config.patch(trace_autograd_ops=True):
        _, (plain,) = run_and_get_code(torch.compile(slopes, fullgraph=True), x)
    assert "addmm(" in plain
