"""Frames of an episode: one as it is while it is being played, and whether all are finite."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

# The entry of the observation before a state, for regularizers that read it.
PREVIOUS = "previous_observation"


class Frame(NamedTuple):
    """One transition.

    Attributes:
        observation: before the action.
        outputs: what the policy wrote, by its keys; the action is among it.
        following: the observation that came of it, also where the episode ends.
        reward: of the action.
        terminated: whether the task ended the episode.
        truncated: whether something else did, such as a limit of steps.
    """

    observation: Tensor
    outputs: dict[str, Tensor]
    following: Tensor
    reward: float
    terminated: bool
    truncated: bool

    @property
    def done(self) -> bool:
        """Whether it is an episode's last."""
        return self.terminated or self.truncated

    def row(self) -> dict[NestedKey, Tensor]:
        """The row of :func:`stack_frames` that it becomes, by its keys."""
        false = torch.zeros(1, dtype=torch.bool)
        return {
            "observation": self.observation,
            **dict.fromkeys(("done", "terminated", "truncated"), false),
            **self.outputs,
            ("next", "observation"): self.following,
            ("next", "reward"): torch.tensor([self.reward], dtype=torch.float32),
            ("next", "done"): torch.tensor([self.done]),
            ("next", "terminated"): torch.tensor([self.terminated]),
            ("next", "truncated"): torch.tensor([self.truncated]),
        }

    def is_finite(self) -> bool:
        """Whether no NaN and no infinity is in it; a sum that overflows counts as one."""
        # One number each: looking at every element takes several operations.
        tensors = (self.observation, self.outputs["action"], self.following)
        return math.isfinite(self.reward + sum(float(tensor.sum()) for tensor in tensors))


def as_reward(reward: Any) -> float:
    """A reward as Gymnasium has it; an array or a tensor of one number is taken as well.

    Raises:
        ValueError: it is something else, such as a number for each of several goals.
    """
    if isinstance(reward, float):  # NumPy's float64 among them
        return reward
    given = np.asarray(reward)
    if given.size != 1 or given.dtype.kind not in "biuf":
        raise ValueError(f"the reward of a step must be one number, got {reward!r}.")
    return float(given.item())


def stack_frames(frames: Sequence[Frame]) -> TensorDictBase:
    """The batch ``[T]`` of frames, as TorchRL's collectors give it: what they all have."""
    observations, outputs, following, rewards, terminated, truncated = zip(*frames, strict=True)
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
                "observation": torch.stack(following),
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
    """Stops at the first NaN or infinity that the environment or the policy gave.

    Args:
        batch (TensorDictBase): frames, ``[T]``.
        first_frame (int): frames before them, for the error.

    Keyword Args:
        test (bool): whether they are of a test, which has frames of its own. Default ``False``.
        observation (NestedKey): what the environment shows.
        action (NestedKey): what the policy does.

    Raises:
        FloatingPointError: names the key and the frame.
    """
    found = []
    # In the order in which they come about: what follows a bad action is bad as well.
    for key in (observation, action, ("next", observation), ("next", "reward")):
        bad = ~batch[key].isfinite()
        if bad.any():
            found.append((int(bad.flatten(1).any(1).nonzero()[0]), key))
    if found:
        step, key = min(found, key=lambda each: each[0])
        giver = "policy" if key == action else "environment"
        frame = f"frame {first_frame + step + 1}{' of a test' if test else ''}"
        left = "" if test else "; nothing is learned from this episode"
        raise FloatingPointError(
            f"{key} is not finite at {frame}: {batch[key][step].flatten().tolist()}. "
            f"The {giver} gave it{left}."
        )
