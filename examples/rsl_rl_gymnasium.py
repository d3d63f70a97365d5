"""Gymnasium's vector environments for rsl_rl, and PPO with L2C2 on one of them.

It needs the extra rsl-rl and ``pip install "gymnasium[mujoco]"``.
``python examples/rsl_rl_gymnasium.py HalfCheetah-v5 500`` trains for 500 iterations, and prints the
return and the action variation of the mean actions.
"""

from __future__ import annotations

import sys
from typing import Any

import gymnasium
import torch
from gymnasium.vector import AutoresetMode
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from rsl_rl_l2c2 import test
from tensordict import TensorDict
from torch import Tensor


class GymnasiumEnv(VecEnv):
    """Copies of a Gymnasium task. Actions are clipped to their bounds.

    After an episode's end, the next observation is the first one of the next episode, as in Isaac
    Lab. L2C2PPO leaves these transitions out.
    """

    def __init__(self, env_id: str, num_envs: int, seed: int) -> None:
        same_step = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.env = gymnasium.make_vec(env_id, num_envs, "sync", vector_kwargs=same_step)
        self.num_envs, self.device, self.cfg = num_envs, "cpu", {"env_id": env_id}
        space: Any = self.env.single_action_space
        self.low, self.high = torch.from_numpy(space.low), torch.from_numpy(space.high)
        self.num_actions = len(self.low)
        self.max_episode_length = gymnasium.spec(env_id).max_episode_steps
        self.episode_length_buf = torch.zeros(num_envs, dtype=torch.long)
        self.seen = self.env.reset(seed=seed)[0]

    def get_observations(self) -> TensorDict:
        return TensorDict({"policy": torch.from_numpy(self.seen).float()}, [self.num_envs])

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Tensor]]:
        clipped = actions.clamp(self.low, self.high).numpy()
        self.seen, reward, terminated, truncated, _ = self.env.step(clipped)
        ended = torch.from_numpy(terminated | truncated)
        self.episode_length_buf = (self.episode_length_buf + 1) * ~ended
        late = torch.from_numpy(truncated & ~terminated)
        reward = torch.from_numpy(reward).float()
        return self.get_observations(), reward, ended.long(), {"time_outs": late}


def train(class_name: str, env_id: str, seed: int, iterations: int) -> tuple[float, float]:
    """Trains on 32 copies of the task, and tests the mean actions in 10 episodes."""
    torch.manual_seed(seed)
    network = {"class_name": "MLPModel", "hidden_dims": [128, 128], "obs_normalization": True}
    config = {
        "algorithm": {"class_name": class_name, "entropy_coef": 0.0},
        "actor": {**network, "distribution_cfg": {"class_name": "GaussianDistribution"}},
        "critic": network,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "num_steps_per_env": 64,
        "save_interval": iterations,
        "max_iterations": iterations,  # L2C2's gain rises over these
    }
    runner = OnPolicyRunner(GymnasiumEnv(env_id, 32, seed), config)
    runner.learn(iterations)
    return test(runner.get_inference_policy(), GymnasiumEnv(env_id, 10, 10_000 + seed))


if __name__ == "__main__":
    task = sys.argv[1] if len(sys.argv) > 1 else "HalfCheetah-v5"
    steps = int(sys.argv[2]) if len(sys.argv) > 2 else 3
    total, variation = train("torchrl_l2c2.rsl_rl:L2C2PPO", task, 0, steps)
    print(f"{task} with L2C2: return {total:.1f}, action variation {variation:.3f}")
