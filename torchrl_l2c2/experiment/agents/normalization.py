"""Normalization of observations and rewards, and a policy that contains it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import ExplorationType
from torchrl.envs.utils import exploration_type

from torchrl_l2c2.experiment.envs.frames import PREVIOUS

CLIP = 10.0  # Normalized values are clipped to [-CLIP, CLIP].
EPSILON = 1e-8  # Added to variances.


class Normalization(nn.Module):
    r"""Normalization of observations and rewards by running statistics.

    .. math::
        s \to \frac{s - \mathrm{mean}(s)}{\sqrt{\mathrm{var}(s) + 10^{-8}}}, \qquad
        r \to \frac{r}{\sqrt{\mathrm{var}(R) + 10^{-8}}}, \qquad R_t = \gamma R_{t-1} + r_t,

    Both are clipped to [-10, 10], as by ``VecNormalize`` of Stable-Baselines3. Rewards keep their
    sign. TorchRL's ``VecNormV2`` subtracts a mean, which would change the optimal policy of tasks
    whose episodes can end early.

    New statistics of observations take effect at :meth:`apply_statistics`. Collection and learning
    of a rollout use the same statistics: ``s`` and ``s'`` are normalized equally, and
    log-likelihoods belong to the policy that acted. The ``state_dict`` contains all statistics.

    Args:
        size (int): Length of an observation.

    Keyword Args:
        observations (bool): Whether observations are normalized.
        rewards (bool): Whether rewards are normalized.
        gamma (float): Discount factor, from 0 to 1. Larger values sum more rewards in :math:`R`.
        streams (int): Number of simulators, at least 1. Each has its own :math:`R`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> norm = Normalization(1, observations=True, rewards=False, gamma=0.9, streams=1)
        >>> seen, false = torch.tensor([[1.0], [3.0]]), torch.zeros(2, 1, dtype=torch.bool)
        >>> after = {"observation": seen, "reward": torch.ones(2, 1), "done": false}
        >>> (before,) = norm([TensorDict({"observation": seen, "next": after}, [2])])
        >>> norm.apply_statistics()
        >>> before["observation"].flatten().tolist()
        [1.0, 3.0]
        >>> norm.normalize(seen).flatten().round().tolist()
        [-1.0, 1.0]
    """

    mean: Tensor
    scale: Tensor
    returns: Tensor

    def __init__(
        self, size: int, *, observations: bool, rewards: bool, gamma: float, streams: int
    ) -> None:
        super().__init__()
        self._observations, self._rewards, self._gamma = observations, rewards, gamma
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))
        self.register_buffer("returns", torch.zeros(streams, dtype=torch.float64))
        self.seen, self.gained = Moments(size), Moments(1)

    def normalize(self, observation: Tensor) -> Tensor:
        """Normalizes observations ``[*B, F]`` with the applied statistics."""
        if not self._observations:
            return observation
        scaled: Tensor = (observation - self.mean) / self.scale
        return scaled.clamp(-CLIP, CLIP)

    @torch.no_grad()
    def forward(self, rollout: Sequence[TensorDictBase]) -> list[TensorDictBase]:
        """Updates the statistics with a rollout, and returns its normalized frames.

        Args:
            rollout (sequence of TensorDictBase): Frames ``[T]`` of each simulator, with
                ``"observation"`` and, under ``"next"``, ``"observation"``, ``"reward"`` and
                ``"done"``.

        Returns:
            list: Copies with normalized observations and rewards.
        """
        device = self.mean.device
        if self._rewards:
            sums = [self._discounted(i, frames) for i, frames in enumerate(rollout)]
            self.gained.update(torch.cat(sums).unsqueeze(-1).to(device))
        if self._observations:
            self.seen.update(torch.cat([f["observation"] for f in rollout]).to(device))
        return [self.normalized(frames) for frames in rollout]

    @torch.no_grad()
    def normalized(self, frames: TensorDictBase) -> TensorDictBase:
        """Returns a copy of frames with normalized observations and rewards.

        The statistics do not change.
        """
        copied = frames.copy()
        for key in ("observation", ("next", "observation"), PREVIOUS):
            if key not in frames.keys(True):
                continue
            copied.set(key, self.normalize(frames[key].to(self.mean.device)))
        if self._rewards:
            scaled = frames["next", "reward"].to(self.mean.device) / self.gained.scale.float()
            copied.set(("next", "reward"), scaled.clamp(-CLIP, CLIP))
        return copied

    def apply_statistics(self) -> None:
        """Applies the statistics of all observations so far to later normalizations."""
        if self._observations:
            self.mean.copy_(self.seen.mean)
            self.scale.copy_(self.seen.scale)

    def _discounted(self, stream: int, frames: TensorDictBase) -> Tensor:
        total, sums = self.returns[stream].item(), []
        rewards, done = frames["next", "reward"], frames["next", "done"]
        for reward, ends in zip(rewards.flatten().tolist(), done.flatten().tolist(), strict=True):
            total = self._gamma * total + reward
            sums.append(total)
            if ends:
                total = 0.0
        self.returns[stream] = total
        return torch.tensor(sums, dtype=torch.float64)


class Moments(nn.Module):
    """Running mean and variance, initially 0 and 1.

    Args:
        size (int): Length of a vector.

    Examples:
        >>> import torch
        >>> moments = Moments(1)
        >>> for part in ([[1.0], [3.0]], [[5.0]]):
        ...     moments.update(torch.tensor(part))
        >>> moments.mean.round(decimals=2).item(), moments.var.round(decimals=2).item()
        (3.0, 2.67)
    """

    mean: Tensor
    var: Tensor
    count: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("var", torch.ones(size, dtype=torch.float64))
        # A small weight: the first values replace the initial mean and variance.
        self.register_buffer("count", torch.tensor(1e-4, dtype=torch.float64))

    @property
    def scale(self) -> Tensor:
        """Standard deviation."""
        deviation: Tensor = (self.var + EPSILON).sqrt()
        return deviation

    def update(self, values: Tensor) -> None:
        """Updates with values ``[N, F]`` by the parallel Welford algorithm (Chan 1983)."""
        values = values.double()
        number, mean = len(values), values.mean(0)
        total = self.count + number
        delta = mean - self.mean
        squares = self.var * self.count + values.var(0, unbiased=False) * number
        self.var.copy_((squares + delta.square() * self.count * number / total) / total)
        self.mean.add_(delta * number / total)
        self.count.copy_(total)


class ActingPolicy(TensorDictModuleBase):
    """Policy with normalized observations and clipped mean actions.

    Samples are not clipped, because their log-likelihood belongs to the unclipped action.
    :meth:`clip_action` clips them for the task.

    Args:
        policy (TensorDictModule): Policy that reads a normalized ``"observation"``.
        normalization (Normalization, optional): Normalization of the observations. Default: none.
        low (Tensor, optional): Lower bounds ``[A]`` of the action. Default: none.
        high (Tensor, optional): Upper bounds ``[A]`` of the action. Default: none.
    """

    low: Tensor | None
    high: Tensor | None

    def __init__(
        self,
        policy: TensorDictModule,
        normalization: Normalization | None,
        low: Tensor | None = None,
        high: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = list(policy.in_keys), list(policy.out_keys)
        self.policy, self.normalization = policy, normalization
        self.register_buffer("low", low, persistent=False)
        self.register_buffer("high", high, persistent=False)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the policy's outputs for the normalized observation."""
        seen = tensordict.get("observation")
        if self.normalization is not None:
            seen = self.normalization.normalize(seen)
        written = self.policy(TensorDict({"observation": seen}, tensordict.batch_size))
        for key in self.out_keys:
            tensordict.set(key, written.get(key))
        if exploration_type() is not ExplorationType.RANDOM:
            tensordict.set("action", self.clip_action(tensordict.get("action")))
        return tensordict

    def clip_action(self, action: Tensor) -> Tensor:
        """Clips sampled actions ``[*B, A]`` to the bounds, for the task."""
        if self.low is None or self.high is None:
            return action
        return action.clamp(self.low, self.high)
