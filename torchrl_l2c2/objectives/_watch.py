"""Warnings of mistakes in a training loop, such as terms that it does not add."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torch.compiler import is_compiling

from torchrl_l2c2._warnings import warn
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
        progress: the last progress that was set; -1 before the first.
        standing: how often in a row it was set to 0.
        pending: added terms that were never differentiated; ``None`` before the first call.
    """

    def __init__(self) -> None:
        self.progress = -1.0
        self.standing = 0
        self.pending: set[str] | None = None
        self._calls = 0
        self._forwards = 0
        self._parts = 0
        self._counted = 0
        self._zero_ends = 0
        self._sums: list[list[float]] = []
        self._warned: set[str] = set()

    @torch.compiler.disable  # Otherwise Dynamo tries to compile it where the loss breaks the graph.
    def see_call(self, loss: Any, batch: TensorDictBase) -> None:
        """Counts a call of a loss, or of its ``actor_loss``, in training."""
        self._calls += 1
        if loss._followed:
            if self._calls == 1:
                _warn_of_several_steps(batch)
                _warn_of_still_images(loss, batch)
            self._see_ends(loss, batch)
        if self._calls in (1, PATIENCE) and hasattr(loss, "asap_predictor"):
            self._see_predictor(loss)
        if self._calls == PATIENCE and loss._ramp is not None and self.progress < 0:
            warn(
                f"the gain of {type(loss).__name__} follows the progress of training, and "
                f"set_progress was not called in {PATIENCE} updates: it stays at "
                f"{loss.regularizer_gain.item():g}. Call "
                "loss.set_progress(frames / total_frames) before the updates on every rollout, "
                "first with 0, as ProgressHook does in TorchRL's trainers, or choose ramp=None."
            )
        if self._calls % STANDSTILL == 0 and "standing" not in self._warned and loss.strength > 0:
            # Twice at the first rollout, if it was also set before training.
            stands = self.standing > 2 or (self.standing and self._calls >= LONGEST_ROLLOUT)
            if stands and not loss.regularizer_gain:
                self._warned.add("standing")
                warn(
                    f"the penalty of {type(loss).__name__} was 0 until now, because the progress "
                    f"of training is still 0 after {self._calls} updates. Call "
                    "loss.set_progress(frames / total_frames) before the updates on every "
                    "rollout, with / and not //."
                )

    def _see_ends(self, loss: Any, batch: TensorDictBase) -> None:
        """Warns if all that is read is 0 after the ends of episodes, as with some data."""
        done = batch.get(next_key(getattr(loss.tensor_keys, "done", "done")), None)
        if loss.skip_ends or done is None or "ends" in self._warned:
            return
        if done.is_cuda and self._calls % 100 != 1:
            return
        ends = done.reshape(*batch.batch_size, -1).any(-1)
        if not (count := int(ends.sum())):
            return
        pairs = [
            (here[ends].reshape(count, -1), successor[ends])
            for _, here, successor in _read_pairs(loss, batch)
        ]
        before = [here.any(-1) for here, _ in pairs]
        if not pairs or not bool(torch.stack(before).any(0).all()):
            return
        if any(bool(successor.any()) for _, successor in pairs):
            self._warned.add("ends")
            return
        self._zero_ends += count
        if self._zero_ends < 2:
            return
        self._warned.add("ends")
        warn(
            f"the next observation is 0 at all {self._zero_ends} ends of episodes until now. "
            "TorchRL's D4RL and Atari data are stored like this: pass skip_ends=True. With "
            "Gymnasium 1, so are the steps of GymEnv(..., num_envs=2), together with steps across "
            "resets, and their values are wrong: use ParallelEnv, or "
            "GymWrapper(gymnasium.make_vec(...)) with AutoresetMode.SAME_STEP."
        )

    def see_progress(self, loss: Any, progress: float) -> None:
        """Records that the progress was set; warns if a ramp has ended long before training."""
        if loss._ramp is not None and 1 < self.progress < progress and "late" not in self._warned:
            self._warned.add("late")
            warn(
                f"the progress of training is {progress:.3g}, and still rises: the gain of "
                f"{type(loss).__name__} was full too early. Give frames and total_frames in the "
                "same unit, both with or both without skipped frames."
            )
        self.progress = progress
        self.standing = 0 if progress else self.standing + 1

    def _see_predictor(self, loss: Any) -> None:
        """Warns if the optimizer moves parameters of the loss, but none of ASAP's predictor."""
        predictor = {id(parameter) for parameter in loss.asap_predictor.parameters()}
        before, self._sums = self._sums, [[], []]
        for parameter in loss.parameters():
            self._sums[id(parameter) in predictor].append(parameter.detach().sum().item())
        if before and before[1] == self._sums[1] and before[0] != self._sums[0]:
            warn(
                f"the predictor of {type(loss).__name__} did not change in {PATIENCE} updates: the "
                "penalty pulls the policy back to its initial actions. Make the optimizer with "
                "loss.parameters(), or give it loss.asap_predictor.parameters(), too."
            )

    def see_added(self, loss: Any, added: TensorDictBase, own: Tensor | None) -> None:
        """Warns if either policy terms or the loss's own term have no gradient."""
        terms = sorted(loss.policy_terms & added.keys())
        flat = [key for key in terms if not added[key].requires_grad]
        if "gradient" in self._warned or own is None:
            return
        if not own.requires_grad and len(flat) < len(terms):
            self._warned.add("gradient")
            warn(
                f"the policy's own term of {type(loss).__name__} has no gradient, so only the "
                "penalty would train the policy: compute it from the policy's output. Actions that "
                "are drawn without reparameterization have no gradient."
            )
        elif own.requires_grad and flat:
            self._warned.add("gradient")
            warn(
                f"{flat} of {type(loss).__name__} has no gradient, so it does not train the "
                "policy: compute it from the policy's output, without detach() and comparisons."
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
            warn(
                f"{sorted(self.pending)} of {type(loss).__name__} were not differentiated in "
                f"{PATIENCE} calls: the training loop does not add them, so the regularizer has no "
                "effect. Add them to the loss that is minimized, or call loss.fold() after making "
                "it (as smooth(loss) does), which adds them to the loss's own terms."
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
            warn(
                f"policy_regularizer of {type(loss).__name__} does not know the size of the action "
                "values, to which the penalty is relative: its terms are too small or too large. "
                "Call loss(batch) or loss.actor_loss(batch), or make the loss with relative=False "
                "and a gain."
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
            warn(
                f"actor_loss and value_loss of {type(loss).__name__} were called {PATIENCE} times "
                "without its terms: add policy_regularizer(batch) and value_regularizer(batch), or "
                "call loss.fold() after making it (as smooth(loss) does)."
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
                warn(
                    f"all transitions of the batch are longer than max_step={max_step:g} or not "
                    f"finite, so the penalty of {type(loss).__name__} is 0: raise max_step, or "
                    "choose max_step=None."
                )
        elif not bool(counts.all()):
            self._warned.add("counts")
            share = 1.0 - counts.float().mean().item()
            warn(
                f"{share:.2%} of the transitions in the batch have an observation or a next "
                "observation without a finite entry, as some environments give at resets: the "
                f"terms of {type(loss).__name__} that compare the two leave these transitions out, "
                "and have no effect if all are left out: keep the true next observations."
            )

    def see_distance(self, difference: Tensor) -> None:
        """Warns if a ``policy_distance`` of the user's own is negative, in the first call."""
        if is_compiling() or "distance" in self._warned:
            return
        self._warned.add("distance")
        if bool((difference < -1e-6).any()):
            warn(
                f"policy_distance returned {difference.min().item():.3g}: distances are at least "
                "0, and a negative penalty trains the policy to change more. Return a square or an "
                "absolute value."
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
            warn(_ELSEWHERE.format(type(loss).__name__))
            return
        drawn, wanted = distance.shape[-1] if distance is not None else 0, loss.l2c2_num_samples
        if drawn != wanted and loss.l2c2_over_neighbors == "max":
            warn(
                f"the neighbors in the batch were drawn with num_samples={drawn}, and "
                f"{type(loss).__name__} takes the largest penalty of {wanted}: append the "
                "transform that loss.neighbor_transform() returns."
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
                warn(
                    f"the neighbors in the batch are not near its {key!r}, so the penalty of "
                    f"{type(loss).__name__} is wrong: append neighbor_transform() after all "
                    "transforms that change observations, such as ObservationNorm. In a buffer "
                    "that relabels goals after its transforms, leave it out: then the loss draws "
                    "the neighbors."
                )
                return
            if distance is not None and _is_elsewhere(
                here, successor, there, distance.movedim(-1, 0), near
            ):
                warn(_ELSEWHERE.format(type(loss).__name__))
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
        warn(
            f"the next observations of the batch are up to {most} steps ahead of their states "
            "(n-step returns): the neighborhoods are larger than with single transitions, and so "
            "is the penalty. The presets were found with single transitions: choose a smaller "
            "strength."
        )


def _warn_of_still_images(loss: Any, batch: TensorDictBase) -> None:
    """Warns if images of whole numbers stay still in the neighborhood of L2C2."""
    if getattr(loss, "l2c2_moved_keys", ()) is not None:
        return
    for key, state, successor in _read_pairs(loss, batch):
        is_image = state.dtype == torch.uint8 and state.ndim > batch.batch_dims + 1
        if is_image and not torch.equal(state, successor):
            warn(
                f"{key!r} is {state.dtype}, and stays the same in all neighbors of "
                f"{type(loss).__name__}: cast it, as ToTensorImage does, or name the observations "
                "that move in moved_keys."
            )


def _read_pairs(loss: Any, batch: TensorDictBase) -> Iterator[tuple[NestedKey, Tensor, Tensor]]:
    """Yields the states that are compared with a successor: key, state, successor."""
    read = (loss._evaluation.specs[name].states for name in loss._followed)
    for key in dict.fromkeys(key for states in read for key in states):
        here, successor = batch.get(key, None), batch.get(next_key(key), None)
        if isinstance(here, Tensor) and isinstance(successor, Tensor):
            yield key, here, successor


def _forget(pending: set[str], key: str, gradient: Tensor) -> None:
    pending.discard(key)
