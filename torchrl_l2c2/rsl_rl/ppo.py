"""rsl_rl's PPO with a regularizer of this package."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from inspect import signature
from typing import Any, ClassVar

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.env import VecEnv
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from torchrl_l2c2 import objectives
from torchrl_l2c2._checks import check_choice, check_positive_int
from torchrl_l2c2.objectives import L2C2Loss, RegularizedLoss
from torchrl_l2c2.presets import METHODS, NEIGHBORHOOD_FIELDS, preset
from torchrl_l2c2.rsl_rl.networks import ENTRIES, ActorCriticLoss, state_keys
from torchrl_l2c2.rsl_rl.regularization import Regularization
from torchrl_l2c2.rsl_rl.storage import ROW, SuccessorStorage
from torchrl_l2c2.smoothing import smooth
from torchrl_l2c2.transforms import NeighborTransform

FINAL = "final_obs"
"""Key of an environment's extras with the last observations of ended episodes."""

PREVIOUS = ("grad_caps", "asap")
"""Methods that need the previous observation, which rsl_rl's rollouts lack."""

COMPARING_NEXT = ("cats", "caps")
"""Methods that evaluate the policy at the next observation."""


class RegularizedPPO(PPO):
    """rsl_rl's PPO with a regularizer: :class:`L2C2PPO`, :class:`CATSPPO` or another method.

    To use it, set ``"class_name": "torchrl_l2c2.rsl_rl:RegularizedPPO"`` in the algorithm's
    configuration. The preset is the same as with TorchRL's PPO (:func:`~torchrl_l2c2.smooth`). The
    settings are printed in one line.

    Args:
        actor (MLPModel): the policy, a normal distribution; feed-forward, or an ``RNNModel``.
        critic (MLPModel): the value function; feed-forward, or an ``RNNModel``.
        storage (RolloutStorage): the storage that rsl_rl has made; its buffers are taken over.
        *args: arguments of rsl_rl's PPO.
        regularizer_cfg (dict, optional): settings of the regularizer. ``method`` is a method of
            :func:`~torchrl_l2c2.smooth` except ``"grad_caps"`` and ``"asap"`` (default:
            ``"l2c2"``). ``strength`` multiplies the penalty (default: 1). ``ramp_updates`` is the
            number of updates over which the gain rises from 0, at least 1, or ``None`` for a
            constant gain (default: ``max_iterations`` if the preset has a ramp); smaller numbers
            smooth earlier. Other entries override the preset, as in ``smooth``.
        max_iterations (int, optional): number of updates in the whole training. In Isaac Lab and
            mjlab the runner's configuration sets it. With ``None`` the gain is constant unless
            ``ramp_updates`` is given.
        **kwargs: arguments of rsl_rl's PPO.

    Raises:
        TypeError: a model is recurrent in another way than rsl_rl's, the policy is not normal, the
            method does not work with a recurrent actor, or an argument is unknown or of the wrong
            type.
        ValueError: an argument is out of its range, or the method is unknown or does not work with
            rsl_rl.
    """

    method: ClassVar[str | None] = None
    """The method of a subclass that has only one."""

    storage: SuccessorStorage
    symmetry: Any

    def __init__(
        self,
        actor: MLPModel,
        critic: MLPModel,
        storage: RolloutStorage,
        *args: Any,
        regularizer_cfg: dict[str, Any] | None = None,
        max_iterations: int | None = None,
        **kwargs: Any,
    ) -> None:
        if not isinstance(regularizer_cfg, Mapping | None):
            raise TypeError(
                "Expected regularizer_cfg to be a dict of settings, such as {'strength': 2.0}, got "
                f"{regularizer_cfg!r}."
            )
        known = signature(PPO.__init__).parameters.keys()
        for unknown in kwargs.keys() - known:
            advice = f"It has {sorted(known - {'self'})}."
            if unknown in _allowed_options((regularizer_cfg or {}).get("method", self.method)):
                place = {"regularizer_cfg": {unknown: kwargs[unknown]}}
                advice = f"It is a setting of the regularizer: write {place}."
            elif near := get_close_matches(unknown, known, 1):
                advice = f"Did you mean {near[0]!r}?"
            raise TypeError(f"{unknown!r} is no argument of rsl_rl's PPO. {advice}")
        networks = ActorCriticLoss(actor, critic)
        states = (*state_keys(actor, "actor"), *state_keys(critic, "critic"))
        _check_groups(storage.observations.keys(), (*ENTRIES, *states, ROW, "next"))
        super().__init__(actor, critic, SuccessorStorage(storage), *args, **kwargs)
        if max_iterations is not None:
            check_positive_int("max_iterations", max_iterations)
        overrides = dict(regularizer_cfg or {})
        method = overrides.pop("method", self.method or "l2c2")
        _check_method(method, type(self))
        _check_options(method, overrides)
        strength = overrides.pop("strength", 1.0)
        chosen = preset(method, "ppo").overridden(
            {name: value for name, value in overrides.items() if name != "ramp_updates"}
        )
        hint = chosen.ramp is not None and "ramp_updates" not in overrides
        ramp_updates = overrides.pop("ramp_updates", chosen.ramp and max_iterations)
        loss = smooth(networks, method, strength, fold=False, **overrides, ramp=None)
        if actor.is_recurrent and method in COMPARING_NEXT:
            raise TypeError(
                f"{method} compares the action with the next one, and rsl_rl's rollouts lack the "
                "recurrent state of the next step. Choose l2c2, lcp or sr2l for a recurrent actor."
            )
        self.storage.groups = list(_groups(loss))
        self.symmetry = self.regularization = Regularization(
            loss.to(self.device), self._neighbors(loss), method, ramp_updates, self.symmetry
        )
        if not self.gpu_global_rank:
            settings = {"method": method, **chosen.settings, "strength": strength}
            name, given = type(self).__name__, bool(regularizer_cfg)
            print(_settings_line(name, settings, ramp_updates, hint, given))

    @staticmethod
    def construct_algorithm(obs: TensorDict, env: VecEnv, cfg: dict[str, Any], device: str) -> PPO:
        """Constructs the algorithm as rsl_rl does, and passes it the runner's max_iterations."""
        if "regularizer_cfg" in cfg:
            raise ValueError(
                "Expected regularizer_cfg in the algorithm's configuration, got it next to that, "
                "where it has no effect. Move it next to class_name."
            )
        if "actor" not in cfg:
            raise ValueError(
                f"Expected the configuration of an actor and a critic, got {sorted(cfg)}. Train "
                "with OnPolicyRunner; a DistillationRunner takes a teacher that was trained with "
                "this class, and rsl_rl's own Distillation as its algorithm."
            )
        # In place: rsl_rl 5.4 writes entries into it, which its runner reads.
        cfg["algorithm"].setdefault("max_iterations", cfg.get("max_iterations"))
        algorithm = PPO.construct_algorithm(obs, env, cfg, device)
        del cfg["algorithm"]["max_iterations"]
        return algorithm

    def _neighbors(self, loss: RegularizedLoss) -> NeighborTransform | None:
        """Makes the transform for L2C2's neighbors, in all observation groups of its networks."""
        if not isinstance(loss, L2C2Loss):
            return None
        stored = self.storage.observations
        _check_groups(stored.keys(), [loss.l2c2_neighbor_key])
        groups = [group for group in _groups(loss) if stored[group].is_floating_point()]
        if not groups:
            raise TypeError(
                f"Expected an observation group of floating-point numbers among {[*_groups(loss)]},"
                " which the regularized networks read. Neighbors move in these; integers stay."
            )
        generator = torch.Generator(self.device).manual_seed(torch.initial_seed())
        return loss.neighbor_transform(generator, loss.l2c2_moved_keys or groups)

    def process_env_step(
        self, obs: TensorDict, rewards: Tensor, dones: Tensor, extras: dict[str, Any]
    ) -> None:
        final = extras.get(FINAL)
        if final is not None:
            _check_final(final, obs, self.storage.groups)
        super().process_env_step(obs, rewards, dones, extras)
        if final is not None:
            final = {group: final[group] for group in self.storage.groups}
            final = TensorDict(final, [self.storage.num_envs], device=self.device)
            self.storage.add_final(final, dones)

    def compute_returns(self, obs: TensorDict) -> None:
        super().compute_returns(obs)
        self.storage.add_last(obs)

    def update(self) -> dict[str, float]:
        """Updates as rsl_rl does, and adds the regularizer's terms to the returned losses."""
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
        """Loads a checkpoint, also of rsl_rl's PPO or of a run with another regularizer."""
        resumes = super().load(loaded_dict, load_cfg, strict)
        if resumes and "regularization_state_dict" in loaded_dict:
            state = dict(loaded_dict["regularization_state_dict"])
            # The first process wrote it: the other processes would draw the same numbers.
            if self.is_multi_gpu and self.gpu_global_rank:
                state.pop("generator", None)
            self.regularization.load_state_dict(state)
        return resumes


def _check_groups(names: Iterable[str], taken: Iterable[NestedKey]) -> None:
    first = {key if isinstance(key, str) else key[0] for key in taken}
    if clash := sorted(first.intersection(names)):
        raise ValueError(
            f"Expected observation groups with names that batches do not use, got {clash}. Rename "
            "these groups in the environment."
        )


def _groups(loss: RegularizedLoss) -> dict[str, None]:
    """The observation groups that the regularized networks read."""
    return dict.fromkeys(group for spec in loss.networks.values() for group in spec.states)


def _check_final(final: Any, obs: TensorDict, groups: Iterable[str]) -> None:
    if not isinstance(final, Mapping | TensorDictBase):
        raise TypeError(
            f"Expected extras[{FINAL!r}] to be a TensorDict of observation groups, [num_envs], got "
            f"a {type(final).__name__}. Convert it in the environment, or leave {FINAL!r} out."
        )
    groups = list(groups)
    if missing := [group for group in groups if group not in final.keys()]:
        raise KeyError(
            f"Expected the observation groups {groups} in extras[{FINAL!r}], got none of "
            f"{missing}. Add these groups in the environment, or leave {FINAL!r} out."
        )
    for group in groups:
        if final[group].shape != obs[group].shape:
            raise ValueError(
                f"Expected extras[{FINAL!r}][{group!r}] with the shape of the observations, "
                f"{tuple(obs[group].shape)}, got {tuple(final[group].shape)}. Include the rows of "
                "all environments."
            )


class L2C2PPO(RegularizedPPO):
    r"""rsl_rl's PPO with the locally Lipschitz continuous constraint (Kobayashi, L2C2, 2022).

    To use it, set ``"class_name": "torchrl_l2c2.rsl_rl:L2C2PPO"`` in the algorithm's configuration,
    with settings in ``"regularizer_cfg"``. It adds the terms of :class:`~torchrl_l2c2.L2C2Loss` to
    PPO's loss:

    .. math::
        \lambda_\pi\, \mathbb E\left[\frac{d_\pi(\pi(\cdot|s), \pi(\cdot|\tilde s))}
        {d(s, \tilde s; s')}\right]
        + \beta\lambda_\pi\, \mathbb E\left[\frac{d_V(V(s), V(\tilde s))}
        {d(s, \tilde s; s')}\right],

    over the transitions of each minibatch, with the preset of :func:`~torchrl_l2c2.smooth` for PPO:
    the distance of the means, and no value term. Neighbors move in all observation groups that the
    regularized networks read, before the networks normalize them: the normalization does not change
    the neighbors or their distances.

    When an episode ends, rsl_rl stores the observation after the reset, so these transitions are
    left out of the mean. They count if the environment writes the last observations of ended
    episodes to ``extras["final_obs"]``, a TensorDict of these groups, ``[num_envs]``.

    Neighbors have their own generator, seeded with :func:`torch.initial_seed`: at a gain of 0 a
    training run has the same random numbers as with rsl_rl's PPO. A symmetry extension works as
    before. rsl_rl logs the terms ``l2c2_actor`` and, unless ``beta`` is 0, ``l2c2_critic``, and the
    diagnostics of L2C2Loss.

    Takes the arguments of :class:`RegularizedPPO`. ``regularizer_cfg`` accepts the arguments of
    :class:`~torchrl_l2c2.Neighborhood` and of L2C2Loss (but ``neighborhood`` and ``skip_ends``),
    ``strength`` and ``ramp_updates``.

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
        >>> cfg = {"ramp_updates": 1500}
        >>> ppo = L2C2PPO(actor, critic, storage, regularizer_cfg=cfg)  # doctest: +ELLIPSIS
        L2C2PPO: method='l2c2', policy_distance='mse', ... The gain rises over 1500 updates.
        >>> for _ in range(4):
        ...     _ = ppo.act(obs)
        ...     ppo.process_env_step(obs, torch.ones(8), torch.zeros(8), {})
        >>> ppo.compute_returns(obs)
        >>> list(ppo.update())[3:]
        ['l2c2_actor', 'l2c2_mse', 'l2c2_distance', 'l2c2_gain', 'l2c2_counted']
    """

    method = "l2c2"


class CATSPPO(RegularizedPPO):
    r"""rsl_rl's PPO with CATS's temporal term (arXiv 2610.07910).

    It is named and configured like :class:`L2C2PPO`, and adds the term of
    :class:`~torchrl_l2c2.CATSLoss`:

    .. math::
        \min\left(1, \frac kK\right) \lambda\,
        \mathbb E\left[\lVert \mu(s) - \mu(s') \rVert_2^2\right],

    in update :math:`k`, with :math:`K` = ``ramp_updates``. Transitions that end an episode are
    treated as in :class:`L2C2PPO`.

    Takes the arguments of :class:`RegularizedPPO`. ``regularizer_cfg`` accepts the arguments of
    CATSLoss (but ``skip_ends``), ``strength`` and ``ramp_updates``.
    """

    method = "cats"


def _check_method(method: str, algorithm: type[RegularizedPPO]) -> None:
    possible = [name for name in METHODS if name not in PREVIOUS]
    if isinstance(method, str) and method in PREVIOUS:
        raise ValueError(
            f"Expected method to be one of {possible}, got {method!r}, which needs the observation "
            "before each state. Rollouts of rsl_rl lack it."
        )
    check_choice("method", method, possible)
    if algorithm.method not in (None, method):
        raise ValueError(
            f"Expected the method {algorithm.method!r} of {algorithm.__name__}, got {method!r}. "
            "Use the class name torchrl_l2c2.rsl_rl:RegularizedPPO."
        )


def _allowed_options(method: str | None) -> set[str]:
    """Names of the entries of ``regularizer_cfg``; for an unknown method, the entries of L2C2."""
    allowed = set(signature(getattr(objectives, METHODS.get(method or "", "L2C2Loss"))).parameters)
    if "neighborhood" in allowed:
        allowed |= NEIGHBORHOOD_FIELDS
    # Transitions that end an episode are always left out.
    allowed -= {"base_loss", "neighborhood", "skip_ends"}
    return allowed | {"method", "strength", "ramp_updates"}


def _check_options(method: str, options: Iterable[str]) -> None:
    allowed = _allowed_options(method)
    if unknown := sorted(set(options) - allowed):
        near = get_close_matches(unknown[0], allowed, 1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise TypeError(
            f"Expected settings of {method} in regularizer_cfg, {sorted(allowed)}, got "
            f"{unknown}.{hint}"
        )


def _settings_line(
    name: str, settings: Mapping[str, Any], ramp_updates: int | None, hint: bool, given: bool
) -> str:
    """The line with the settings in use."""
    line = f"{name}: " + ", ".join(f"{key}={value!r}" for key, value in settings.items())
    line += "." if given else " (the preset: there is no regularizer_cfg)."
    if ramp_updates is not None:
        return f"{line} The gain rises over {ramp_updates} updates."
    line += " The gain is constant"
    if hint:
        line += (
            "; for the preset's ramp, set ramp_updates in regularizer_cfg to the number of the "
            "runner's iterations (max_iterations)"
        )
    return f"{line}."
