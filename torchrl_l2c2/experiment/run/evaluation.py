"""Test episodes of a policy, and the smoothness of its actions."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type
from torchrl.objectives import LossModule
from tqdm import tqdm

from torchrl_l2c2.experiment.collect.episodes import EpisodeCollector, play_episodes
from torchrl_l2c2.experiment.envs.environments import (
    TEST_SEED,
    make_env,
    simulator_errors,
    time_limit,
)
from torchrl_l2c2.experiment.envs.frames import check_finite
from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.run.process import ProcessState
from torchrl_l2c2.experiment.settings.tasks import TaskConfig
from torchrl_l2c2.metrics import (
    action_fluctuation_ratio,
    action_jerk,
    action_rate,
    action_variation,
    noise_sensitivity,
    previous_action_gain,
    roughness,
    saturation,
    spectral_smoothness,
)

# Additional measures of the smoothness of actions [T, A].
ACTION_MEASURES: dict[str, Callable[[Tensor], Tensor]] = {
    "action_rate": action_rate,
    "action_fluctuation_ratio": action_fluctuation_ratio,
    "action_jerk": action_jerk,
    "roughness": roughness,
    "sm_caps": spectral_smoothness,
    "sm_asap": partial(spectral_smoothness, form="asap"),
    "previous_action_gain": previous_action_gain,
}
# Columns of metrics.csv for the test episodes of LateTests.
TEST_COLUMNS = ("test_return", "test_action_variation")
LEAST_STEPS = 4  # Minimum length of an episode for all these measures.
NOISE = 0.01  # Standard deviation for noise_sensitivity, as in the paper's tasks.


@dataclass(frozen=True)
class Evaluation:
    """Results of test episodes. All lists have one entry per episode.

    Attributes:
        returns: Sums of rewards. Larger is better.
        action_variations: Mean L2 norm of the change of the mean action per step, the paper's "L2
            norm of temporal actions". Smaller is smoother. 0 for an episode of one step.
        lengths: Numbers of steps.
        measures: Other measures of the mean actions (``torchrl_l2c2.metrics``) by name, including
            ``saturation`` for bounded actions and ``noise_sensitivity`` (noise of 0.01) for
            continuous actions. With sampled actions, ``sampled_*`` are the measures of the samples.
            NaN if an episode is too short.
    """

    returns: list[float]
    action_variations: list[float]
    lengths: list[int]
    measures: dict[str, list[float]] = field(default_factory=dict)

    def summary(self) -> dict[str, float | int]:
        """Returns means and standard deviations over the episodes.

        The mean of a measure is over the episodes that are long enough for it, or else NaN.
        """
        return {
            "episodes": len(self.returns),
            "return_mean": statistics.fmean(self.returns),
            "return_std": statistics.pstdev(self.returns),
            "action_variation_mean": statistics.fmean(self.action_variations),
            "action_variation_std": statistics.pstdev(self.action_variations),
            **{f"{name}_mean": _known_mean(each) for name, each in self.measures.items()},
        }

    def to_dict(self) -> dict[str, Any]:
        """Returns the summary and all episodes, as in ``evaluation.json``."""
        return {"summary": self.summary(), "episodes": asdict(self)}


def evaluate_policy(
    policy: TensorDictModule,
    env: EnvBase,
    episodes: int,
    *,
    max_steps: int = 1000,
    sampled: bool = False,
    compile_policy: bool = False,
    progress: bool = False,
) -> Evaluation:
    """Plays test episodes and measures returns and the smoothness of actions.

    Args:
        policy (TensorDictModule): Policy that is deterministic under
            ``ExplorationType.DETERMINISTIC``, for single observations and for batches. It reads one
            observation.
        env (EnvBase): A single environment. One of Gymnasium, as for :class:`EpisodeCollector`, is
            faster.
        episodes (int): Number of episodes, at least 1. More episodes give a more precise mean.

    Keyword Args:
        max_steps (int): Maximum steps per episode. Default 1000.
        sampled (bool): Whether the policy samples actions, as in training. The action variation is
            still measured on the mean actions at the visited states. Default ``False``: mean
            actions.
        compile_policy (bool): Whether to compile the policy. Default ``False``.
        progress (bool): Whether to show a progress bar. Default ``False``.

    Returns:
        Evaluation: Results of all episodes.

    Raises:
        FloatingPointError: If the environment or the policy returns NaN or infinity; states the
            key and the frame.
        SimulatorError: If the environment or the policy raises an error; states the episode.
        TypeError: If the policy is no actor of TorchRL, or the environment is not one of TorchRL.
        ValueError: If ``episodes`` is below 1, the environment is a batch of several, or the policy
            reads several entries, or an entry that the environment lacks.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> from torchrl_l2c2 import make_actor
        >>> env = GymEnv("Pendulum-v1", max_episode_steps=5)
        >>> result = evaluate_policy(make_actor(3, env.action_spec), env, 2)
        >>> result.lengths
        [5, 5]
    """
    if episodes < 1:
        raise UserError(f"episodes must be at least 1, got {episodes}.")
    key, action_key = observation_key(policy, env), env.action_key
    returns: list[float] = []
    variations: list[float] = []
    lengths: list[int] = []
    measures: dict[str, list[float]] = {}
    bar = tqdm(
        play_episodes(
            policy,
            env,
            episodes,
            max_steps=max_steps,
            sampled=sampled,
            compile_policy=compile_policy,
        ),
        "test, sampled" if sampled else "test",
        episodes,
        unit="episode",
        disable=None if progress else True,
        leave=False,
    )
    for episode in bar:
        check_finite(episode, sum(lengths), test=True, observation=key, action=action_key)
        taken = episode[action_key]
        actions = _mean_actions(policy, episode, key, action_key) if sampled else taken
        returns.append(_return(episode))
        variations.append(_variation(actions))
        clipped = getattr(policy, "clip_action", lambda samples: samples)(taken)
        played = {"": actions, "sampled_": clipped} if sampled else {"": actions}
        for prefix, kind in played.items():
            for name, value in measure(kind, env.action_spec).items():
                measures.setdefault(prefix + name, []).append(value)
        if env.action_spec.dtype.is_floating_point:
            measures.setdefault("noise_sensitivity", []).append(
                _sensitivity(policy, episode, key, action_key)
            )
        lengths.append(len(episode))
        bar.set_postfix_str(f"return {statistics.fmean(returns):.1f}")
    return Evaluation(returns, variations, lengths, measures)


def evaluate_task(
    policy: TensorDictModule,
    task: TaskConfig,
    seed: int,
    episodes: int,
    *,
    threads: int,
    **options: bool,
) -> Evaluation:
    """Evaluates a policy in a new environment of a task.

    The process's random generators and number of threads are restored afterwards.

    Args:
        policy (TensorDictModule): Policy, as for :func:`evaluate_policy`.
        task (TaskConfig): Settings of the task. Its action-rate penalty is ignored.
        seed (int): Seed of the environment and the policy's samples.
        episodes (int): Number of episodes.

    Keyword Args:
        threads (int): Number of PyTorch threads.
        **options: Other options of :func:`evaluate_policy`.

    Returns:
        Evaluation: Results of all episodes.
    """
    # Seeding an environment also seeds the process.
    with ProcessState(seed, threads), closing(make_env(task.for_test(), seed)) as env:
        return evaluate_policy(policy, env, episodes, max_steps=time_limit(task), **options)


def observation_key(policy: TensorDictModule, env: EnvBase) -> NestedKey:
    """Returns the key of the observation that a policy reads.

    Raises:
        TypeError: If the policy is no actor of TorchRL, or the environment is not one of TorchRL.
        ValueError: If the environment is a batch of several, or the policy reads several entries,
            or an entry that the environment lacks.
    """
    if isinstance(policy, LossModule):
        raise TypeError(
            f"policy must be an actor of TorchRL, got {type(policy).__name__}, a loss: give the "
            "actor that it was made with."
        )
    if not isinstance(policy, TensorDictModuleBase):
        raise TypeError(
            f"policy must be an actor of TorchRL, got {policy!r}: torchrl.modules.Actor(network) "
            "makes one of a network."
        )
    if not isinstance(env, EnvBase):
        raise TypeError(
            f"env must be an environment of TorchRL, got {env!r}: torchrl.envs.GymEnv(id) makes "
            "one, GymWrapper(env) one of Gymnasium's."
        )
    if env.batch_size:
        raise UserError(
            f"env must be a single environment, got a batch of {tuple(env.batch_size)}: make "
            "it without ParallelEnv, SerialEnv and num_envs."
        )
    if len(keys := list(policy.in_keys)) != 1:
        if "is_init" in keys:
            raise UserError(
                f"a recurrent policy, which reads {keys}, cannot be evaluated here: play it with "
                "env.rollout, and pass the recorded actions to diagnose_actions."
            )
        raise UserError(
            f"the policy must read one observation, this one reads {keys}: join them with "
            "torchrl.envs.CatTensors."
        )
    if keys[0] not in (there := list(env.observation_spec.keys(True, True))):
        raise UserError(f"the policy reads {keys[0]!r}, and the environment has {there}.")
    return keys[0]


def _known_mean(values: list[float]) -> float:
    return statistics.fmean([v for v in values if not math.isnan(v)] or [math.nan])


def _return(episode: TensorDictBase) -> float:
    total: float = episode["next", "reward"].sum().item()
    if not math.isfinite(total):
        raise FloatingPointError(
            f"the return of a test episode is {total}, the sum of {len(episode)} finite rewards: "
            "scale the task's rewards down."
        )
    return total


def measure(actions: Tensor, spec: TensorSpec) -> dict[str, float]:
    """Returns the measures of actions ``[T, A]`` by name; NaN if the episode is too short."""
    actions = actions.float()
    long_enough = len(actions) >= LEAST_STEPS
    found = {
        name: function(actions).item() if long_enough else math.nan
        for name, function in ACTION_MEASURES.items()
    }
    if isinstance(spec, Bounded) and spec.dtype.is_floating_point:
        low, high = spec.space.low.flatten(), spec.space.high.flatten()
        found["saturation"] = saturation(actions, low, high).item()
    return found


@torch.no_grad()
def _mean_actions(
    policy: TensorDictModule, episode: TensorDictBase, key: NestedKey, action_key: NestedKey
) -> Tensor:
    """Returns the policy's mean actions ``[T, A]`` at the states of an episode."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        actions: Tensor = policy(episode.select(key))[action_key]
    return actions


def _sensitivity(
    policy: TensorDictModule, episode: TensorDictBase, key: NestedKey, action_key: NestedKey
) -> float:
    """Returns the sensitivity to noise, with the same noise at every call."""

    def act(observation: Tensor) -> Tensor:
        seen = TensorDict({key: observation}, observation.shape[:1])
        return _mean_actions(policy, seen, key, action_key)

    generator = torch.Generator().manual_seed(0)
    return noise_sensitivity(act, episode[key], NOISE, generator=generator).item()


class LateTests:
    """Test episodes during the last part of training, one per policy.

    Their mean varies less than the mean of a test of only the last policy. An episode depends on
    its number, not on earlier episodes.

    Args:
        task (TaskConfig): Settings of the task.
        seed (int): Random seed of the run.
        policy (TensorDictModule): Policy that is deterministic under
            ``ExplorationType.DETERMINISTIC``.
        compile_policy (bool): Whether to compile the policy.
    """

    def __init__(
        self, task: TaskConfig, seed: int, policy: TensorDictModule, compile_policy: bool
    ) -> None:
        self._task, self._policy, self._compile = task, policy, compile_policy
        self._seed = seed + TEST_SEED
        self._collector: EpisodeCollector | None = None

    def play(self, number: int) -> dict[str, float]:
        """Plays the test episode after a training episode and returns its metrics.

        Args:
            number (int): Number of the training episode.

        Raises:
            FloatingPointError: As :func:`evaluate_policy`.
            SimulatorError: As :func:`evaluate_policy`.
        """
        with ProcessState(self._seed, torch.get_num_threads()):
            # Created here: many short trainings play no test episode.
            if self._collector is None:
                self._collector = self._make_collector()
            with simulator_errors(f"{self._task.env_id} failed in the test after episode {number}"):
                self._collector.set_seed(self._seed + number)
                episode = self._collector.rollout()
        check_finite(episode, 0, test=True)
        values = _return(episode), _variation(episode["action"])
        return dict(zip(TEST_COLUMNS, values, strict=True))

    def none(self) -> dict[str, float]:
        """Returns the same metrics as NaN, for episodes without a test."""
        return dict.fromkeys(TEST_COLUMNS, math.nan)

    def close(self) -> None:
        """Closes the environment."""
        if self._collector is not None:
            self._collector.shutdown()

    def _make_collector(self) -> EpisodeCollector:
        return EpisodeCollector(
            make_env(self._task.for_test(), self._seed),
            self._policy,
            frames_per_batch=time_limit(self._task),
            compile_policy=self._compile,
            exploration_type=ExplorationType.DETERMINISTIC,
        )


def _variation(actions: Tensor) -> float:
    """Returns the action variation; 0 for an episode of one step."""
    return action_variation(actions.float()).item() if actions.shape[-2] > 1 else 0.0
