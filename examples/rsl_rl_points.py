"""A vectorized task for rsl_rl: points that are seen through noise."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor


class NoisyPoints(VecEnv):
    """Points on a line, to be pushed to the origin and kept there; beyond [-2, 2] they are lost.

    A step takes 0.1 s. Observations are position and velocity, each with white noise (standard
    deviation 0.1). The action is the acceleration, in [-1, 1].
    """

    num_actions, max_episode_length = 1, 100
    low, high = -1.0, 1.0
    cfg: ClassVar[dict[str, Any]] = {}

    def __init__(self, num_envs: int) -> None:
        self.num_envs, self.device = num_envs, "cpu"
        self.episode_length_buf = torch.zeros(num_envs, dtype=torch.long)
        self.motion = torch.zeros(num_envs, 2)
        self._look(torch.ones(num_envs, dtype=torch.bool))

    def get_observations(self) -> TensorDict:
        return self.seen

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Tensor]]:
        position, velocity = self.motion.unbind(-1)
        velocity = velocity + 0.1 * actions.squeeze(-1).clamp(self.low, self.high)
        position = position + 0.1 * velocity
        self.motion = torch.stack((position, velocity), -1)
        self.episode_length_buf += 1
        late = self.episode_length_buf >= self.max_episode_length
        self._look(late | (position.abs() > 2))
        reward = 1 - position.square() - 0.1 * velocity.square()
        return self.seen, reward, self.starts.long(), {"time_outs": late}

    def _look(self, starts: Tensor) -> None:
        self.starts = starts
        self.episode_length_buf[starts] = 0
        anywhere = 2 * torch.rand(self.num_envs, 2) - 1
        self.motion = torch.where(starts[:, None], anywhere, self.motion)
        noisy = self.motion + 0.1 * torch.randn(self.num_envs, 2)
        self.seen = TensorDict({"policy": noisy}, [self.num_envs])
