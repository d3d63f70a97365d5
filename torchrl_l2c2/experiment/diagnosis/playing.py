"""The episodes that a diagnosis is of: played with mean actions, and checked."""

from __future__ import annotations

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type

from torchrl_l2c2.experiment.evaluate import LEAST_STEPS


def observed_key(policy: TensorDictModule, env: EnvBase) -> NestedKey:
    """The one entry that a policy reads.

    Raises:
        ValueError: it reads several, or the environment is a batch of some.
    """
    if env.batch_size:
        raise ValueError(
            f"one environment is diagnosed, got a batch of {tuple(env.batch_size)}: give the one "
            "that it is made of."
        )
    keys = list(policy.in_keys)
    if len(keys) != 1:
        raise ValueError(
            f"the policy must read one observation, this one reads {keys}: join them with "
            "torchrl.envs.CatTensors."
        )
    return keys[0]


def play(
    policy: TensorDictModule, env: EnvBase, key: NestedKey, episodes: int, max_steps: int
) -> list[TensorDictBase]:
    """Episodes ``[T]`` of a policy's mean actions.

    Raises:
        ValueError: one is too short to be measured, or an action is not finite: that has no
            smoothness, and would be told as numbers that are none.
    """
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        played = [env.rollout(max_steps, policy).detach() for _ in range(episodes)]
    shortest = min(map(len, played))
    if shortest < LEAST_STEPS:
        raise ValueError(
            f"an episode of {shortest} steps is too short to be diagnosed: it needs "
            f"{LEAST_STEPS}. Give a larger max_steps, or a policy that lasts longer."
        )
    for number, episode in enumerate(played, 1):
        _check_actions(episode[env.action_key], episode[key], number)
    return played


def _check_actions(actions: Tensor, observations: Tensor, episode: int) -> None:
    bad = ~actions.isfinite().flatten(1).all(1)
    if not bad.any():
        return
    step = int(bad.nonzero()[0])
    seen = observations[step].isfinite().all()
    why = "" if seen else ", as its observation is (a normalization that is empty?)"
    raise ValueError(
        f"the policy's action is not finite at step {step} of episode {episode}{why}: "
        f"{actions[step].flatten().tolist()}."
    )
