"""Test episodes with mean actions, and the measures of smoothness on them."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type
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

# Further measures of smoothness, of the actions [T, A] of an episode.
ACTION_MEASURES: dict[str, Callable[[Tensor], Tensor]] = {
    "action_rate": action_rate,
    "action_fluctuation_ratio": action_fluctuation_ratio,
    "action_jerk": action_jerk,
    "roughness": roughness,
    "sm_caps": spectral_smoothness,
    "sm_asap": partial(spectral_smoothness, form="asap"),
    "previous_action_gain": previous_action_gain,
}
# Columns of metrics.csv with the test episode of a late policy.
TESTED = ("test_return", "test_action_variation")
LEAST_STEPS = 4  # shortest episode that all of these measures accept
NOISE = 0.01  # standard deviation for noise_sensitivity, as in the paper's tasks


@dataclass(frozen=True)
class Evaluation:
    """Results of test episodes; one entry per episode in every list.

    Attributes:
        returns: sums of rewards. Larger is better.
        action_variations: mean L2 norm of the change of the mean action from step to step, the
            paper's "L2 norm of temporal actions". Smaller is smoother.
        lengths: steps of the episodes.
        measures: other measures of the mean action's smoothness (``torchrl_l2c2.metrics``), with
            ``saturation`` where actions have bounds and ``noise_sensitivity``, to noise of 0.01,
            where they are numbers. An episode with sampled actions also has the measures of the
            samples, as ``sampled_...``. NaN where an episode is too short.
    """

    returns: list[float]
    action_variations: list[float]
    lengths: list[int]
    measures: dict[str, list[float]] = field(default_factory=dict)

    def summary(self) -> dict[str, float | int]:
        """Means and standard deviations over the episodes."""
        return {
            "episodes": len(self.returns),
            "return_mean": statistics.fmean(self.returns),
            "return_std": statistics.pstdev(self.returns),
            "action_variation_mean": statistics.fmean(self.action_variations),
            "action_variation_std": statistics.pstdev(self.action_variations),
            **{f"{name}_mean": statistics.fmean(each) for name, each in self.measures.items()},
        }

    def to_dict(self) -> dict[str, Any]:
        """As ``evaluation.json`` has it."""
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
    """Plays episodes with the policy's mean action, or with samples.

    Args:
        policy (TensorDictModule): acts deterministically under ``ExplorationType.DETERMINISTIC``,
            for one observation and for a batch of them.
        env (EnvBase): one Gymnasium environment, as :class:`EpisodeCollector` takes it.
        episodes (int): how many, at least 1. More give a surer mean.
        max_steps (int): longest episode. Default 1000.
        sampled (bool): whether the policy samples actions, as in training. The action variation is
            still measured on the mean actions, at the visited states. Default ``False``.
        compile_policy (bool): whether to compile the policy. Default ``False``.
        progress (bool): whether to show a progress bar.

    Raises:
        FloatingPointError: NaN or infinity in what the environment or the policy gave; names the
            key and the frame.
        SimulatorError: the environment or the policy raised an error; names the episode.
        ValueError: fewer than one episode.

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
        check_finite(episode, sum(lengths), test=True)
        actions = mean_actions(policy, episode) if sampled else episode["action"]
        returns.append(_return(episode))
        variations.append(_variation(actions))
        taken = getattr(policy, "clip_action", lambda samples: samples)(episode["action"])
        played = {"": actions, "sampled_": taken} if sampled else {"": actions}
        for prefix, kind in played.items():
            for name, value in measure(kind, env.action_spec).items():
                measures.setdefault(prefix + name, []).append(value)
        if env.action_spec.dtype.is_floating_point:
            measures.setdefault("noise_sensitivity", []).append(_sensitivity(policy, episode))
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
    """As :func:`evaluate_policy`, which has the options, in an environment of its own.

    The process's random generators and number of threads are left as they are found.
    """
    with ProcessState(seed, threads):  # Seeding an environment seeds the process, too.
        env = make_env(task.for_test(), seed)
        result = evaluate_policy(policy, env, episodes, max_steps=time_limit(task), **options)
        env.close()
    return result


def _return(episode: TensorDictBase) -> float:
    total: float = episode["next", "reward"].sum().item()
    if not math.isfinite(total):
        raise FloatingPointError(
            f"the return of a test episode is {total}, a sum of {len(episode)} finite rewards: "
            "have the task give smaller ones."
        )
    return total


def measure(actions: Tensor, spec: TensorSpec) -> dict[str, float]:
    """The field's measures of an episode's actions ``[T, A]``; NaN where it is too short."""
    actions = actions.float()
    long_enough = len(actions) >= LEAST_STEPS
    found = {
        name: function(actions).item() if long_enough else math.nan
        for name, function in ACTION_MEASURES.items()
    }
    if isinstance(spec, Bounded) and spec.dtype.is_floating_point:
        found["saturation"] = saturation(actions, spec.space.low, spec.space.high).item()
    return found


@torch.no_grad()
def mean_actions(policy: TensorDictModule, episode: TensorDictBase) -> Tensor:
    """The policy's mean actions ``[T, A]`` at the states of an episode."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        actions: Tensor = policy(episode.select("observation"))["action"]
    return actions


def _sensitivity(policy: TensorDictModule, episode: TensorDictBase) -> float:
    """To noise that is the same at every call."""

    def act(observation: Tensor) -> Tensor:
        return mean_actions(policy, TensorDict({"observation": observation}, observation.shape[:1]))

    generator = torch.Generator().manual_seed(0)
    return noise_sensitivity(act, episode["observation"], NOISE, generator=generator).item()


class LateTests:
    """Plays one test episode with every policy late in training.

    The mean over these policies varies less than tests of only the last policy. An episode is
    seeded by its number, and does not depend on other episodes.

    Args:
        task (TaskConfig): The task.
        seed (int): The run's seed.
        policy (TensorDictModule): acts deterministically under ``ExplorationType.DETERMINISTIC``.
        compile_policy (bool): whether to compile it.
    """

    def __init__(
        self, task: TaskConfig, seed: int, policy: TensorDictModule, compile_policy: bool
    ) -> None:
        self._task, self._policy, self._compile = task, policy, compile_policy
        self._seed = seed + TEST_SEED
        self._collector: EpisodeCollector | None = None

    def play(self, number: int) -> dict[str, float]:
        """The figures of the test episode that belongs to a training episode's number.

        Raises:
            FloatingPointError: as in :func:`evaluate_policy`.
            SimulatorError: as in :func:`evaluate_policy`.
        """
        with ProcessState(self._seed, torch.get_num_threads()):
            # Late, as most calls of a short training need none.
            if self._collector is None:
                self._collector = self._make_collector()
            self._collector.set_seed(self._seed + number)
            with simulator_errors(f"{self._task.env_id} failed in the test after episode {number}"):
                episode = self._collector.rollout()
        check_finite(episode, 0, test=True)
        figures = _return(episode), _variation(episode["action"])
        return dict(zip(TESTED, figures, strict=True))

    def none(self) -> dict[str, float]:
        """The same entries where no episode is played."""
        return dict.fromkeys(TESTED, math.nan)

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
    """Zero for an episode of a single step, which has no change of action."""
    return action_variation(actions.float()).item() if actions.shape[-2] > 1 else 0.0
