"""Storage of transitions, and updates of an agent from them."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

import torch
from tensordict import TensorDictBase
from torchrl.data import TensorDictReplayBuffer

from torchrl_l2c2.experiment.agents._torchrl_internals import RowWriter
from torchrl_l2c2.experiment.agents.agent import Agent
from torchrl_l2c2.experiment.envs.frames import Frame
from torchrl_l2c2.experiment.learn.update import ReplayUpdate
from torchrl_l2c2.gains import gradient_shares, is_loss

# Number of updates before the regularizer's gradients are measured, and the share of the loss's
# own gradients below which a warning is logged. The limit is low: for an initially flat policy,
# such as PPO's with orthogonal weights, the share grows during training.
MEASURE_AFTER = 100
WARN_BELOW = 1e-4


def untrained_reason(frames: int, updates: int, random_frames: int) -> str | None:
    """Returns why a training left the policy practically untrained, or ``None`` if it did not.

    Args:
        frames (int): Number of frames.
        updates (int): Number of updates.
        random_frames (int): Number of first frames with random actions.
    """
    if updates and frames > random_frames:
        return None
    what = "no update was made" if not updates else "the policy never acted"
    if not random_frames:
        return (
            f"{what} in {frames} frames: the policy is untrained. Train longer, or reduce "
            "replay.batch_size or algorithm.frames."
        )
    return (
        f"{what} in {frames} frames, of which the first {random_frames} were random "
        "(algorithm.random_frames): the policy is practically untrained. Train longer, or reduce "
        "the frames before the first update (algorithm.random_frames, replay.batch_size, "
        "algorithm.frames)."
    )


class Learner:
    """Stores transitions and updates an agent from them.

    Args:
        agent (Agent): Agent, updated in place.
        replay (TensorDictReplayBuffer): Replay buffer of the transitions.

    Keyword Args:
        reward_factor (float): Factor on the stored rewards.
        compile (bool): Whether to compile the update, as for :func:`~.update.make_update`.

    Attributes:
        compiles: Whether the update is compiled.
        updates: Number of gradient steps so far.
        unreported: Values of the loss's entries in each update since the last report.
        first_update_seconds: Duration of the first update, including compilation; ``None`` before
            it.
        warns_weak_regularizer: Whether to warn if the regularizer's gradients are too small.
        at_full_gain: Context manager in which the regularizer has its final gain.
    """

    def __init__(
        self,
        agent: Agent,
        replay: TensorDictReplayBuffer,
        *,
        reward_factor: float,
        compile: bool,
    ) -> None:
        self.agent = agent
        self.replay = replay
        self.updates = 0
        self.first_update_seconds: float | None = None
        self.warns_weak_regularizer = True
        self.at_full_gain: Callable[[], AbstractContextManager[None]] = nullcontext
        self._reward_factor = reward_factor
        self.compiles = compile
        self.unreported: list[torch.Tensor] = []
        self._learned_from: TensorDictBase | None = None
        self._rows = RowWriter(replay)
        self._read_keys = list(agent.loss.in_keys)
        if agent.advantage is not None:
            # Otherwise TorchRL's loss would estimate them from a minibatch, whose rows are not
            # consecutive.
            self._read_keys += [agent.advantage.advantage_key, agent.advantage.value_target_key]
        self.rebuild_update()

    def rebuild_update(self) -> None:
        """Rebuilds the update, which is necessary after tensors or settings were replaced."""
        self.agent.refresh_policy()
        self.update = ReplayUpdate(self.agent, self.replay, compile=self.compiles)

    @torch.no_grad()
    def remember(self, transitions: TensorDictBase) -> None:
        """Stores the entries that the loss reads. Others would only make sampling slower."""
        transitions = self.agent.prepare_for_loss(transitions, self._reward_factor)
        self.replay.extend(transitions.select(*self._read_keys, strict=False))

    @torch.no_grad()
    def remember_frame(self, frame: Frame) -> None:
        """Stores one frame as :meth:`remember` does, for algorithms with an update per step."""
        row = frame.row()
        row["next", "reward"] *= self._reward_factor
        self._rows.write({key: row[key] for key in self._read_keys if key in row})

    def learn(self, updates: int) -> None:
        """Makes updates from the replay buffer, or none while it has less than one batch.

        Args:
            updates (int): Number of updates.
        """
        if len(self.replay) < self.replay.batch_size:
            return
        for _ in range(updates):
            self._update()
        self.agent.refresh_policy()

    def learn_rollout(self, epochs: int) -> None:
        """Makes updates from the stored rollout and empties the buffer.

        Args:
            epochs (int): Number of passes over the rollout.
        """
        for _ in range(epochs):
            self.replay.sampler.ran_out = False
            while not self.replay.sampler.ran_out:
                self._update()
        self._learned_from = self.update.example()
        self.replay.empty()
        self.agent.refresh_policy()

    def example(self) -> TensorDictBase:
        """Returns a batch from the whole buffer, or from the last rollout if it was emptied."""
        return self.update.example() if self._learned_from is None else self._learned_from

    def _update(self) -> None:
        with_policy = (self.updates + 1) % self.agent.policy_delay == 0
        started = time.monotonic()
        values = self.update(with_policy)
        if self.first_update_seconds is None:
            self.first_update_seconds = time.monotonic() - started
        self.updates += 1
        self.unreported.append(values)
        if self.updates == MEASURE_AFTER and self.warns_weak_regularizer:
            self._warn_weak_regularizer()

    def _warn_weak_regularizer(self) -> None:
        with self.at_full_gain():
            shares = self.shares(self.update.example())
        if shares and max(shares.values()) < WARN_BELOW:
            each = ", ".join(f"{key}: {share:.1g}" for key, share in shares.items())
            warnings.warn(
                f"after {self.updates} updates, the gradients of the regularizer's terms are below "
                f"{WARN_BELOW:g} of the loss's own gradients ({each}), which is probably too small "
                "for any effect: raise the gains of the regularizer, or lower "
                "algorithm.reward_scale.",
                stacklevel=2,
            )

    def shares(self, batch: TensorDictBase) -> dict[str, float]:
        """Returns the finite :func:`~.gradient_shares` of the regularizer's terms.

        Terms of networks that only the regularizer trains, such as a predictor, have none.

        Args:
            batch (TensorDictBase): Batch of the loss.
        """
        if not hasattr(self.agent.loss, "added_terms"):
            return {}
        shares = gradient_shares(self.agent.loss, batch)
        return {key: share for key, share in shares.items() if math.isfinite(share)}

    def report(self, last_frame: int) -> dict[str, float]:
        """Returns the means of the loss's entries over the updates since the last report.

        ``share_*`` is the absolute value of a term relative to the sum over all terms: the weight
        of the regularizer in the loss.

        Args:
            last_frame (int): Number of frames of the run, for errors.

        Raises:
            FloatingPointError: If an entry or a parameter is NaN or infinite.
        """
        keys, terms = self.agent.loss.out_keys, self.unreported
        self.unreported = []
        if terms:
            values = torch.stack(terms)
            self._check_finite(values, last_frame)
            self.check_parameters()
            values = values.mean(0)
        else:
            values = torch.full((len(keys),), math.nan)
        means = dict(zip(keys, values.tolist(), strict=True))
        losses = {k: abs(v) for k, v in means.items() if is_loss(k)}
        total = sum(losses.values())
        shares = {
            k.replace("loss", "share"): v / total if total else 0.0 for k, v in losses.items()
        }
        return {**means, **shares}

    def check_parameters(self) -> None:
        """Checks that all parameters are finite.

        Raises:
            FloatingPointError: If a parameter has a NaN or infinite value.
        """
        for name, parameter in self.agent.loss.named_parameters():
            if not parameter.isfinite().all():
                raise FloatingPointError(
                    f"{name} is not finite after update {self.updates}, because a gradient was not "
                    "finite."
                )

    def _check_finite(self, values: torch.Tensor, last_frame: int) -> None:
        bad = ~values.isfinite()
        if bad.any():
            step, column = bad.nonzero()[0].tolist()
            raise FloatingPointError(
                f"{self.agent.loss.out_keys[column]} is {values[step, column].item()} at update "
                f"{self.updates - len(values) + step + 1} (frame {last_frame})."
            )
