"""What is learned from: transitions are remembered, and updates made of them."""

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

# Updates after which the regularizer's gradients are measured, and the share of the loss's own
# below which they are told to be too small. It is far below what changes a result: the share of
# a policy that begins flat, as PPO's with orthogonal weights, grows while the policy forms.
MEASURED_AFTER = 100
TOLD_BELOW = 1e-4
# Skipped updates in a row after which a run stops.
MOST_SKIPPED = 100


def untrained(frames: int, updates: int, random_frames: int) -> str | None:
    """Why a training of so many frames and updates has no policy to show; ``None`` if it has.

    Args:
        frames (int): that were played.
        updates (int): that were made.
        random_frames (int): first frames whose actions were random.
    """
    if updates and frames > random_frames:
        return None
    what = "no update was made" if not updates else "the policy never acted"
    return (
        f"{what} in {frames} frames, the first {random_frames} of which were random "
        "(algorithm.random_frames): the policy is as good as untrained. Train for longer, or need "
        "fewer frames before the first update (also by replay.batch_size and algorithm.frames)."
    )


class Learner:
    """Remembers transitions and updates an agent from them.

    Args:
        agent (Agent): what is updated, in place.
        replay (TensorDictReplayBuffer): where transitions are kept.

    Keyword Args:
        reward_factor (float): what rewards are multiplied with when they are remembered.
        compile (bool): as for :func:`~.update.make_update`.
        skip_nonfinite (bool): as for :func:`~.update.make_update`.

    Attributes:
        compiles: whether the update is compiled.
        updates: gradient steps so far.
        skipped_updates: batches that were not finite and changed nothing.
        unreported: the loss's entries in every update since the last report.
        first_update_seconds: how long the first took, compilation included; ``None`` before it.
        tells_faint_regularizer: whether to warn of a regularizer whose gradients are too small.
        at_full_gain: within it the regularizer has the gain that it is to end with.
    """

    def __init__(
        self,
        agent: Agent,
        replay: TensorDictReplayBuffer,
        *,
        reward_factor: float,
        compile: bool,
        skip_nonfinite: bool,
    ) -> None:
        self.agent = agent
        self.replay = replay
        self.updates = 0
        self.skipped_updates = 0
        self._skipped_in_a_row = 0
        self.first_update_seconds: float | None = None
        self.tells_faint_regularizer = True
        self.at_full_gain: Callable[[], AbstractContextManager[None]] = nullcontext
        self._reward_factor = reward_factor
        self.compiles = compile
        self._skip_nonfinite = skip_nonfinite
        self.unreported: list[torch.Tensor] = []
        self._learned_from: TensorDictBase | None = None
        self._rows = RowWriter(replay)
        self._read_keys = list(agent.loss.in_keys)
        if agent.advantage is not None:
            # Where they are missing, TorchRL's loss estimates them anew, along a minibatch, whose
            # rows do not follow each other in time.
            self._read_keys += [agent.advantage.advantage_key, agent.advantage.value_target_key]
        self.renew()

    def renew(self) -> None:
        """Makes the update anew: a compiled one is made for the tensors that were there."""
        self.agent.refresh_policy()
        self.update = ReplayUpdate(
            self.agent, self.replay, compile=self.compiles, skip_nonfinite=self._skip_nonfinite
        )

    @torch.no_grad()
    def remember(self, transitions: TensorDictBase) -> None:
        """Keeps the entries that the loss reads, and no others: sampling copies every one."""
        transitions = self.agent.as_learned(transitions, self._reward_factor)
        self.replay.extend(transitions.select(*self._read_keys, strict=False))

    @torch.no_grad()
    def remember_frame(self, frame: Frame) -> None:
        """As :meth:`remember` of the one frame; for algorithms that learn after each."""
        row = frame.row()
        row["next", "reward"] *= self._reward_factor
        self._rows.write({key: row[key] for key in self._read_keys if key in row})

    def learn(self, updates: int) -> None:
        """Makes so many updates with batches from the replay buffer, once it holds one."""
        if len(self.replay) < self.replay.batch_size:
            return
        for _ in range(updates):
            self._update()
        self.agent.refresh_policy()

    def learn_rollout(self, epochs: int) -> None:
        """Goes so many times through all that is remembered, and forgets it."""
        skipped = self._skipped_in_a_row
        for _ in range(epochs):
            self.replay.sampler.ran_out = False
            while not self.replay.sampler.ran_out:
                self._update()
        if skipped < MOST_SKIPPED // 2:  # A rollout is forgotten: a single one stops no run.
            self._skipped_in_a_row = min(self._skipped_in_a_row, MOST_SKIPPED // 2)
        self._learned_from = self.update.example()
        self.replay.empty()
        self.agent.refresh_policy()

    def example(self) -> TensorDictBase:
        """A batch from all over what was last learned from, also once that is forgotten."""
        return self.update.example() if self._learned_from is None else self._learned_from

    def _update(self) -> None:
        with_policy = (self.updates + 1) % self.agent.policy_delay == 0
        started = time.monotonic()
        result = self.update(with_policy)
        if self.first_update_seconds is None:
            self.first_update_seconds = time.monotonic() - started
        if result is None:
            self.skipped_updates += 1
            self._skipped_in_a_row += 1
            return
        self._skipped_in_a_row = 0
        self.updates += 1
        self.unreported.append(result[0])
        if self.updates == MEASURED_AFTER and self.tells_faint_regularizer:
            self._tell_faint_regularizer()

    def _tell_faint_regularizer(self) -> None:
        with self.at_full_gain():
            shares = self.shares(self.update.example())
        if shares and max(shares.values()) < TOLD_BELOW:
            each = ", ".join(f"{key}: {share:.1g}" for key, share in shares.items())
            warnings.warn(
                f"after {self.updates} updates the gradients of the regularizer's terms are less "
                f"than {TOLD_BELOW:g} of the loss's own ({each}), which is likely to change "
                "nothing: raise the gains of the regularizer, or lower algorithm.reward_scale.",
                stacklevel=2,
            )

    def shares(self, batch: TensorDictBase) -> dict[str, float]:
        """The finite :func:`~.gradient_shares` of the regularizer's terms.

        Terms of networks that the loss itself does not train, such as a predictor, have none.
        """
        shares = gradient_shares(self.agent.loss, batch)
        return {key: share for key, share in shares.items() if math.isfinite(share)}

    def report(self, last_frame: int) -> dict[str, float]:
        """Means of every entry of the loss over the updates since the last report.

        A ``share_*`` is the part that a term has of the sum of all terms' sizes: it says at a
        glance whether a regularizer is on, and how much of the loss it is.

        Args:
            last_frame (int): frames that were played, for errors.

        Raises:
            FloatingPointError: an entry was NaN or infinite, or a parameter is now; names it, the
                update and the frame. Or too many updates in a row were skipped.
        """
        self._check_skipped(last_frame)
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

    def _check_skipped(self, last_frame: int) -> None:
        if self._skipped_in_a_row < MOST_SKIPPED:
            return
        row, reward = self.update.culprit
        raise FloatingPointError(
            f"{self._skipped_in_a_row} updates in a row were skipped after update {self.updates} "
            f"(frame {last_frame}), as a loss or gradient was not finite. Row {row} of the replay "
            f"buffer has the reward {reward / self._reward_factor:g}: give smaller rewards, or "
            "lower algorithm.reward_scale."
        )

    def check_parameters(self) -> None:
        """Stops at a parameter that is not finite.

        Raises:
            FloatingPointError: names the parameter and the update.
        """
        for name, parameter in self.agent.loss.named_parameters():
            if not parameter.isfinite().all():
                raise FloatingPointError(
                    f"{name} is not finite after update {self.updates}: a gradient was not."
                )

    def _check_finite(self, values: torch.Tensor, last_frame: int) -> None:
        bad = ~values.isfinite()
        if bad.any():
            step, column = bad.nonzero()[0].tolist()
            raise FloatingPointError(
                f"{self.agent.loss.out_keys[column]} is {values[step, column].item()} at update "
                f"{self.updates - len(values) + step + 1} (frame {last_frame})."
            )
