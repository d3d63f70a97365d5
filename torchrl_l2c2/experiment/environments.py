"""The noisy tasks: Gymnasium environments with white noise on every observation."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING

import gymnasium
import torch
from torchrl.data import Bounded, Unbounded
from torchrl.envs import EnvBase, GymEnv, TransformedEnv

from torchrl_l2c2.transforms import ObservationNoise

if TYPE_CHECKING:
    from torchrl_l2c2.experiment.tasks import TaskConfig

# Added to the seed of test episodes, so that they are not training episodes again.
TEST_SEED = 1_000_003


def make_env(task: TaskConfig, seed: int) -> EnvBase:
    """Makes a task's environment, noisy and seeded.

    Args:
        task (TaskConfig): the Gymnasium id and the noise.
        seed (int): of the simulator and, separately, of the noise.

    Returns:
        EnvBase: a ``GymEnv``, transformed by :class:`ObservationNoise` where there is noise.

    Raises:
        ValueError: an id that Gymnasium does not know, or a task whose observation is not one
            tensor of floats.
    """
    try:
        with quiet_output():
            env = GymEnv(task.env_id, max_episode_steps=task.max_steps)
            env.reset()
    except (gymnasium.error.Error, ModuleNotFoundError) as error:
        raise ValueError(
            f"task.env_id={task.env_id!r} is not a task that Gymnasium can make here ({error}). "
            "Use task=swingup|reacher|hopper|ant, or task=gymnasium with a registered id; "
            "`module:id` imports the module that registers it."
        ) from error
    _check_spaces(env, task)
    env.set_seed(seed)
    if not task.noise_scale:
        return env
    generator = torch.Generator().manual_seed(seed)
    return TransformedEnv(env, ObservationNoise(task.noise_scale, generator=generator))


def _check_spaces(env: GymEnv, task: TaskConfig) -> None:
    observation = env.observation_spec.get("observation", None)
    if not isinstance(observation, Bounded | Unbounded) or not observation.dtype.is_floating_point:
        raise ValueError(
            f"task.env_id={task.env_id!r} observes {env.observation_spec}; this experiment needs "
            "one observation of floats. Compose the components yourself for anything else."
        )


@contextlib.contextmanager
def quiet_output() -> Iterator[None]:
    """Keeps what a C library prints, as Bullet does at start, off the screen."""
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    saved = [os.dup(number) for number in (1, 2)]
    silent = os.open(os.devnull, os.O_WRONLY)
    try:
        for number in (1, 2):
            os.dup2(silent, number)
        yield
    finally:
        # What the library has printed waits in C's own buffer where the output is no terminal.
        ctypes.CDLL(None).fflush(None)
        for number, original in zip((1, 2), saved, strict=True):
            os.dup2(original, number)
            os.close(original)
        os.close(silent)
