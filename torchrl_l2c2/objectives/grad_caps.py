"""Grad-CAPS: policies whose mean does not zigzag over three successive states."""

from __future__ import annotations

from typing import ClassVar, Literal, NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_l2c2._checks import check_bool, check_choice, check_real, read_key
from torchrl_l2c2.objectives._batch import at_rows, finite_successor, is_floating_point
from torchrl_l2c2.objectives._networks import POLICY_NETWORK
from torchrl_l2c2.objectives.regularized import RegularizedLoss
from torchrl_l2c2.policy_distances import policy_mean


class SuccessiveMeans(NamedTuple):
    """A policy's means in three successive states of a batch ``[*B]``, or of ``M`` of its rows.

    Attributes:
        before: the means at the previous states, ``[*B, A]`` or ``[M, A]``.
        mean: the means at the states.
        later: the means at the next states.
        batch: the batch, or its chosen rows.
        states_before: the previous states, ``[1, *B]`` or ``[1, M]``.
        counts: mask of the transitions that count, ``[*B]`` or ``[M]``.
        rows: indices of the chosen rows in the flattened batch, ``[M]``; ``None`` for all rows.
    """

    before: Tensor
    mean: Tensor
    later: Tensor
    batch: TensorDictBase
    states_before: TensorDictBase
    counts: Tensor
    rows: Tensor | None


class GradCAPSLoss(RegularizedLoss):
    r"""A loss with the second-order temporal term of Grad-CAPS (arXiv 2407.04315).

    Adds this term, ``loss_grad_caps``, to any TorchRL loss with a policy:

    .. math::
        \lambda\, \mathbb E\left[\left\lVert \frac{\mu(s_{t+1}) - 2 \mu(s_t) + \mu(s_{t-1})}
            {\tanh\lvert\mu(s_{t+1}) - \mu(s_{t-1})\rvert + \epsilon} \right\rVert_2^2\right],

    the second difference of the mean action, relative in each coordinate to the change over both
    steps. A steady motion costs nothing, a zigzag does. [inferred] The denominator has an absolute
    value, which keeps it positive, and a gradient.

    Batches need the observation before each state. Append
    :class:`~torchrl.envs.transforms.CatFrames` to the environment, after transforms that normalize
    the observation::

        CatFrames(N=2, dim=-1, in_keys=["observation"], out_keys=["frames"])

    The first half of ``frames`` is then the previous observation; in the first step of an episode
    it is the state itself (or zeros with ``padding="constant"``, which are used as they are). If
    the batch has the previous observation as a separate entry, such as the
    ``"previous_observation"`` of this package's experiment, pass its name as ``previous_key``.
    The previous state is evaluated with the masks and labels of the state, because its own are not
    in the batch.

    Args:
        base_loss (LossModule): the loss; see :class:`RegularizedLoss` for how it is wrapped. Its
            policy must read a single observation, a vector.
        lambda_temporal (float): :math:`\lambda`, at least 0. Larger values straighten the actions.
            Scheduled as ``grad_caps_lambda_temporal``. Defaults to ``0.01``.
        epsilon (float): :math:`\epsilon`, greater than 0. Smaller values penalize zigzags around a
            constant action more. Defaults to ``0.1``.

    Keyword Args:
        frames_key (NestedKey): entry that ``CatFrames`` writes. Defaults to ``"frames"``.
        previous_key (NestedKey, optional): entry with the previous observation, read instead of
            ``frames_key``. Defaults to ``None``.
        mean (str): ``"loc"`` compares means before the squashing, ``"action"`` mean actions.
            Defaults to ``"loc"``.
        fraction (float): share of the batch, in (0, 1], whose states are compared. Each call draws
            new rows with torch's global generator. Smaller values save time and memory in large
            batches and make the term noisier; its expectation does not change. Defaults to ``1.0``.
        skip_ends (bool): whether to leave out transitions that end an episode. Use it for
            environments that store the reset state as the last next observation. Defaults to
            ``False``.

    Raises:
        TypeError: the loss has no policy or cannot be regularized, the policy is recurrent, or an
            argument has the wrong type.
        ValueError: an argument is out of its range; in use, the policy reads several observations,
            or the frames are not two observations; in the first eager call, the second frame is not
            the state, or the next states are several steps away.
        KeyError: in use, the batch has no previous observation.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import Actor, ValueOperator
        >>> from torchrl.objectives import DDPGLoss
        >>> from torchrl_l2c2 import GradCAPSLoss
        >>> value = ValueOperator(torch.nn.Bilinear(3, 1, 1), in_keys=["observation", "action"])
        >>> loss = GradCAPSLoss(DDPGLoss(Actor(torch.nn.Linear(3, 1)), value))
        >>> before, state, later = torch.zeros(1, 3), torch.ones(1, 3), 2 * torch.ones(1, 3)
        >>> batch = TensorDict({"observation": state, "next": {"observation": later}}, [1])
        >>> batch["frames"] = torch.cat((before, state), -1)  # a straight line
        >>> loss.policy_regularizer(batch)["loss_grad_caps"].item() < 1e-6
        True
    """

    _settings: ClassVar[tuple[str, ...]] = (
        "grad_caps_epsilon",
        "grad_caps_mean",
        "grad_caps_fraction",
    )

    def __init__(
        self,
        base_loss: LossModule,
        lambda_temporal: float = 0.01,
        epsilon: float = 0.1,
        *,
        frames_key: NestedKey = "frames",
        previous_key: NestedKey | None = None,
        mean: Literal["loc", "action"] = "loc",
        fraction: float = 1.0,
        skip_ends: bool = False,
    ) -> None:
        check_choice("mean", mean, ("loc", "action"))
        check_real("epsilon", epsilon, above=0)
        check_real("fraction", fraction, above=0, at_most=1)
        self.grad_caps_epsilon = float(epsilon)
        self.grad_caps_mean = mean
        self.grad_caps_fraction = float(fraction)
        check_bool("skip_ends", skip_ends)
        self.skip_ends = self.skip_ends or skip_ends
        self.grad_caps_frames_key = read_key("frames_key", frames_key)
        self.grad_caps_previous_key = previous_key
        if previous_key is not None:
            self.grad_caps_previous_key = read_key("previous_key", previous_key)
        self._grad_caps_checked = False
        self.register_coefficient("grad_caps_lambda_temporal", lambda_temporal)
        self.declare_policy()
        if self.networks[POLICY_NETWORK].recurrent:
            raise TypeError(
                f"{type(self).__name__.partition('[')[0]} compares the policy's action with the "
                "action before, and no batch keeps the recurrent state before: choose another "
                "regularizer for a recurrent policy."
            )
        self.declare_terms(policy=["loss_grad_caps"], diagnostics=["grad_caps_counted"])
        self.declare_inputs([self.grad_caps_previous_key or self.grad_caps_frames_key])

    def policy_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        terms = super().policy_regularizer(tensordict)
        near = self.successive_means(tensordict)
        means = near.before, near.mean, near.later
        difference = grad_caps_term(*means, self.grad_caps_epsilon)
        term = self.reduce_term(difference, tensordict, rows=near.rows, counts=near.counts)
        terms.set("loss_grad_caps", self.scaled(term, "grad_caps_lambda_temporal"))
        counted = near.counts.to(term.dtype)
        counted = self.reduce_diagnostic(counted, tensordict, rows=near.rows)
        return terms.set("grad_caps_counted", counted)

    def successive_means(self, tensordict: TensorDictBase) -> SuccessiveMeans:
        """The policy's means at the previous states, the states and the next states.

        Args:
            tensordict: the batch, ``[*B]``.
        """
        return self.made_once("grad_caps_means", lambda: self._evaluate_means(tensordict))

    def _evaluate_means(self, tensordict: TensorDictBase) -> SuccessiveMeans:
        squashed = self.grad_caps_mean == "action"
        rows = self.sample_rows("grad_caps", tensordict, self.grad_caps_fraction)
        batch = at_rows(tensordict, rows)
        counts = self.counted(batch, self.transitions(batch, self.policy_networks()))
        states = self._states_around(batch)
        policies = self.policies_at(tensordict, states, rows)
        here, there = (policy_mean(policy, squashed=squashed) for policy in policies)
        return SuccessiveMeans(there[0], here[0], there[1], batch, states[:1], counts, rows)

    def _states_around(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The previous and the next states, ``[2, *B]``."""
        transitions = self.transitions(tensordict, self.policy_networks(), all_inputs=True)
        observations = [key for key, (s, _) in transitions.items() if is_floating_point(s)]
        if len(observations) != 1:
            raise ValueError(
                f"a policy of one observation is needed, got {observations}: join them with "
                "CatTensors."
            )
        (key,) = observations
        state = transitions[key][0]
        before = self._before(tensordict, key, state).detach().to(state.dtype)
        if not (self._grad_caps_checked or torch.compiler.is_compiling()):
            self._check_successive(tensordict, key, state)
            self._grad_caps_checked = True  # Once: the check synchronizes with a GPU.
        # Labels of the previous state are unknown: use the labels of the state.
        states = {
            k: torch.stack((before if k == key else s, finite_successor(s, successor)))
            for k, (s, successor) in transitions.items()
        }
        return TensorDict(states, batch_size=[2, *tensordict.batch_size])

    def _before(self, tensordict: TensorDictBase, key: NestedKey, state: Tensor) -> Tensor:
        if self.grad_caps_previous_key is not None:
            return self._previous(tensordict, self.grad_caps_previous_key, state)
        frames = tensordict.get(self.grad_caps_frames_key, None)
        if frames is None:
            raise KeyError(
                "the observation before each state is needed, and the batch has no "
                f"{self.grad_caps_frames_key!r}: append CatFrames(N=2, dim=-1, in_keys=[{key!r}], "
                f"out_keys=[{self.grad_caps_frames_key!r}]) to the environment."
            )
        if frames.shape != (*state.shape[:-1], 2 * state.shape[-1]):
            raise ValueError(
                f"{self.grad_caps_frames_key!r} must be two frames of {key!r}, of shape "
                f"{(*state.shape[:-1], 2 * state.shape[-1])}, got {tuple(frames.shape)}: make them "
                "with CatFrames(N=2, dim=-1)."
            )
        return frames[..., : state.shape[-1]]

    def _check_successive(self, tensordict: TensorDictBase, key: NestedKey, state: Tensor) -> None:
        """Refuses states that are not one step apart or have different units."""
        steps = tensordict.get("steps_to_next_obs", None)
        if steps is not None and (steps > 1).any():
            raise ValueError(
                f"next states are up to {int(steps.max())} steps away, and three successive states "
                "are compared: leave MultiStepTransform out."
            )
        if self.grad_caps_previous_key is not None:
            return
        current = tensordict.get(self.grad_caps_frames_key)[..., state.shape[-1] :]
        if not torch.allclose(current.to(state.dtype), state, rtol=0.01, atol=0.001):
            raise ValueError(
                f"the second half of {self.grad_caps_frames_key!r} is not {key!r}: put CatFrames "
                "behind what normalizes or perturbs it, and CatFrames(dim=-1) in the order of time."
            )

    def _previous(
        self, tensordict: TensorDictBase, previous_key: NestedKey, state: Tensor
    ) -> Tensor:
        previous = tensordict.get(previous_key, None)
        if previous is None:
            raise KeyError(
                f"the observation before each state is needed, and the batch has no "
                f"{previous_key!r}, which previous_key names."
            )
        if previous.shape != state.shape:
            raise ValueError(
                f"{previous_key!r} must be the observation before each state, of shape "
                f"{tuple(state.shape)}, got {tuple(previous.shape)}."
            )
        return previous


def grad_caps_term(
    before: Tensor,  # shape: [*B, A]
    mean: Tensor,  # shape: [*B, A]
    later: Tensor,  # shape: [*B, A]
    epsilon: float,
) -> Tensor:  # shape: [*B]
    r"""The term of Grad-CAPS, before its gain and its reduction.

    .. math::
        \left\lVert \frac{\mu_+ - 2 \mu + \mu_-}{\tanh\lvert\mu_+ - \mu_-\rvert + \epsilon}
        \right\rVert_2^2

    Args:
        before: the policy's means at the previous states, :math:`\mu_-`.
        mean: the policy's means at the states, :math:`\mu`.
        later: the policy's means at the next states, :math:`\mu_+`.
        epsilon: :math:`\epsilon`, greater than 0.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.objectives.grad_caps import grad_caps_term
        >>> zigzag = torch.zeros(1, 1), torch.ones(1, 1), torch.zeros(1, 1)
        >>> grad_caps_term(*zigzag, epsilon=0.5)  # (2 / 0.5)^2
        tensor([16.])
    """
    moved = (later - before).abs().tanh() + epsilon
    return ((later - 2.0 * mean + before) / moved).square().sum(-1)
