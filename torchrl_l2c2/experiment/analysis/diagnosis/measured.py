"""Measurements of a policy: its test episodes, and its local Lipschitz constants there."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import EnvBase, ExplorationType, GymWrapper, set_exploration_type

from torchrl_l2c2._checks import check_positive_int, check_real
from torchrl_l2c2.experiment.envs.environments import untransformed
from torchrl_l2c2.experiment.envs.frames import check_finite
from torchrl_l2c2.experiment.envs.pictures import control_rate
from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.run.evaluation import LEAST_STEPS, measure, observation_key
from torchrl_l2c2.metrics import (
    action_variation,
    change_with_held_input,
    local_lipschitz,
    noise_sensitivity,
)
from torchrl_l2c2.neighborhood import Neighborhood

Value = Callable[[Tensor, Tensor], Tensor]
"""Observations ``[N, *F]`` and actions ``[N, *A]`` to values, ``[N]`` or of several heads."""

UNKNOWN = torch.empty(0)
FEWEST_STEPS = 20  # that show how an action shakes
LOCKED = 1e-3  # of the largest span: smallest span that an action's change is relative to
SAMPLES = 16  # actions drawn at a state to see how far they spread
SAMPLED_STATES = 256
SAME_PLACE = 0.25  # of the standard deviation of every coordinate within the episode
MOST_INPUTS = 512  # that are held, and get noise, one at a time: more would be pixels
STEPS_AT_ONCE = 128  # whose neighbors are in memory together: they may be images


@dataclass(frozen=True)
class TermShare:
    """Share of a loss that one of its terms has; NaN if it is unknown.

    Attributes:
        added: whether a regularizer added the term.
        size: size divided by the sum of all terms' sizes, late in training.
        gradient: norm of its gradient, divided by the norm of the gradient of the loss's own terms.
    """

    added: bool
    size: float = math.nan
    gradient: float = math.nan


@dataclass(frozen=True)
class Diagnosis:
    """Measurements of a policy, or of recorded actions, for findings and pictures.

    Of recorded actions, all from ``observations`` on is unknown: empty, NaN or the default.

    Attributes:
        name: name of the policy.
        measures: means over the episodes: return, length, action variation, and the other measures
            of :func:`~torchrl_l2c2.experiment.evaluate_policy`. A recording has no return.
        actions: mean actions of the first episode, ``[T, A]``.
        low: lower bounds of the actions, ``[A]``; without bounds, the smallest actions, but for
            one in 200.
        high: upper bounds of the actions, ``[A]``; without bounds, the largest actions, but for one
            in 200.
        bounded: whether the task has these bounds.
        action_names: names of the actions; empty for ``action[0]`` and so on.
        rate: actions per second, or ``None``.
        observations: observations of the first episode, ``[T, F]``.
        policy_lipschitz: local Lipschitz constants of the mean action there, ``[T]``; NaN where
            the observation does not move.
        value_lipschitz: local Lipschitz constants of the value function, or ``None``.
        distance: distances of the neighbors, the largest :math:`|u_i|`, ``[T * K]``.
        neighborhood: neighborhood that the neighbors were drawn from.
        unmoved: share of the steps in which a coordinate does not change at all, ``[F]``.
        held: root mean square change of the actions' relative positions per step if one coordinate
            keeps its value of the step before, relative to the change as it is, ``[F]``; empty for
            more than 512 coordinates.
        noise_scale: standard deviation of the noise on observations, of all coordinates or of each,
            ``[*F]``.
        noise_action: root mean square change of the action by this noise.
        noise_share: mean squared change of the actions' relative positions per step that this noise
            causes, divided by the whole mean squared change.
        noise_inputs: share of each coordinate in this squared change, if only it has noise,
            ``[F]``; the shares have the sum 1; empty for more than 512 coordinates.
        spread: standard deviation of the policy's samples, clipped into their bounds, relative to
            half the actions' range; 0 for a deterministic policy, NaN for discrete actions.
        shares: shares of the loss's terms.
        entries: names of the observation's coordinates.
        pictures: pictures ``[H, W, 3]`` of the first episode, from the reset on; may be empty.
        picture_every: steps from one picture to the next.
        task: id of the task, or empty.
    """

    name: str
    measures: dict[str, float]
    actions: Tensor
    low: Tensor
    high: Tensor
    bounded: bool
    action_names: Sequence[str] = ()
    rate: float | None = None
    observations: Tensor = UNKNOWN
    policy_lipschitz: Tensor = UNKNOWN
    value_lipschitz: Tensor | None = None
    distance: Tensor = UNKNOWN
    neighborhood: Neighborhood = field(default_factory=Neighborhood)
    unmoved: Tensor = UNKNOWN
    held: Tensor = UNKNOWN
    noise_scale: float | Tensor = math.nan
    noise_action: float = math.nan
    noise_share: float = math.nan
    noise_inputs: Tensor = UNKNOWN
    spread: float = math.nan
    shares: Mapping[str, TermShare] = field(default_factory=dict)
    entries: Sequence[str] = ()
    pictures: Sequence[Any] = ()
    picture_every: int = 1
    task: str = ""

    @property
    def is_recording(self) -> bool:
        """Checks whether only the actions are known."""
        return not len(self.observations)

    def action_name(self, number: int) -> str:
        """The name of an action."""
        return self.action_names[number] if self.action_names else f"action[{number}]"

    @property
    def range(self) -> Tensor:
        """Width of the actions' range, ``[A]``; never 0, and without bounds not much less than the
        largest: an action that only rounding or noise moves is still.
        """
        width = self.high - self.low
        least = 0.0 if self.bounded else LOCKED * float(width.max())
        return width.clamp_min(max(least, torch.finfo(width.dtype).eps))

    @property
    def relative(self) -> Tensor:
        """The actions ``[T, A]`` with their range as the unit, without bounds clipped into it."""
        relative = (self.actions - self.low) / self.range
        return relative if self.bounded else relative.clamp(0.0, 1.0)

    @property
    def gain(self) -> Tensor:
        """The gain that L2C2 applies at the distances, ``[T * K]``."""
        return self.neighborhood.gain(self.distance + self.neighborhood.epsilon)

    def worst(self, number: int = 5) -> list[int]:
        """Steps with the largest local Lipschitz constants of the policy, the worst first.

        Steps that are within a fiftieth of the episode, or within ``SAME_PLACE``, count once.
        """
        left = self.policy_lipschitz.nan_to_num(-math.inf).clone()
        left[left <= 0.0] = -math.inf
        found: list[int] = []
        if self.is_recording:
            return found
        apart = max(1, len(left) // 50)
        while len(found) < number and left.max() > -math.inf:
            step = int(left.argmax())
            found.append(step)
            left[max(0, step - apart + 1) : step + apart] = -math.inf
            away = (self.observations - self.observations[step]).abs()
            left[(away <= SAME_PLACE * self.observations.std(0)).all(1)] = -math.inf
        return found


@torch.no_grad()
def diagnose(
    policy: TensorDictModule,
    env: EnvBase,
    *,
    name: str = "policy",
    episodes: int = 3,
    max_steps: int = 1000,
    neighborhood: Neighborhood | None = None,
    num_neighbors: int = 16,
    value: Value | None = None,
    noise_scale: float | Tensor = 0.01,
    seed: int = 0,
    action_names: Sequence[str] = (),
    observation_names: Sequence[str] = (),
) -> Diagnosis:
    """Plays test episodes with any TorchRL actor, and measures how and why it shakes.

    Args:
        policy (TensorDictModule): reads one observation and writes the action, its mean under
            ``ExplorationType.DETERMINISTIC`` and a sample under ``RANDOM``.
        env (EnvBase): a single environment, already seeded.

    Keyword Args:
        name (str): name of the policy, for comparisons. Default ``"policy"``.
        episodes (int): number of episodes, at least 1. The measures are means over episodes; all
            other results are from the first episode, and a finding says if it is unlike the mean.
            Default 3.
        max_steps (int): longest episode. Default 1000.
        neighborhood (Neighborhood, optional): region of the local Lipschitz constants. Default:
            ``Neighborhood()``.
        num_neighbors (int): neighbors per state, at least 1; more find steeper places. Default 16.
        value (callable, optional): observations ``[N, *F]`` and actions ``[N, *A]`` to values, to
            measure the value function, too. Default: none.
        noise_scale (float or Tensor): standard deviation of the noise on observations, greater
            than 0. A tensor ``[*F]`` has one for each coordinate, as sensors differ; some of them
            may be 0. Default 0.01.
        seed (int): random seed of neighbors, noise and samples. Default 0.
        action_names (sequence of str): name of each action, for the findings. Default:
            ``action[0]`` and so on.
        observation_names (sequence of str): name of each coordinate of the observation. Default:
            ``observation[0]`` and so on.

    Returns:
        Diagnosis: The input of :func:`~.words.findings` and :func:`~.page.write_page`.

    Raises:
        TypeError: the environment is not an environment of TorchRL.
        ValueError: the environment is a batch of several, the policy reads more than one of its
            observations, an episode is shorter than four steps, there are more or fewer names
            than actions or coordinates, or ``noise_scale`` is out of its range.
        FloatingPointError: an observation, an action or a reward is not finite.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> from torchrl_l2c2 import make_actor
        >>> env = GymEnv("Pendulum-v1", max_episode_steps=20)
        >>> found = diagnose(make_actor(3, env.action_spec), env, episodes=1)
        >>> found.actions.shape, found.policy_lipschitz.shape, found.rate
        (torch.Size([20, 1]), torch.Size([20]), 20.0)
    """
    check_positive_int("episodes", episodes)
    if not isinstance(noise_scale, Tensor):
        check_real("noise_scale", noise_scale, above=0)
    key = observation_key(policy, env)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        played = [env.rollout(max_steps, policy).detach() for _ in range(episodes)]
    lengths = [len(episode) for episode in played]
    if min(lengths) < LEAST_STEPS:
        raise UserError(
            f"an episode of {min(lengths)} steps is too short to be diagnosed: it needs "
            f"{LEAST_STEPS}. Give a larger max_steps, or a policy that lasts longer."
        )
    for episode in played:
        check_finite(episode, 0, test=True, observation=key, action=env.action_key)
    first = played[0]
    actions = _flat(first[env.action_key])
    coordinates = _flat(first[key]).shape[1]
    check_names("action_names", action_names, actions.shape[1], "actions")
    check_names("observation_names", observation_names, coordinates, "coordinates")
    low, high, bounded = bounds_of(env.action_spec, actions)
    generator = torch.Generator().manual_seed(seed)

    def act(observation: Tensor) -> Tensor:
        return _act(policy, observation, key, env.action_key)

    near = Neighborhood() if neighborhood is None else neighborhood
    steepness = _steepness(first, key, env.action_key, act, value, near, num_neighbors, generator)
    states, successors = first[key], first["next", key]
    width = (high - low).clamp_min(torch.finfo(low.dtype).eps)

    def relative(observation: Tensor) -> Tensor:  # Actions may have different units.
        return act(observation) / width

    before = generator.get_state()
    sensitivity = noise_sensitivity(act, states, noise_scale, generator=generator).item()
    generator.set_state(before)
    passed_on = noise_sensitivity(relative, states, noise_scale, generator=generator).item()
    change = (actions.diff(dim=0) / width).square().sum(-1).mean().item()
    held, noise_inputs = UNKNOWN, UNKNOWN
    if coordinates <= MOST_INPUTS:
        held = change_with_held_input(relative, states, successors).flatten()
        noise_inputs = _noise_by_input(relative, states, noise_scale, generator)
    return Diagnosis(
        name=name,
        measures=_means(played, env),
        actions=actions,
        low=low,
        high=high,
        bounded=bounded,
        action_names=tuple(action_names),
        observations=_flat(states),
        **steepness,
        neighborhood=near,
        unmoved=(_flat(states) == _flat(successors)).float().mean(0),
        held=held,
        noise_scale=noise_scale,
        noise_action=math.sqrt(2 * sensitivity),
        # Two independent draws differ by twice the variance of one.
        noise_share=4 * passed_on / change if change else 0.0,
        noise_inputs=noise_inputs,
        spread=_spread(policy, states, key, env, low, high, seed),
        rate=control_rate(env) if isinstance(untransformed(env), GymWrapper) else None,
        entries=list(observation_names) or [f"{key}[{i}]" for i in range(coordinates)],
    )


def _noise_by_input(
    act: Callable[[Tensor], Tensor],
    states: Tensor,
    scale: float | Tensor,
    generator: torch.Generator,
) -> Tensor:
    """Shares of the coordinates ``[F]`` in the sensitivity to noise."""
    one_each = torch.eye(states[0].numel(), device=states.device)
    alone = scale * one_each.view(-1, *states.shape[1:])
    each = [noise_sensitivity(act, states, one, generator=generator) for one in alone]
    found = torch.stack(each)
    return found / found.sum()


def check_names(argument: str, names: Sequence[str], count: int, of: str) -> None:
    """Checks that there are no names, or as many as there are actions or coordinates."""
    if names and len(names) != count:
        raise UserError(
            f"{argument} must have a name for each of the {count} {of}, got {len(names)} names."
        )


def _act(
    policy: TensorDictModule, observation: Tensor, key: NestedKey, action_key: NestedKey
) -> Tensor:
    """Mean actions ``[N, A]`` at observations ``[N, *F]``."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rows = TensorDict({key: observation}, observation.shape[:1])
        return _flat(policy(rows)[action_key])


def _steepness(
    episode: TensorDictBase,
    key: NestedKey,
    action_key: NestedKey,
    act: Callable[[Tensor], Tensor],
    value: Value | None,
    near: Neighborhood,
    num_neighbors: int,
    generator: torch.Generator,
) -> dict[str, Any]:
    """Distances, and local Lipschitz constants along an episode, some steps at a time."""
    found: dict[str, list[Tensor]] = {"policy": [], "value": [], "distance": []}
    for part in episode.split(STEPS_AT_ONCE):
        state, successor, action = part[key], part["next", key], part[action_key]
        if not state.is_floating_point():
            state, successor = state.float(), successor.float()
        neighbor, distance = near.sample(state, successor, num_neighbors, generator)
        rows = neighbor.flatten(0, 1)
        places = state.flatten(1), neighbor.flatten(2)
        found["distance"].append((distance - near.epsilon).flatten())
        found["policy"].append(_constants(places, act(state), act(rows)))
        if value is not None:
            repeated = action.repeat_interleave(num_neighbors, 0)
            here, there = value(state, action), value(rows, repeated)
            found["value"].append(_constants(places, here, there))
    return {
        "policy_lipschitz": torch.cat(found["policy"]),
        "value_lipschitz": torch.cat(found["value"]) if value is not None else None,
        "distance": torch.cat(found["distance"]),
    }


def _constants(places: tuple[Tensor, Tensor], here: Tensor, there: Tensor) -> Tensor:
    """Local Lipschitz constants from a function's values at states and at their neighbors."""
    rows = _flat(there).unflatten(0, places[1].shape[:2])
    return local_lipschitz(places[0].cpu(), places[1].cpu(), _flat(here), rows)


def _means(played: Sequence[TensorDictBase], env: EnvBase) -> dict[str, float]:
    each: list[dict[str, float]] = []
    for episode in played:
        actions = _flat(episode[env.action_key])
        each.append(
            {
                "return": episode["next", "reward"].sum().item(),
                "length": float(len(episode)),
                "action_variation": action_variation(actions).item(),
                **measure(actions, env.action_spec),
            }
        )
    return {name: statistics.fmean(one[name] for one in each) for name in each[0]}


def bounds_of(spec: TensorSpec, actions: Tensor) -> tuple[Tensor, Tensor, bool]:
    """Bounds of the task, or else of the actions, but for one in 200 at either end."""
    if isinstance(spec, Bounded) and spec.dtype.is_floating_point:
        low, high = (bound.flatten().float().cpu() for bound in (spec.space.low, spec.space.high))
        if low.isfinite().all() and high.isfinite().all():
            return low, high, True
    odd = len(actions) // 200  # such as a spike of a sensor
    low, high = (actions.kthvalue(k, 0).values for k in (1 + odd, len(actions) - odd))
    return low, high, False


def _spread(
    policy: TensorDictModule,
    states: Tensor,
    key: NestedKey,
    env: EnvBase,
    low: Tensor,
    high: Tensor,
    seed: int,
) -> float:
    if not env.action_spec.dtype.is_floating_point:
        return math.nan
    apart = -(-len(states) // SAMPLED_STATES)
    rows = states[::apart].repeat_interleave(SAMPLES, 0)
    with torch.random.fork_rng(devices=[]), set_exploration_type(ExplorationType.RANDOM):
        torch.manual_seed(seed)
        drawn = policy(TensorDict({key: rows}, rows.shape[:1]))[env.action_key]
    # Some policies leave it to the task to clip them.
    drawn = _flat(env.action_spec.project(drawn))
    half = ((high - low) / 2).clamp_min(torch.finfo(low.dtype).eps)
    deviation = (drawn / half).unflatten(0, (-1, SAMPLES)).std(1)
    return float(deviation.square().mean().sqrt())


def _flat(tensor: Tensor) -> Tensor:
    """One row for every step."""
    return tensor.reshape(len(tensor), -1).float().cpu()
