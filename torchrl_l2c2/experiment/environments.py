"""The noisy tasks: Gymnasium environments with white noise on every observation."""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import os
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING

import gymnasium
import torch
from torchrl.envs import EnvBase, GymWrapper, TransformedEnv

from torchrl_l2c2.experiment.spaces import (
    Env,
    observing_image,
    observing_vector,
    taking_vector,
)
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
        EnvBase: a ``GymWrapper`` that observes one vector, or image, of float32, transformed by
            :class:`ObservationNoise` where there is noise.

    Raises:
        ValueError: an id that Gymnasium does not know, a task without a time limit, or one whose
            observations or actions are not vectors of numbers, nor images where they are to be.
    """
    simulator = taking_vector(_make(task))
    if task.images:
        simulator = observing_image(simulator)
    else:
        simulator = observing_vector(simulator, flatten=task.flatten)
    with quiet_output():
        env = GymWrapper(simulator)
        env.reset()
    env.set_seed(seed)
    if not task.noise_scale:
        return env
    generator = torch.Generator().manual_seed(seed)
    return TransformedEnv(env, ObservationNoise(task.noise_scale, generator=generator))


def time_limit(task: TaskConfig) -> int:
    """Frames of a task's longest episode: its own setting, or what Gymnasium has registered.

    Raises:
        ValueError: neither is there, or Gymnasium does not know the task.
    """
    if task.max_steps is not None:
        return task.max_steps
    module, _, name = task.env_id.rpartition(":")
    with _explained(task):
        if module:
            importlib.import_module(module)
        registered = gymnasium.spec(name).max_episode_steps
    if registered is None:
        raise ValueError(
            f"task.env_id={task.env_id!r} is registered without a limit of its episodes: set "
            "task.max_steps, for example to 1000."
        )
    return registered


def _make(task: TaskConfig) -> Env:
    limit = time_limit(task)
    with _explained(task), quiet_output():
        return gymnasium.make(task.env_id, max_episode_steps=limit)


@contextlib.contextmanager
def _explained(task: TaskConfig) -> Iterator[None]:
    try:
        yield
    except (gymnasium.error.Error, ImportError) as error:
        raise ValueError(
            f"task.env_id={task.env_id!r} is not a task that Gymnasium can make here ({error}). "
            "Use task=swingup|reacher|hopper|ant, or task=gymnasium with a registered id; "
            "`module:id` imports the module that registers it."
        ) from error


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
