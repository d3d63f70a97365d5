"""rsl_rl's PPO with and without L2C2, on points seen through noise (needs the extra rsl-rl).

``python examples/rsl_rl_l2c2.py`` shows in seconds that it runs, with three iterations;
``python examples/rsl_rl_l2c2.py 40`` trains for some minutes; ``... 40 RNNModel`` with memory.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable
from typing import Any

import torch
from rsl_rl.runners import OnPolicyRunner
from rsl_rl_points import NoisyPoints
from torch import Tensor

from torchrl_l2c2 import action_variation

SEEDS = range(5)
STUDENT = 2.776  # half of a 95 % interval of five seeds, in standard errors
METHODS = {"PPO": "PPO", "with L2C2": "torchrl_l2c2.rsl_rl:L2C2PPO"}


def train(
    class_name: str, seed: int, iterations: int, model: str = "MLPModel"
) -> tuple[float, float]:
    torch.manual_seed(seed)
    network: dict[str, Any] = {"class_name": model, "hidden_dims": [64, 64], "activation": "tanh"}
    if model == "RNNModel":
        network |= {"rnn_type": "lstm", "rnn_hidden_dim": 64}
    config = {
        "algorithm": {"class_name": class_name, "gamma": 0.97, "entropy_coef": 0.0},
        "actor": {**network, "distribution_cfg": {"class_name": "GaussianDistribution"}},
        "critic": network,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "num_steps_per_env": 25,
        "save_interval": iterations,
        "max_iterations": iterations,  # L2C2's gain rises over these
    }
    with contextlib.redirect_stdout(None):
        runner = OnPolicyRunner(NoisyPoints(64), config)
        runner.learn(iterations)
    torch.manual_seed(1000 + seed)
    runner.alg.actor.reset()  # It may remember the training.
    return test(runner.get_inference_policy(), NoisyPoints(100))


@torch.no_grad()
def test(policy: Callable[[Any], Tensor], env: NoisyPoints) -> tuple[float, float]:
    """Return and variation of the mean actions, over each point's first episode."""
    plays, rewards = torch.ones(env.num_envs, dtype=torch.bool), torch.zeros(env.num_envs)
    actions, mask = [], []
    for _ in range(env.max_episode_length):
        actions.append(policy(env.get_observations()).clamp(env.low, env.high))
        mask.append(plays)
        _, reward, ended, _ = env.step(actions[-1])
        rewards, plays = rewards + reward * plays, plays & ~ended.bool()
    variation = action_variation(torch.stack(actions, 1), torch.stack(mask, 1))
    return rewards.mean().item(), variation.mean().item()


def main(iterations: int, model: str) -> None:
    found = {
        name: torch.tensor([train(class_name, seed, iterations, model) for seed in SEEDS])
        for name, class_name in METHODS.items()
    }
    found["difference"] = found["with L2C2"] - found["PPO"]
    print("| | return | action variation |\n| --- | --- | --- |")
    for name, numbers in found.items():
        mean, half = numbers.mean(0), STUDENT * numbers.std(0) / len(SEEDS) ** 0.5
        cells = (f"{m:.3f} ± {h:.3f}" for m, h in zip(mean, half, strict=True))
        print(f"| {name} |", " | ".join(cells), "|")


if __name__ == "__main__":
    chosen = sys.argv[2] if len(sys.argv) > 2 else "MLPModel"
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3, chosen)
