"""Steps of optimizers and targets in a compiled function: those that are taken without one."""

import pytest
import torch
from torch.optim import SGD, Adam
from torch.optim.lr_scheduler import StepLR

from torchrl_l2c2 import AdaTerm
from torchrl_l2c2.experiment.learn.compilation import compiled, compiler_available
from torchrl_l2c2.experiment.learn.tracing import traceable_step

GRADIENTS = [torch.tensor([3.0, -0.1]), torch.tensor([-1.0, 0.2]), torch.tensor([0.5, 0.0])]


def walked(make, compile):
    """Where two parameters get to, of which one has a gradient in the first step alone."""
    parameters = [torch.nn.Parameter(torch.zeros(2)) for _ in range(2)]
    optimizer = make(parameters)
    step = traceable_step(optimizer) if compile else optimizer.step
    scheduler = StepLR(optimizer, 1, gamma=0.5)

    def follow(both, gradient):
        for parameter in parameters:
            parameter.grad = gradient if both or parameter is parameters[0] else None
        step()
        for parameter in parameters:
            parameter.grad = None

    follow = compiled(follow) if compile else follow
    for number, gradient in enumerate(GRADIENTS):
        follow(number == 0, gradient)
        scheduler.step()
    return torch.stack(parameters).detach(), optimizer


@pytest.mark.parametrize("kind", [Adam, AdaTerm])
def test_a_learning_rate_is_the_same_number_as_a_tensor(kind):
    """A run that goes on without a compiler has it again."""
    optimizer = kind([torch.nn.Parameter(torch.zeros(2))], lr=3e-4)
    traceable_step(optimizer)
    assert optimizer.param_groups[0]["lr"].item() == 3e-4


@pytest.mark.skipif(not compiler_available(), reason="no C++ compiler")
@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        (Adam, {}),
        (Adam, {"amsgrad": True, "weight_decay": 0.1, "maximize": True}),
        (AdaTerm, {"eps": 0.1}),
    ],
)
def test_compiled_an_optimizer_takes_its_own_steps_and_follows_a_schedule(kind, settings):
    """Also the state is the optimizer's own, for a checkpoint to keep and torch to load."""

    def make(parameters):
        return kind(parameters, lr=0.1, **settings)

    (ours, optimizer), (expected, plain) = walked(make, True), walked(make, False)
    torch.testing.assert_close(ours, expected)
    assert float(optimizer.param_groups[0]["lr"]) == pytest.approx(0.0125)
    assert plain.param_groups[0]["lr"] == 0.0125
    state, theirs = (each.state_dict()["state"] for each in (optimizer, plain))
    for number, entries in theirs.items():
        assert state[number].keys() == entries.keys()
        for name, value in entries.items():
            torch.testing.assert_close(state[number][name], value)
    plain.load_state_dict(optimizer.state_dict())


def test_an_optimizer_of_another_kind_has_no_step_that_compiles():
    """It takes its steps outside of the graph, with its settings as they are."""
    optimizer = SGD([torch.nn.Parameter(torch.ones(1))], lr=0.1)
    assert traceable_step(optimizer) is None
    assert optimizer.param_groups[0]["lr"] == 0.1
