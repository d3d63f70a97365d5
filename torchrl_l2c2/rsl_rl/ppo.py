"""rsl_rl's PPO with a regularizer of this package."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import fields
from inspect import signature
from typing import Any, ClassVar

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import NestedKey, TensorDict
from torch import Tensor

from torchrl_l2c2.neighborhood import Neighborhood
from torchrl_l2c2.objectives import CATSLoss, L2C2Loss, RegularizedLoss
from torchrl_l2c2.rsl_rl.networks import ENTRIES, ActorCriticLoss
from torchrl_l2c2.rsl_rl.regularization import Regularization
from torchrl_l2c2.rsl_rl.storage import ROW, SuccessorStorage
from torchrl_l2c2.transforms import NeighborTransform

FINAL = "final_obs"
"""The entry of an environment's extras with the last observations of ended episodes."""


class RegularizedPPO(PPO):
    """rsl_rl's PPO with a regularizer: what :class:`L2C2PPO` and :class:`CATSPPO` have in common.

    A subclass defines :meth:`regularize` and names the coefficient of its loss.
    """

    coefficient: ClassVar[str]
    """The coefficient of the regularized loss that ``ramp_updates`` is about."""

    storage: SuccessorStorage
    symmetry: Any

    def __init__(
        self,
        actor: MLPModel,
        critic: MLPModel,
        storage: RolloutStorage,
        *args: Any,
        regularizer_cfg: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        networks = ActorCriticLoss(actor, critic)
        _check_groups(storage.observations.keys(), (*ENTRIES, ROW, "next"))
        super().__init__(actor, critic, SuccessorStorage(storage), *args, **kwargs)
        options = dict(regularizer_cfg or {})
        ramp_updates = options.pop("ramp_updates", None)
        loss, neighbors = self.regularize(networks, **options)
        self.symmetry = self.regularization = Regularization(
            loss.to(self.device), neighbors, self.coefficient, ramp_updates, self.symmetry
        )

    def regularize(
        self, networks: ActorCriticLoss, **options: Any
    ) -> tuple[RegularizedLoss, NeighborTransform | None]:
        """The regularized loss, and what writes neighbors into its batches, if anything does.

        Args:
            networks: the loss to put the regularizer around.
            **options: ``regularizer_cfg``, but for ``ramp_updates``.
        """
        raise NotImplementedError

    def process_env_step(
        self, obs: TensorDict, rewards: Tensor, dones: Tensor, extras: dict[str, Any]
    ) -> None:
        final = extras.get(FINAL)
        if final is not None:
            _check_final(final, obs)
        super().process_env_step(obs, rewards, dones, extras)
        if final is not None:
            final = TensorDict({**final}, [self.storage.num_envs], device=self.device)
            self.storage.add_final(final, dones)

    def compute_returns(self, obs: TensorDict) -> None:
        super().compute_returns(obs)
        self.storage.add_last(obs)

    def update(self) -> dict[str, float]:
        """As rsl_rl's, with the regularizer's terms and diagnostics among the losses."""
        losses = super().update()
        del losses["symmetry"]
        losses.update(self.regularization.report())
        self.regularization.step()
        return losses

    def save(self) -> dict[str, Any]:
        return {**super().save(), "regularization_state_dict": self.regularization.state_dict()}

    def load(
        self, loaded_dict: dict[str, Any], load_cfg: dict[str, bool] | None, strict: bool
    ) -> bool:
        """As rsl_rl's; a checkpoint of the plain PPO, or of another regularizer, is a beginning."""
        resumes = super().load(loaded_dict, load_cfg, strict)
        if resumes and "regularization_state_dict" in loaded_dict:
            state = dict(loaded_dict["regularization_state_dict"])
            # The first process has written it: others would draw as that one does.
            if self.is_multi_gpu and self.gpu_global_rank:
                state.pop("generator", None)
            self.regularization.load_state_dict(state)
        return resumes


def _check_groups(names: Iterable[str], taken: Iterable[NestedKey]) -> None:
    first = {key if isinstance(key, str) else key[0] for key in taken}
    if clash := sorted(first.intersection(names)):
        raise ValueError(
            f"the observation groups {clash} have names that batches need for something else: "
            "have the environment give them others."
        )


def _check_final(final: Any, obs: TensorDict) -> None:
    groups = list(obs.keys())
    if missing := [group for group in groups if group not in final.keys()]:
        raise KeyError(
            f"extras[{FINAL!r}] lacks the groups {missing}: let the environment give all that it "
            f"observes, {groups}, or leave {FINAL!r} out."
        )
    for group in groups:
        if final[group].shape != obs[group].shape:
            raise ValueError(
                f"extras[{FINAL!r}] must have the shapes of the observations, all environments' "
                f"rows among them: {group!r} has {tuple(final[group].shape)}, where they have "
                f"{tuple(obs[group].shape)}."
            )


class L2C2PPO(RegularizedPPO):
    r"""rsl_rl's PPO under the locally Lipschitz continuous constraint (Kobayashi, L2C2, 2022).

    A run's configuration names it in the place of PPO, ``"class_name":
    "torchrl_l2c2.rsl_rl:L2C2PPO"``, and may say more under ``"regularizer_cfg"``. To the loss of
    PPO it adds the terms of :class:`~torchrl_l2c2.L2C2Loss`,

    .. math::
        \lambda_\pi\, \mathbb E\left[\frac{d_\pi(\pi(\cdot|s), \pi(\cdot|\tilde s))}
        {d(s, \tilde s; s')}\right]
        + \beta\lambda_\pi\, \mathbb E\left[\frac{d_V(V(s), V(\tilde s))}
        {d(s, \tilde s; s')}\right],

    over the transitions of each minibatch. Neighbors move in all observation groups that the
    regularized networks read, before these normalize them: the mean and scale of a normalization
    change neither the neighbors nor their distances. Where an episode ended, the next observation
    that rsl_rl knows is that after the reset, and the transition is left out of the mean; unless
    the environment gives the episode's own last observations as ``extras["final_obs"]``, a
    TensorDict of all groups, ``[num_envs]``, in steps that end one.

    Neighbors are drawn with a generator of their own, seeded with :func:`torch.initial_seed`: at a
    gain of 0 a training run has the numbers of plain PPO. A symmetry extension goes on working as
    before. What ``update`` returns, and rsl_rl logs, has the terms ``l2c2_actor`` and
    ``l2c2_critic``, as they were added to the loss, and L2C2Loss's diagnostics.

    Args:
        actor (MLPModel): the policy, feed-forward and normal.
        critic (MLPModel): the value function, feed-forward.
        storage (RolloutStorage): as rsl_rl makes it; it is taken over.
        *args: those of rsl_rl's PPO.
        regularizer_cfg (dict, optional): the arguments of :class:`~torchrl_l2c2.Neighborhood` and
            of L2C2Loss, by name, with their defaults; and ``ramp_updates``, the number of updates
            over which ``coeff`` rises from 0 in a line, an integer of at least 1, or ``None``, the
            default, for a constant one. Smaller ones smooth earlier.
        **kwargs: those of rsl_rl's PPO.

    Raises:
        TypeError: a model is recurrent, the policy is not normal, or an argument is unknown or of
            the wrong type.
        ValueError: an argument is out of its range.

    Examples:
        >>> import torch
        >>> from rsl_rl.models import MLPModel
        >>> from rsl_rl.storage import RolloutStorage
        >>> from tensordict import TensorDict
        >>> from torchrl_l2c2.rsl_rl import L2C2PPO
        >>> obs = TensorDict({"policy": torch.randn(8, 3)}, [8])
        >>> names = {"actor": ["policy"], "critic": ["policy"]}
        >>> normal = {"class_name": "GaussianDistribution"}
        >>> actor = MLPModel(obs, names, "actor", 2, distribution_cfg=normal)
        >>> critic = MLPModel(obs, names, "critic", 1)
        >>> storage = RolloutStorage("rl", 8, 4, obs, [2])
        >>> cfg = {"beta": 0.0, "policy_distance": "mean"}
        >>> ppo = L2C2PPO(actor, critic, storage, regularizer_cfg=cfg)
        >>> for _ in range(4):
        ...     _ = ppo.act(obs)
        ...     ppo.process_env_step(obs, torch.ones(8), torch.zeros(8), {})
        >>> ppo.compute_returns(obs)
        >>> list(ppo.update())[3:]
        ['l2c2_actor', 'l2c2_mean_distance', 'l2c2_distance', 'l2c2_gain']
    """

    coefficient = "l2c2_coeff"

    def regularize(
        self, networks: ActorCriticLoss, **options: Any
    ) -> tuple[RegularizedLoss, NeighborTransform]:
        _check_options(options, Neighborhood, L2C2Loss)
        given = {field.name for field in fields(Neighborhood)} & options.keys()
        near = Neighborhood(**{name: options.pop(name) for name in given})
        loss = L2C2Loss(networks, near, **options)
        read = list(networks.actor_network.in_keys)
        if "loss_l2c2_critic" in loss.added_terms:
            read += networks.critic_network.in_keys
        stored = self.storage.observations
        groups = [group for group in dict.fromkeys(read) if stored[group].is_floating_point()]
        _check_groups(stored.keys(), [loss.l2c2_neighbor_key])
        moved = groups if loss.l2c2_moved_keys is None else [*loss.l2c2_moved_keys]
        if not set(moved) <= set(groups):
            raise ValueError(
                f"moved_keys must be among the groups that the networks read, {groups}, got "
                f"{moved}."
            )
        generator = torch.Generator(self.device).manual_seed(torch.initial_seed())
        return loss, NeighborTransform(
            near,
            moved,
            out_key=loss.l2c2_neighbor_key,
            num_samples=loss.l2c2_num_samples,
            generator=generator,
        )


class CATSPPO(RegularizedPPO):
    r"""rsl_rl's PPO with CATS's temporal term (arXiv 2610.07910).

    Named and configured as :class:`L2C2PPO` is. It adds the term of
    :class:`~torchrl_l2c2.CATSLoss`,

    .. math::
        \min\left(1, \frac kK\right) \lambda\,
        \mathbb E\left[\lVert \mu(s) - \mu(s') \rVert_2^2\right],

    in update :math:`k`, over the transitions that an episode's end leaves out as there.

    Args:
        actor (MLPModel): as for L2C2PPO, like all others that are not named here.
        critic (MLPModel): likewise.
        storage (RolloutStorage): likewise.
        *args: likewise.
        regularizer_cfg (dict, optional): ``lambda_temporal``, at least 0, as for CATSLoss: larger
            values slow the actions down; and ``ramp_updates``, :math:`K`, an integer of at least 1.
            The method's own is the number of updates of the whole training, which is known to the
            runner alone; without it the gain is constant.
        **kwargs: likewise.

    Raises:
        TypeError: as for L2C2PPO.
        ValueError: likewise.
    """

    coefficient = "cats_lambda_temporal"

    def regularize(self, networks: ActorCriticLoss, **options: Any) -> tuple[RegularizedLoss, None]:
        _check_options(options, CATSLoss)
        return CATSLoss(networks, **options), None


def _check_options(options: Iterable[str], *takers: Callable[..., Any]) -> None:
    allowed = {name for taker in takers for name in signature(taker).parameters}
    allowed = allowed - {"base_loss", "neighborhood"} | {"ramp_updates"}
    if unknown := sorted(set(options) - allowed):
        raise TypeError(f"regularizer_cfg has {unknown}; it may have {sorted(allowed)}.")
