"""Every kind of update can be traced, and its graph does what the update does.

The graphs are run as they are: what the compiler then makes of them is tested elsewhere, and takes
most of the time.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
import torch._inductor.compile_fx

from torchrl_l2c2.experiment import (
    Experiment,
    ExperimentConfig,
    L2C2Config,
    PPOConfig,
    PPORPEConfig,
    PrioritizedReplayConfig,
    RolloutReplayConfig,
    SACConfig,
    TaskConfig,
    TD3Config,
    UniformReplayConfig,
)
from torchrl_l2c2.experiment.learn.compilation import compiler_available
from torchrl_l2c2.experiment.settings.regularizers import REGULARIZERS

pytestmark = pytest.mark.skipif(not compiler_available(), reason="no C++ compiler")

TASK = TaskConfig("task", "Pendulum-v1", max_steps=40, episodes=2)
PPO = PPOConfig(frames=40, epochs=2, hidden=(8,))  # 4 updates an episode
FIXED = replace(PPO, num_envs=1, clip_actions=True, log_scale=0.0)
ALGORITHMS = {
    "PPO-RPE": PPORPEConfig(updates=4, hidden=(8,)),
    "SAC": SACConfig(random_frames=60, hidden=(8,)),
    "TD3": TD3Config(random_frames=60, hidden=(8,)),
    "PPO": PPO,
    "PPO, entropy that is estimated": replace(PPO, entropy_coeff=0.01),
    "PPO, entropy of a normal": replace(FIXED, entropy_coeff=0.01),
    "PPO, normalized": replace(FIXED, normalize_observations=True, normalize_rewards=True),
}
# What other forms of L2C2 have is among these.
RIVALS = ("caps", "cats", "grad_caps", "asap", "sr2l", "lcp")
METHODS = {
    **{name: REGULARIZERS[name] for name in ("none", "l2c2", "l2c2_mean", "l2c2_ramp", *RIVALS)},
    "sr2l": replace(REGULARIZERS["sr2l"], steps=2),
    "half of the batch": L2C2Config(fraction=0.5),
    "the worst of four": L2C2Config(num_samples=4, over_neighbors="max"),
}
PAIRS = [(name, "l2c2") for name in ALGORITHMS]
SIMILAR = ("l2c2_mean", "l2c2_ramp", "cats", "half of the batch")
PAIRS += [
    pytest.param("PPO", method, marks=[pytest.mark.slow] if method in SIMILAR else [])
    for method in METHODS
    if method != "l2c2"
]


def train(algorithm, regularizer, compile):
    replays = {"ppo": RolloutReplayConfig, "ppo_rpe": PrioritizedReplayConfig}
    config = ExperimentConfig(
        task=TASK,
        algorithm=algorithm,
        regularizer=regularizer,
        replay=replays.get(algorithm.name, UniformReplayConfig)(batch_size=20),
        compile=compile,
        late_share=0.0,
    )
    experiment = Experiment(config)
    initial = [parameter.detach().clone() for parameter in experiment.agent.loss.parameters()]
    experiment.train()
    return experiment, initial


@pytest.mark.parametrize("name, method", PAIRS)
def test_the_graph_learns_what_the_update_does(name, method, monkeypatch):
    """The same parameters, random numbers and all, but for the order of sums."""
    graphs = []

    def keep(module, inputs):
        graphs.append(module)
        return module

    plain, plain_initial = train(ALGORITHMS[name], METHODS[method], compile=False)
    monkeypatch.setattr(torch._inductor.compile_fx, "compile_fx", keep)
    traced, traced_initial = train(ALGORITHMS[name], METHODS[method], compile=True)
    assert all(map(torch.equal, traced_initial, plain_initial)), "one seed, other weights"
    assert graphs and traced.learner.updates == plain.learner.updates > 3
    for ours, theirs in zip(
        traced.agent.loss.parameters(), plain.agent.loss.parameters(), strict=True
    ):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)
