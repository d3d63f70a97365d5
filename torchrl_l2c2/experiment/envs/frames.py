"""Frames of an episode, and checks for NaN and infinity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

# Entry of the previous observation, for regularizers that read it.
PREVIOUS = "previous_observation"


class Frame(NamedTuple):
    """One transition.

    Attributes:
        observation: Observation before the action.
        outputs: Outputs of the policy by key, including the action.
        next_observation: Observation after the action, also at the end of an episode.
        reward: Reward of the action.
        terminated: Whether the task ended the episode.
        truncated: Whether something else ended it, such as a time limit.
    """

    observation: Tensor
    outputs: dict[str, Tensor]
    next_observation: Tensor
    reward: float
    terminated: bool
    truncated: bool

    @property
    def done(self) -> bool:
        """Checks whether the episode ends with this frame."""
        return self.terminated or self.truncated

    def row(self) -> dict[NestedKey, Tensor]:
        """Returns the frame as a row of :func:`stack_frames`, by key."""
        false = torch.zeros(1, dtype=torch.bool)
        return {
            "observation": self.observation,
            **dict.fromkeys(("done", "terminated", "truncated"), false),
            **self.outputs,
            ("next", "observation"): self.next_observation,
            ("next", "reward"): torch.tensor([self.reward], dtype=torch.float32),
            ("next", "done"): torch.tensor([self.done]),
            ("next", "terminated"): torch.tensor([self.terminated]),
            ("next", "truncated"): torch.tensor([self.truncated]),
        }

    def is_finite(self) -> bool:
        """Checks that no value is NaN or infinite. A sum that overflows counts as infinite."""
        # Sums need fewer operations than a check of every element.
        tensors = (self.observation, self.outputs["action"], self.next_observation)
        return math.isfinite(self.reward + sum(float(tensor.sum()) for tensor in tensors))


def reward_to_float(reward: Any) -> float:
    """Converts a reward to a float, also from an array or a tensor with one element.

    Raises:
        ValueError: If the reward is not one number, such as one number for each of several goals.
    """
    if isinstance(reward, float):  # Includes NumPy's float64.
        return reward
    given = np.asarray(reward)
    if given.size != 1 or given.dtype.kind not in "biuf":
        raise ValueError(f"expected one number as the reward of a step, got {reward!r}.")
    return float(given.item())


def stack_frames(frames: Sequence[Frame]) -> TensorDictBase:
    """Stacks frames to a batch ``[T]`` as of TorchRL's collectors, with their common entries."""
    observations, outputs, successors, rewards, terminated, truncated = zip(*frames, strict=True)
    ends = [torch.tensor(flags).unsqueeze(-1) for flags in (terminated, truncated)]
    false = torch.zeros_like(ends[0])
    written = [key for key in outputs[0] if all(key in each for each in outputs)]
    return TensorDict(
        {
            "observation": torch.stack(observations),
            "done": false,
            "terminated": false.clone(),
            "truncated": false.clone(),
            **{key: torch.stack([each[key] for each in outputs]) for key in written},
            "next": {
                "observation": torch.stack(successors),
                "reward": torch.tensor(rewards, dtype=torch.float32).unsqueeze(-1),
                "done": ends[0] | ends[1],
                "terminated": ends[0],
                "truncated": ends[1],
            },
        },
        [len(frames)],
    )


def check_finite(
    batch: TensorDictBase,
    first_frame: int,
    *,
    test: bool = False,
    observation: NestedKey = "observation",
    action: NestedKey = "action",
) -> None:
    """Checks that observations, actions and rewards are finite.

    Args:
        batch (TensorDictBase): Frames ``[T]``.
        first_frame (int): Number of frames before the batch, for the error.

    Keyword Args:
        test (bool): Whether the frames are from a test. Default ``False``.
        observation (NestedKey): Key of the observation.
        action (NestedKey): Key of the action.

    Raises:
        FloatingPointError: If a value is NaN or infinite; states the first key and frame.
    """
    found = []
    # In causal order: a bad action also spoils the next observation and the reward.
    for key in (observation, action, ("next", observation), ("next", "reward")):
        bad = ~batch[key].isfinite()
        if bad.any():
            found.append((int(bad.flatten(1).any(1).nonzero()[0]), key))
    if found:
        step, key = min(found, key=lambda each: each[0])
        source = "policy" if key == action else "environment"
        frame = f"frame {first_frame + step + 1}{' of a test' if test else ''}"
        consequence = "" if test else "; nothing is learned from this episode"
        raise FloatingPointError(
            f"{key} is not finite at {frame}: {batch[key][step].flatten().tolist()}. "
            f"It comes from the {source}{consequence}."
        )
