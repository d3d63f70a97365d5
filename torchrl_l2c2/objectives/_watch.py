"""Warnings of mistakes in a training loop, such as terms that it does not add."""

from __future__ import annotations

import functools
import warnings
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.compiler import is_compiling

from torchrl_l2c2.neighborhood import Neighborhood, step_length
from torchrl_l2c2.objectives._batch import next_key

PATIENCE = 50
"""Calls of a loss before it warns of mistakes in the training loop."""

STANDSTILL = 1000
"""Calls of a loss at progress 0 before it warns, unless the first rollout may have as many."""

LONGEST_ROLLOUT = 5 * STANDSTILL
"""Calls of a loss at progress 0 before it warns in any case."""


_ELSEWHERE = (
    "the neighbors in the batch are of another neighborhood than {}'s, which changes its penalty: "
    "append the transform that loss.neighbor_transform() returns."
)


class TermWatch:
    """Warns, once each and in eager calls, of mistakes in a training loop.

    Attributes:
        progress_set: whether the progress of a ramp was set.
        standing: how often in a row it was set to 0.
        pending: added terms that were never differentiated; ``None`` before the first call.
    """

    def __init__(self) -> None:
        self.progress_set = False
        self.standing = 0
        self.pending: set[str] | None = None
        self._calls = 0
        self._forwards = 0
        self._parts = 0
        self._counted = 0
        self._sums: list[list[float]] = []
        self._warned: set[str] = set()

    def see_call(self, loss: Any, batch: TensorDictBase) -> None:
        """Counts a call of a loss, or of its ``actor_loss``, in training."""
        self._calls += 1
        if self._calls == 1 and loss._followed:
            _warn_of_several_steps(batch)
            _warn_of_zeros(loss, batch)
        if self._calls in (1, PATIENCE) and hasattr(loss, "asap_predictor"):
            self._see_predictor(loss)
        if self._calls == PATIENCE and loss._ramp is not None and not self.progress_set:
            warnings.warn(
                f"the gain of {type(loss).__name__} follows the progress of training, and "
                f"set_progress was not called in {PATIENCE} updates: it stays at "
                f"{loss.regularizer_gain.item():g}. Call "
                "loss.set_progress(frames / total_frames) before the updates on every rollout, "
                "first with 0, or choose ramp=None.",
                stacklevel=4,
            )
        if self._calls % STANDSTILL == 0 and "standing" not in self._warned and loss.strength > 0:
            # Twice at the first rollout, if it was also set before training.
            stands = self.standing > 2 or (self.standing and self._calls >= LONGEST_ROLLOUT)
            if stands and not loss.regularizer_gain:
                self._warned.add("standing")
                warnings.warn(
                    f"the penalty of {type(loss).__name__} was 0 until now, because the progress "
                    f"of training is still 0 after {self._calls} updates. Call "
                    "loss.set_progress(frames / total_frames) before the updates on every "
                    "rollout, with / and not //.",
                    stacklevel=4,
                )

    def see_progress(self, progress: float) -> None:
        """Records that the progress of a ramp was set."""
        self.progress_set = True
        self.standing = 0 if progress else self.standing + 1

    def _see_predictor(self, loss: Any) -> None:
        """Warns if the optimizer moves parameters of the loss, but none of ASAP's predictor."""
        predictor = {id(parameter) for parameter in loss.asap_predictor.parameters()}
        before, self._sums = self._sums, [[], []]
        for parameter in loss.parameters():
            self._sums[id(parameter) in predictor].append(parameter.detach().sum().item())
        if before and before[1] == self._sums[1] and before[0] != self._sums[0]:
            warnings.warn(
                f"the predictor of {type(loss).__name__} did not change in {PATIENCE} updates: the "
                "penalty pulls the policy back to its initial actions. Make the optimizer with "
                "loss.parameters(), or give it loss.asap_predictor.parameters(), too.",
                stacklevel=5,
            )

    def see_added(self, loss: Any, added: TensorDictBase, own: Tensor | None) -> None:
        """Warns of policy terms without a gradient, unless the loss's own term has none either."""
        if "gradient" in self._warned or own is None or not own.requires_grad:
            return
        flat = sorted(k for k in loss.policy_terms & added.keys() if not added[k].requires_grad)
        if flat:
            self._warned.add("gradient")
            warnings.warn(
                f"{flat} of {type(loss).__name__} has no gradient, so it does not train the "
                "policy: compute it from the policy's output, without detach() and comparisons.",
                stacklevel=4,
            )

    def see_forward(self, loss: Any, terms: TensorDictBase) -> None:
        """Counts a call of a loss in training, and follows the gradients of its added terms."""
        self._forwards += 1
        if loss.folded or "gradient" in self._warned:
            return
        if self.pending is None:
            self.pending = set(loss.added_terms)
        for key in tuple(self.pending):
            term = terms.get(key, None)
            if isinstance(term, Tensor) and term.requires_grad:
                term.register_hook(functools.partial(_forget, self.pending, key))
        if self._forwards == PATIENCE and self.pending:
            warnings.warn(
                f"{sorted(self.pending)} of {type(loss).__name__} were not differentiated in "
                f"{PATIENCE} calls: the training loop does not add them, so the regularizer has no "
                "effect. Add them to the loss that is minimized, or call loss.fold() after making "
                "it (as smooth(loss) does), which adds them to the loss's own terms.",
                stacklevel=4,
            )

    def unused(self) -> set[str]:
        """Terms that were not differentiated in several calls."""
        return self.pending or set() if self._forwards > 1 else set()

    def see_regularizer(self, loss: Any, of_policy: bool = False) -> None:
        """Records that a loop computes the terms itself; warns if it would miss their size."""
        if is_compiling() or loss._evaluation.forward_pass is not None:
            return
        self._warned.add("parts")
        if of_policy and loss._relative and "size" not in self._warned:
            self._warned.add("size")
            warnings.warn(
                f"policy_regularizer of {type(loss).__name__} does not know the size of the action "
                "values, to which the penalty is relative: its terms are too small or too large. "
                "Call loss(batch) or loss.actor_loss(batch), or make the loss with relative=False "
                "and a gain.",
                stacklevel=5,
            )

    def see_part(self, loss: Any, kind: str) -> None:
        """Counts a call of ``actor_loss`` or ``value_loss`` without the added terms."""
        policy = bool(loss.policy_terms)
        has_terms = policy if kind == "policy" else bool(loss.added_terms - loss._policy_side)
        if is_compiling() or not has_terms or "parts" in self._warned:
            return
        self._parts += 1
        if self._parts == PATIENCE:
            self._warned.add("parts")
            warnings.warn(
                f"actor_loss and value_loss of {type(loss).__name__} were called {PATIENCE} times "
                "without its terms: add policy_regularizer(batch) and value_regularizer(batch), or "
                "call loss.fold() after making it (as smooth(loss) does).",
                stacklevel=4,
            )

    def see_counts(self, loss: Any, counts: Tensor, max_step: float | None = None) -> None:
        """Warns of observations that are not finite, or of a ``max_step`` that is too small."""
        if is_compiling():
            return
        self._counted += 1
        if "counts" in self._warned or (counts.is_cuda and self._counted % 100 != 1):
            return
        if max_step is not None:
            if not bool(counts.any()):
                self._warned.add("counts")
                warnings.warn(
                    f"all transitions of the batch are longer than max_step={max_step:g} or not "
                    f"finite, so the penalty of {type(loss).__name__} is 0: raise max_step, or "
                    "choose max_step=None.",
                    stacklevel=4,
                )
        elif not bool(counts.all()):
            self._warned.add("counts")
            share = 1.0 - counts.float().mean().item()
            warnings.warn(
                f"{share:.2%} of the transitions in the batch have an observation or a next "
                "observation without a finite entry, as some environments give at resets: the "
                f"terms of {type(loss).__name__} that compare the two leave these transitions out, "
                "and have no effect if all are left out: keep the true next observations.",
                stacklevel=5,
            )

    def see_distance(self, difference: Tensor) -> None:
        """Warns if a ``policy_distance`` of the user's own is negative, in the first call."""
        if is_compiling() or "distance" in self._warned:
            return
        self._warned.add("distance")
        if bool((difference < -1e-6).any()):
            warnings.warn(
                f"policy_distance returned {difference.min().item():.3g}: distances are at least "
                "0, and a negative penalty trains the policy to change more. Return a square or an "
                "absolute value.",
                stacklevel=5,
            )

    def see_neighbors(
        self, loss: Any, neighbors: TensorDictBase, batch: TensorDictBase, near: Neighborhood
    ) -> None:
        """Warns of neighbors that were drawn before a transform changed the observations.

        Also of another number of them for ``over_neighbors="max"``, and of neighbors of another
        neighborhood. Observations with neighbors are floating point.

        Raises:
            ValueError: the neighbors have another shape or dtype than the observations.
        """
        if (
            is_compiling()
            or "neighbors" in self._warned
            or not isinstance(neighbors, TensorDictBase)
        ):
            return
        self._warned.add("neighbors")
        distance = neighbors.get("distance", None)
        if distance is not None and _leaves_out(neighbors, distance, batch, near.max_step):
            self._warned.add("counts")
            warnings.warn(_ELSEWHERE.format(type(loss).__name__), stacklevel=5)
            return
        drawn, wanted = distance.shape[-1] if distance is not None else 0, loss.l2c2_num_samples
        if drawn != wanted and loss.l2c2_over_neighbors == "max":
            warnings.warn(
                f"the neighbors in the batch were drawn with num_samples={drawn}, and "
                f"{type(loss).__name__} takes the largest penalty of {wanted}: append the "
                "transform that loss.neighbor_transform() returns.",
                stacklevel=5,
            )
        for key, there in neighbors.items(include_nested=True, leaves_only=True):
            here, successor = batch.get(key, None), batch.get(next_key(key), None)
            if here is None or successor is None or here.shape != successor.shape:
                continue
            first = there.select(neighbors.batch_dims, 0)
            if first.shape != here.shape or first.dtype != here.dtype:
                raise ValueError(
                    f"the neighbors of {key!r} in the batch are {tuple(first.shape)} {first.dtype} "
                    f"and the states {tuple(here.shape)} {here.dtype}: append "
                    "neighbor_transform() after all transforms that change observations, such as "
                    "DoubleToFloat and FlattenObservation."
                )
            # [*B, K, *F] and [*B, *F]
            there = there.movedim(neighbors.batch_dims, 0)
            span = near.radius * (successor - here).abs()
            rounding = 16 * torch.finfo(here.dtype).eps * (here.abs() + successor.abs())
            if bool(((there - here).abs() > 1.01 * span + rounding).any()):
                warnings.warn(
                    f"the neighbors in the batch are not near its {key!r}, so the penalty of "
                    f"{type(loss).__name__} is wrong: append neighbor_transform() after all "
                    "transforms that change observations, such as ObservationNorm. In a buffer "
                    "that relabels goals after its transforms, leave it out: then the loss draws "
                    "the neighbors.",
                    stacklevel=5,
                )
                return
            if distance is not None and _is_elsewhere(
                here, successor, there, distance.movedim(-1, 0), near
            ):
                warnings.warn(_ELSEWHERE.format(type(loss).__name__), stacklevel=5)
                return


def _leaves_out(
    neighbors: TensorDictBase, distance: Tensor, batch: TensorDictBase, max_step: float | None
) -> bool:
    """Checks if transitions are left out whose observations are known and whose step is short."""
    far = distance.isinf().flatten(batch.batch_dims).any(-1)
    known = []
    for key in neighbors.keys(include_nested=True, leaves_only=True):
        here, successor = batch.get(key, None), batch.get(next_key(key), None)
        if key == "distance" or here is None or successor is None:
            continue
        known += [here, successor]
        if max_step is not None and here.shape == successor.shape:
            far = far & (step_length(here, successor, batch.batch_dims) < 0.99 * max_step)
    return (
        bool(far.any()) and bool(known) and all(bool(each[far].isfinite().all()) for each in known)
    )


def _is_elsewhere(
    here: Tensor, successor: Tensor, there: Tensor, distance: Tensor, near: Neighborhood
) -> bool:
    """Checks if neighbors or their distances cannot be of a neighborhood.

    Args:
        here: observations, ``[*B, *F]``.
        successor: their successors.
        there: their neighbors, ``[K, *B, *F]``.
        distance: the neighbors' distances, ``[K, *B]``.
        near: the neighborhood.
    """
    rows, size = distance[0].numel(), here.shape[distance.ndim - 1 :].numel()
    eps = torch.finfo(here.dtype).eps
    if here.itemsize < 4:
        here, successor, there = here.float(), successor.float(), there.float()
    here, successor = here.reshape(rows, size), successor.reshape(rows, size)
    there = there.reshape(len(distance), rows, size)
    distance = distance.reshape(len(distance), rows)
    step = successor - here
    # Coordinates that hardly move do not tell the place in the box, nor do overflows.
    moved = step.abs() > 0.1 * step.abs().amax(-1, keepdim=True)
    moved = moved & step.isfinite() & there.isfinite().all(0)
    rounding = 16 * eps * (here.abs() + successor.abs()) / step.abs()
    allowed = 0.02 * near.radius + torch.where(moved, rounding, 0.0).amax(-1)
    place = ((there - here) / step).abs()
    low, high = (torch.where(moved, place, end) for end in (torch.inf, -torch.inf))
    low, high = low.amin(-1), high.amax(-1)
    off_line = high - low > allowed
    known = moved.any(-1) & distance.isfinite()
    if not known.any():
        return False
    # A distance is rounded relative to its size.
    margin = allowed + 16 * torch.finfo(distance.dtype).eps * distance
    drawn = distance - near.epsilon
    wrong = (drawn < high - margin) | (drawn > near.radius + margin)
    if near.on_line:
        wrong = wrong | off_line | (drawn > high + margin)
    # The probability that all draws lie so far inside is 1e-6.
    inside = near.radius * 1e-6 ** (1 / int(known.sum()))
    if bool((wrong & known).any()) or bool((drawn + margin)[known].max() < inside):
        return True
    # The draws of a box differ between coordinates.
    told = known & (moved.sum(-1) > 1) & (allowed < 0.04 * near.radius)
    return not near.on_line and int(told.sum()) >= 8 and not bool((told & off_line).any())


def _warn_of_several_steps(batch: TensorDictBase) -> None:
    """Warns if next observations are several steps ahead, as after ``MultiStepTransform``."""
    steps = batch.get("steps_to_next_obs", None)
    most = 1 if steps is None or not steps.numel() else int(steps.max())
    if most > 1:
        warnings.warn(
            f"the next observations of the batch are up to {most} steps ahead of their states "
            "(n-step returns): the neighborhoods are larger than with single transitions, and so "
            "is the penalty. The presets were found with single transitions: choose a smaller "
            "strength.",
            stacklevel=5,
        )


def _warn_of_zeros(loss: Any, batch: TensorDictBase) -> None:
    """Warns if the last next observation of every episode is 0, as with ``GymEnv(num_envs=2)``."""
    done = batch.get(next_key(getattr(loss.tensor_keys, "done", "done")), None)
    if done is None:
        return
    ends = done.reshape(*batch.batch_size, -1).any(-1)
    if (count := int(ends.sum())) < 2:
        return
    read = (loss._evaluation.specs[name].states for name in loss._followed)
    for key in {key for states in read for key in states}:
        here, successor = (batch.get(each, None) for each in (key, next_key(key)))
        if here is None or successor is None:
            continue
        if not successor[ends].any() and here[ends].flatten(1).any(1).all():
            warnings.warn(
                f"the next {key!r} is 0 at all {count} ends of episodes in the batch, as "
                "TorchRL's GymEnv(..., num_envs=2) stores it with Gymnasium 1. It then stores a "
                "step across the reset, too. Values and penalties of both are wrong: use "
                "ParallelEnv, or GymWrapper(gymnasium.make_vec(...)) with "
                "AutoresetMode.SAME_STEP.",
                stacklevel=5,
            )
            return


def _forget(pending: set[str], key: str, gradient: Tensor) -> None:
    pending.discard(key)
