"""Updates on one device, a policy that plays on the CPU."""

from dataclasses import replace

import pytest
import torch
from small import ALGORITHMS, replay_of
from tensordict import TensorDict
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode

from torchrl_l2c2 import Neighborhood
from torchrl_l2c2.experiment import AdamConfig, Experiment, ExperimentConfig, TaskConfig
from torchrl_l2c2.experiment.agents.build import make_agent
from torchrl_l2c2.experiment.settings.fields import SettingError
from torchrl_l2c2.optim.adaterm import adaterm
from torchrl_l2c2.transforms.neighbors import draw_neighbors
from torchrl_l2c2.updaters import t_soft_update

CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")

FEW_UPDATES = {name: replace(ALGORITHMS[name], random_frames=50) for name in ("sac", "td3")}


def config(name, **settings):
    return ExperimentConfig(
        **{
            "task": TaskConfig("task", "Pendulum-v1", episodes=3, max_steps=30),
            "algorithm": FEW_UPDATES.get(name, ALGORITHMS[name]),
            # By priority where that is usual: the draws go to the device as well.
            **({} if name == "ppo_rpe" else {"replay": replay_of(name)}),
            "optimizer": AdamConfig(lr=0.001),
            "compile": False,
            "test_episodes": 2,
            **settings,
        }
    )


def trained(chosen, folder=None):
    run = Experiment(chosen, folder)
    run.train()
    numbers = [
        value.clone() for value in run.agent.loss.state_dict().values() if torch.is_tensor(value)
    ]
    result, updates = run.test(sampled=True), run.learner.updates
    run.close()
    return numbers, (result.returns, result.action_variations), updates


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_copy_of_the_policy_acts_as_the_policy_does(monkeypatch, name):
    """The same bits: it has the trained parameters whenever it plays, and explores by itself."""
    numbers, result, updates = trained(config(name))

    def copying(config, env):
        agent = make_agent(config, env)
        agent.act_on_cpu()
        return agent

    monkeypatch.setattr("torchrl_l2c2.experiment.run.experiment.make_agent", copying)
    copied_numbers, copied_result, _ = trained(config(name))
    assert updates > 0 and copied_result == result
    assert all(torch.equal(a, b) for a, b in zip(copied_numbers, numbers, strict=True))


def test_a_device_that_is_not_there_is_refused():
    """With how many there are, before anything is made; and so is what is no device."""
    with pytest.raises(SettingError, match=r"device must be a device of this machine.*'cuda:99'"):
        Experiment(config("sac", device="cuda:99"))
    with pytest.raises(SettingError, match=r"device .*got 'gpu'"):
        config("sac", device="gpu")


class CopiesToDevices(TorchDispatchMode):
    """Keeps what makes a tensor on a device of one on the CPU: the CPU waits for each."""

    def __init__(self):
        super().__init__()
        self.found = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        given = [arg for arg in args if isinstance(arg, torch.Tensor)]
        if isinstance(result, torch.Tensor) and result.is_cuda:
            self.found += [function for each in given if not each.is_cuda and each.ndim]
        return result


def soft_update(make):
    t_soft_update([make(3), make(4, 2)], [make(3), make(4, 2)], make(2), make(2), tau=0.1, nu=1.0)


def optimize(make):
    pairs = [[make(3), make(4, 2)] for _ in range(4)]
    adaterm(*pairs, [make(), make()], [make(), make()], lr=1e-3, beta=0.9, eps=1e-5, nu_min=1.0)


def draw(make):
    states = {"observation": make(5, 3), "next": {"observation": make(5, 3)}}
    draw_neighbors(TensorDict(states, [5]), Neighborhood(), ["observation"])


@pytest.mark.parametrize("step", [soft_update, optimize, draw])
def test_nothing_of_an_update_is_copied_to_the_device(step):
    """Such a copy holds both up, and no CUDA graph can be captured around it."""
    with FakeTensorMode(allow_non_fake_inputs=True), CopiesToDevices() as copies:
        torch.ones(3).to("cuda")
        assert len(copies.found) == 1
        step(lambda *shape: torch.empty(shape, device="cuda"))
    assert len(copies.found) == 1, copies.found


@CUDA
@pytest.mark.parametrize("compile", [False, True])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_learns_on_cuda_and_is_continued(tmp_path, name, compile):
    """Where its parameters are; ended and continued it has the numbers of one run."""
    chosen = config(name, device="cuda", compile=compile, checkpoint_interval=0.0)
    whole, _, updates = trained(chosen)
    assert updates > 0 and all(number.is_cuda for number in whole if number.is_floating_point())
    begun = Experiment(chosen, tmp_path)
    begun.train(2)
    begun.close()
    continued, _, _ = trained(chosen, tmp_path)
    assert all(torch.equal(a, b) for a, b in zip(continued, whole, strict=True))
