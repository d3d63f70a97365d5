"""PPO-RPE, the reinforcement-learning algorithm of the paper's experiment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictParams,
    dispatch,
)
from torch import Tensor
from torchrl.objectives import ValueEstimators
from torchrl.objectives.utils import dispatch_value_estimator

from torchrl_l2c2._checks import check_choice, check_real
from torchrl_l2c2.objectives._batch import next_key, read_taken
from torchrl_l2c2.objectives._evaluation import SharedEvaluation


def relative_density_ratio(
    ratio: Tensor,  # shape: [*B]
    beta: float,
) -> Tensor:  # shape: [*B]
    r"""The density ratio to a mixture, :math:`\rho_R = \rho / (1 - \beta + \beta\rho)`.

    Args:
        ratio: :math:`\rho = \pi(a|s) / b(a|s)`, at least 0.
        beta: share of :math:`\pi` in the mixture, in ``(0, 1)``. Larger values bound the relative
            ratio, which lies in :math:`[0, 1 / \beta)`, more tightly.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.objectives.ppo_rpe import relative_density_ratio
        >>> relative_density_ratio(torch.tensor([0.0, 1.0, 3.0]), beta=0.5)
        tensor([0.0000, 1.0000, 1.5000])
    """
    return ratio / (1.0 - beta + beta * ratio)


def penalty_gain(
    advantage: Tensor,  # shape: [*B]
    threshold: Tensor,  # shape: [] or [*B]
    beta: float,
) -> Tensor:  # shape: [*B]
    r"""The gain that makes the loss stationary exactly at the threshold.

    .. math::
        C = |A| / \big(\epsilon\,((1-\beta) - \mathrm{sgn}(A)\,\beta\epsilon/2)\big)

    Args:
        advantage: :math:`A`.
        threshold: :math:`\epsilon`, allowed :math:`|\rho_R - 1|`, in :math:`(0, 2(1/\beta - 1))`;
            outside, the gain is negative. Larger values penalize less.
        beta: as in :func:`relative_density_ratio`.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.objectives.ppo_rpe import penalty_gain
        >>> penalty_gain(torch.tensor([1.0, -1.0]), torch.tensor(0.4), beta=0.5)
        tensor([6.2500, 4.1667])
    """
    stationary = (1.0 - beta) - advantage.sign() * beta * threshold / 2.0
    return advantage.abs() / (threshold * stationary)


def actor_loss(
    advantage: Tensor,  # shape: [*B]
    ratio: Tensor,  # shape: [*B]
    threshold: Tensor,  # shape: [] or [*B]
    beta: float,
) -> Tensor:  # shape: [*B]
    r"""The policy's loss: the penalized, importance-weighted advantage.

    .. math::
        L_\pi = -A\rho + \tfrac{C}{2} (1-\beta+\beta\rho) (\rho_R - 1)^2

    Args:
        advantage: :math:`A`, without a gradient.
        ratio: :math:`\rho`, as in :func:`relative_density_ratio`.
        threshold: as in :func:`penalty_gain`.
        beta: as in :func:`relative_density_ratio`.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.objectives.ppo_rpe import actor_loss
        >>> actor_loss(torch.tensor(1.0), torch.tensor([1.0, 3.0]), torch.tensor(0.4), beta=0.5)
        tensor([-1.0000, -1.4375])
    """
    relative_ratio = relative_density_ratio(ratio, beta)
    mixture = 1.0 - beta + beta * ratio
    divergence = 0.5 * mixture * (relative_ratio - 1.0).square()
    return penalty_gain(advantage, threshold, beta) * divergence - advantage * ratio


def critic_loss(
    target: Tensor,  # shape: [*B, 1]
    heads: Tensor,  # shape: [*B, K]
) -> Tensor:  # shape: [*B]
    r"""The value function's loss, :math:`L_V = \tfrac12 \sum_k (y - V_k(s))^2`.

    Args:
        target: :math:`y`, one for all heads [inferred].
        heads: :math:`V_k(s)`.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.objectives.ppo_rpe import critic_loss
        >>> critic_loss(torch.tensor([[1.0]]), torch.tensor([[0.0, 3.0]]))
        tensor([2.5000])
    """
    return 0.5 * (target - heads).square().sum(-1)


def update_deviation(
    largest: Tensor,  # shape: []
    relative_ratio: Tensor,  # shape: [*B]
    *,
    decay: float,
    floor: float,
    statistic: Literal["max", "ema"],
    mask: Tensor | None = None,  # shape: [*B]
) -> tuple[Tensor, Tensor]:  # shape: [], []
    r"""The batch's deviation of the ratio, and :math:`\Delta`, which sets the threshold.

    With ``statistic="max"``, :math:`\Delta \leftarrow \max(\Delta_{\min}, \delta\Delta,
    \max|\rho_R - 1|)`; with ``"ema"``, :math:`\Delta \leftarrow \max(\Delta_{\min}, \delta\Delta +
    (1 - \delta)\,\mathrm{mean}|\rho_R - 1|)` [inferred].

    Args:
        largest: the previous :math:`\Delta`.
        relative_ratio: :math:`\rho_R`, without a gradient. NaN counts as no deviation: the running
            maximum must stay finite, and the losses show the NaN.
        decay: :math:`\delta`, in ``[0, 1]``. Smaller values forget large deviations sooner.
        floor: :math:`\Delta_{\min}`, greater than 0.
        statistic: ``"max"`` or ``"ema"``, as above.
        mask: mask of the transitions that count; ``None`` for all.

    Returns:
        The maximum or, with ``"ema"``, the mean of :math:`|\rho_R - 1|` over the batch; and the
        updated :math:`\Delta`.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.objectives.ppo_rpe import update_deviation
        >>> ratio = torch.tensor([1.0, 1.5])
        >>> update_deviation(torch.tensor(0.1), ratio, decay=0.9, floor=0.1, statistic="max")
        (tensor(0.5000), tensor(0.5000))
    """
    deviation = (relative_ratio - 1.0).abs().nan_to_num(0.0)
    if mask is not None:
        deviation = torch.where(mask, deviation, 0.0)
    if statistic == "max":
        deviation = deviation.max()
        updated = (decay * largest).maximum(deviation)
    else:
        count = None if mask is None else mask.sum().clamp_min(1)
        deviation = deviation.mean() if count is None else deviation.sum() / count
        updated = decay * largest + (1.0 - decay) * deviation
    return deviation, updated.clamp_min(floor)


def importance_weight(
    weight: Tensor,  # shape: [*B]
    divisor: Literal["max", "mean"],
    mask: Tensor | None = None,  # shape: [*B]
) -> Tensor:  # shape: [*B]
    r"""The weights of prioritized replay, divided by their maximum or mean [inferred].

    Args:
        weight: weights from the replay buffer, at least 0.
        divisor: the divisor, ``"max"`` or ``"mean"``.
        mask: mask of the transitions that count; ``None`` for all.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.objectives.ppo_rpe import importance_weight
        >>> weight, mask = torch.tensor([1.0, 2.0, 8.0]), torch.tensor([True, True, False])
        >>> importance_weight(weight, "max", mask)
        tensor([0.5000, 1.0000, 0.0000])
    """
    if mask is None:
        return weight / (weight.max() if divisor == "max" else weight.mean())
    kept = torch.where(mask, weight, 0.0)
    scale = kept.max() if divisor == "max" else kept.sum() / mask.sum().clamp_min(1)
    # If nothing counts, 0 / 0 would give a loss of 0 a gradient of NaN.
    return kept / scale.clamp_min(torch.finfo(kept.dtype).tiny)


def of_each_transition(
    log_prob: Tensor,  # shape: [*B] or [*B, 1]
    batch: torch.Size,  # [*B]
    name: str = "the policy's log-likelihood of an action",
) -> Tensor:  # shape: [*B]
    """A log-likelihood in the shape of the batch, one number per transition.

    Raises:
        ValueError: it has one number for each of several actions.
    """
    if log_prob.shape == (*batch, 1):
        return log_prob.squeeze(-1)
    if log_prob.shape != batch:
        raise ValueError(
            f"{name} must be one number, of shape {tuple(batch)} in this batch, got "
            f"{tuple(log_prob.shape)}: use a distribution over whole actions, such as torchrl's "
            "IndependentNormal or TanhNormal."
        )
    return log_prob


# At exp(20) the relative ratio is within 1e-8 of its limit, and the square fits float32.
MAX_LOG_RATIO = 20.0


class PPORPELoss(SharedEvaluation):
    r"""Proximal policy optimization with relative Pearson divergence, one-step actor-critic.

    The divergence between the learned policy :math:`\pi` and the behavior policy :math:`b` is
    measured on the *relative* density ratio, which is bounded. The gain of the penalty makes the
    loss stationary exactly at the threshold (Kobayashi, "Proximal policy optimization with relative
    Pearson divergence", arXiv:2010.03290):

    .. math::
        \rho_R &= \rho / (1 - \beta + \beta\rho), \quad \rho = \pi(a|s) / b(a|s) \\
        C &= |A| / \big(\epsilon\,((1-\beta) - \mathrm{sgn}(A)\,\beta\epsilon/2)\big) \\
        L_\pi &= -A\rho + \tfrac{C}{2} (1-\beta+\beta\rho) (\rho_R - 1)^2 \\
        L_V &= \tfrac12 \textstyle\sum_k (y - V_k(s))^2, \quad
        y = r + \gamma (1 - \mathrm{terminated}) \bar V(s')

    Here :math:`A = y - V(s)` is detached, :math:`\bar V` is the mean of the target critic's heads
    and :math:`\epsilon = \kappa\Delta` is the threshold. If the batch has importance weights of
    prioritized replay, both terms are multiplied by them, divided by their maximum (Schaul et al.,
    arXiv:1511.05952). ``|A|`` is written as the new priority.

    [inferred] Only the abstracts of the algorithm's papers were available. All heads share one
    target. ``threshold``, ``critic_weighting``, ``baseline`` and ``importance`` are settings, and
    their defaults are the variants that worked. ``reduction`` defaults to the mean, as in TorchRL;
    the experiment uses ``"sum"``, which suits ``eps`` of :class:`~.AdaTerm`.

    Args:
        actor_network (ProbabilisticTensorDictSequential): the policy. The loss keeps a target copy.
        critic_network (TensorDictModule): the value function. Writes ``state_value`` ``[*B, 1]``
            and, for an ensemble, ``state_value_heads`` ``[*B, heads]``, whose mean is
            ``state_value``. The loss keeps a target copy.

    Keyword Args:
        gamma (float): discount in ``[0, 1)``. Larger values look further ahead. Default 0.99.
        kappa (float): share of the largest deviation of the ratio that is allowed, above 0.
            Smaller values keep the policy closer to the behavior policy. Default 0.5.
        beta (float): mixture of the relative ratio, in ``(0, 1)``. At 0.5 the ratio is symmetric
            about 1; larger values bound it more tightly. Default 0.5.
        decay (float): decay of :math:`\Delta` per update, in ``[0, 1]``. Smaller values forget
            large deviations sooner. Default 0.999.
        delta_min (float): lowest :math:`\Delta`, in ``(0, 1]``. Default 0.1.
        threshold (str): ``"max"``: :math:`\Delta` is a decaying maximum of
            :math:`|\rho_R - 1|` over batches; ``"ema"``: an exponential moving average of its
            batch mean. [inferred] Default ``"max"``.
        critic_weighting (str): ``"ratio"`` multiplies :math:`L_V` by the detached
            :math:`\rho_R`; ``"none"`` does not. [inferred] Default ``"none"``.
        baseline (str): source of :math:`b`: ``"stored"``, the likelihood stored with the action, or
            ``"target"``, the current likelihood of the target policy. [inferred] Default
            ``"stored"``.
        importance (str): divisor of the importance weights of prioritized replay: ``"max"``, the
            largest weight in the batch, which only scales the loss down; or ``"mean"``, as in
            TorchRL's losses, which keeps the loss at full strength relative to a regularizer.
            [inferred] Default ``"max"``.
        reduction (str): ``"mean"``, ``"sum"`` or ``"none"``, also for the terms of a regularizer. A
            sum is ``B`` times the mean. Default ``"mean"``.

    Raises:
        TypeError: a setting has the wrong type.
        ValueError: a setting is out of its range, or the threshold is so wide that :math:`C` could
            change its sign.

    .. note:: ``delta`` is a persistent buffer, part of the ``state_dict``. It does not change in
        ``eval()`` mode. Likelihood ratios are clamped to ``[exp(-20), exp(20)]`` to avoid overflow.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_l2c2 import PPORPELoss, make_actor, make_critic
        >>> _ = torch.manual_seed(0)
        >>> loss = PPORPELoss(make_actor(3, 1), make_critic(3))
        >>> batch = TensorDict(
        ...     {
        ...         "observation": torch.randn(4, 3),
        ...         "action": torch.rand(4, 1) - 0.5,
        ...         "action_log_prob": torch.zeros(4),
        ...         "next": {
        ...             "observation": torch.randn(4, 3),
        ...             "reward": torch.randn(4, 1),
        ...             "done": torch.zeros(4, 1, dtype=torch.bool),
        ...             "terminated": torch.zeros(4, 1, dtype=torch.bool),
        ...         },
        ...     },
        ...     [4],
        ... )
        >>> terms = loss(batch)
        >>> sorted(terms.keys())
        ['loss_actor', 'loss_critic', 'ratio_deviation', 'ratio_threshold']
        >>> batch["td_error"].shape
        torch.Size([4])
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can change, with their defaults."""

        action: NestedKey = "action"
        sample_log_prob: NestedKey = "action_log_prob"
        value: NestedKey = "state_value"
        value_heads: NestedKey = "state_value_heads"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        priority: NestedKey = "td_error"
        priority_weight: NestedKey = "priority_weight"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    default_value_estimator = ValueEstimators.TD0

    # LossModule.convert_to_functional looks for these annotations.
    actor_network: ProbabilisticTensorDictSequential
    critic_network: TensorDictModule
    actor_network_params: TensorDictParams
    critic_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    target_critic_network_params: TensorDictParams
    delta: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModule,
        *,
        gamma: float = 0.99,
        kappa: float = 0.5,
        beta: float = 0.5,
        decay: float = 0.999,
        delta_min: float = 0.1,
        threshold: Literal["max", "ema"] = "max",
        critic_weighting: Literal["ratio", "none"] = "none",
        baseline: Literal["stored", "target"] = "stored",
        importance: Literal["max", "mean"] = "max",
        reduction: str = "mean",
    ) -> None:
        super().__init__()
        check_real("PPORPELoss: gamma", gamma, at_least=0, below=1)
        check_real("PPORPELoss: beta", beta, above=0, below=1)
        check_real("PPORPELoss: decay", decay, at_least=0, at_most=1)
        check_real("PPORPELoss: delta_min", delta_min, above=0, at_most=1)
        # |rho_R - 1| is at most max(1, 1/beta - 1); at that threshold C must still be positive.
        widest = 2.0 * (1.0 - beta) / (beta * max(1.0, 1.0 / beta - 1.0))
        hint = f"Beyond it, with beta={beta}, the penalty's gain changes its sign."
        check_real("PPORPELoss: kappa", kappa, above=0, below=widest, hint=hint)
        check_choice("PPORPELoss: threshold", threshold, ("max", "ema"))
        check_choice("PPORPELoss: critic_weighting", critic_weighting, ("ratio", "none"))
        check_choice("PPORPELoss: baseline", baseline, ("stored", "target"))
        check_choice("PPORPELoss: importance", importance, ("max", "mean"))
        check_choice("PPORPELoss: reduction", reduction, ("mean", "sum", "none"))

        self.convert_to_functional(actor_network, "actor_network", create_target_params=True)
        self.convert_to_functional(critic_network, "critic_network", create_target_params=True)
        self.gamma = gamma
        self.kappa = kappa
        self.beta = beta
        self.decay = decay
        self.delta_min = delta_min
        self.threshold = threshold
        self.critic_weighting = critic_weighting
        self.baseline = baseline
        self.importance = importance
        self.reduction = reduction
        # A concrete device: the buffer follows the device of the networks.
        self.register_buffer("delta", torch.tensor(delta_min, device=self._default_device))
        # Now, not at the first batch: it is part of the state_dict.
        self.make_value_estimator()
        self._in_keys: list[NestedKey] | None = None
        self._out_keys: list[NestedKey] | None = None

    @property
    def in_keys(self) -> list[NestedKey]:
        if self._in_keys is None:
            states = [*self.actor_network.in_keys, *self.critic_network.in_keys]
            keys = self.tensor_keys
            taken = [keys.action] + ([keys.sample_log_prob] if self.baseline == "stored" else [])
            outcome = (keys.reward, keys.done, keys.terminated, *self.critic_network.in_keys)
            self._in_keys = list(dict.fromkeys([*states, *taken, *map(next_key, outcome)]))
        return self._in_keys

    @in_keys.setter
    def in_keys(self, value: list[NestedKey]) -> None:
        self._in_keys = value

    @property
    def out_keys(self) -> list[NestedKey]:
        if self._out_keys is None:
            self._out_keys = ["loss_actor", "loss_critic", "ratio_deviation", "ratio_threshold"]
        return self._out_keys

    @out_keys.setter
    def out_keys(self, value: list[NestedKey]) -> None:
        self._out_keys = value

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        self._in_keys = None
        super()._forward_value_estimator_keys(**kwargs)

    def make_value_estimator(
        self, value_type: ValueEstimators | str | None = None, **hyperparams: float
    ) -> PPORPELoss:
        """Builds the value estimator. Only TD(0) is correct for replayed single transitions."""
        dispatch_value_estimator(
            self,
            value_type or self.default_value_estimator,
            supported={ValueEstimators.TD0},
            tensor_keys={
                name: getattr(self.tensor_keys, name)
                for name in ("value", "reward", "done", "terminated")
            },
            **hyperparams,
        )
        return self

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes both losses on a batch of transitions.

        Args:
            tensordict (TensorDictBase): transitions of shape ``[*B]``: observations, ``action``,
                its stored log-likelihood, and ``next`` with observations, reward, done and
                terminated. ``td_error`` (``|A|``, shape ``[*B]``) is written into it.

        Returns:
            TensorDict: ``loss_actor``, ``loss_critic`` and, detached, ``ratio_deviation`` (the
            batch's largest or, with ``threshold="ema"``, mean :math:`|\\rho_R - 1|`) and
            ``ratio_threshold`` (:math:`\\epsilon = \\kappa\\Delta`).
        """
        heads, value = self._values(tensordict)
        target = self._target(tensordict)
        advantage = (target - value).detach().squeeze(-1)
        tensordict.set(self.tensor_keys.priority, advantage.abs())

        log_ratio = self._log_ratio(tensordict)
        ratio = log_ratio.clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO).exp()
        relative_ratio = relative_density_ratio(ratio.detach(), self.beta)
        mask = self._mask(tensordict, relative_ratio)
        deviation, threshold = self._update_threshold(relative_ratio, mask)

        loss_actor = actor_loss(advantage, ratio, threshold, self.beta)
        loss_critic = critic_loss(target, heads)
        if self.critic_weighting == "ratio":
            loss_critic = loss_critic * relative_ratio

        weight = self._maybe_get_priority_weight(tensordict)
        if weight is not None:  # A weight of shape [*B, 1] would broadcast to pairs of transitions.
            weight = importance_weight(weight.reshape(advantage.shape), self.importance, mask)
            loss_actor, loss_critic = weight * loss_actor, weight * loss_critic
        return TensorDict(
            {
                "loss_actor": self._reduce_loss(loss_actor, tensordict),
                "loss_critic": self._reduce_loss(loss_critic, tensordict),
                "ratio_deviation": deviation,
                "ratio_threshold": threshold,
            }
        )

    def _reduce_loss(self, loss: Tensor, tensordict: TensorDictBase, **kwargs: Any) -> Tensor:
        """Reduces a term. Weights come from regularizers only, and get a mean of 1."""
        weights = kwargs.get("weights")
        if weights is not None and kwargs["reduction"] != "mean":  # A mean normalizes already.
            kwargs["weights"] = importance_weight(weights, "mean", self._mask(tensordict, weights))
        return super()._reduce_loss(loss, tensordict, **kwargs)

    def _mask(self, tensordict: TensorDictBase, like: Tensor) -> Tensor | None:
        """The mask of transitions that count, in the shape of a tensor; ``None`` for all."""
        if not any(tensordict.get(key, None) is not None for key in self._loss_mask_keys()):
            return None
        return self._reduce_loss(torch.ones_like(like), tensordict, reduction="none") > 0

    def evaluate_at_batch(self, network: str, tensordict: TensorDictBase) -> TensorDictBase:
        """Evaluates a network at the batch's states; regularizers reuse the result."""
        net = getattr(self, network)
        run = net.get_dist_params if network == "actor_network" else net
        with getattr(self, f"{network}_params").to_module(net):
            return run(tensordict.select(*net.in_keys))

    def _values(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """The heads ``[*B, K]`` and their mean ``[*B, 1]``; one head without an ensemble."""
        written = self.evaluate_at_batch("critic_network", tensordict)
        value = written.get(self.tensor_keys.value)
        heads = written.get(self.tensor_keys.value_heads, None)
        return (value if heads is None else heads), value

    def _target(self, tensordict: TensorDictBase) -> Tensor:
        with torch.no_grad():
            return self.value_estimator.value_estimate(
                tensordict, target_params=self.target_critic_network_params
            )

    def _log_ratio(self, tensordict: TensorDictBase) -> Tensor:
        action = read_taken(tensordict, self.tensor_keys.action)
        parameters = self.evaluate_at_batch("actor_network", tensordict)
        log_prob = self.actor_network.build_dist_from_params(parameters).log_prob(action)
        log_prob = of_each_transition(log_prob, batch := tensordict.batch_size)
        if self.baseline == "stored":
            key = self.tensor_keys.sample_log_prob
            stored = read_taken(tensordict, key, ", or take baseline='target'")
            return log_prob - of_each_transition(stored, batch, f"the batch's {key!r}")
        states = tensordict.select(*self.actor_network.in_keys)
        with torch.no_grad(), self.target_actor_network_params.to_module(self.actor_network):
            baseline = self.actor_network.get_dist(states).log_prob(action)
        # Outside of no_grad: keeps the policy's gradient.
        return log_prob - of_each_transition(baseline, batch)

    @torch.no_grad()
    def _update_threshold(
        self, relative_ratio: Tensor, mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        deviation, delta = update_deviation(
            self.delta,
            relative_ratio,
            decay=self.decay,
            floor=self.delta_min,
            statistic=self.threshold,
            mask=mask,
        )
        if self.training:
            self.delta.copy_(delta)
        return deviation, self.kappa * self.delta
