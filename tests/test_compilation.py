"""Compiled functions: for every run of a sweep, with the same random numbers."""

import pytest
import torch

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
    torch.testing.assert_close(compiled(noisy_slope)(x), expected)
