"""The noisy tasks: Gymnasium environments with white noise on every observation."""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import os
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import torch
from torchrl.envs import EnvBase, GymWrapper, TransformedEnv

from torchrl_l2c2.experiment.envs.pictures import Drawing, PictureRecorder
from torchrl_l2c2.experiment.envs.spaces import (
    Env,
    observing_vector,
    taking_vector,
    unknown_task,
)
from torchrl_l2c2.experiment.errors import CompilerError, SimulatorError, UserError
from torchrl_l2c2.transforms import ObservationNoise

if TYPE_CHECKING:
    from torchrl_l2c2.experiment.settings.tasks import TaskConfig

# Added to the seed of test episodes, so that they are not training episodes again.
TEST_SEED = 1_000_003
# Added to the seed of an environment for its noise: it is not to draw what the simulator, or the
# policy with its samples, draws.
NOISE_SEED = 7_919


@contextlib.contextmanager
def simulating(what: str) -> Iterator[None]:
    """Makes errors of a task, or of the policy that acts in it, a :class:`SimulatorError`.

    Args:
        what (str): what failed and where: the beginning of the error's text.

    Raises:
        SimulatorError: something raised an error, or tried to end the process.
        CompilerError: the policy could not be compiled, which is no fault of the task.
    """
    try:
        yield
    except CompilerError:
        raise
    except (Exception, SystemExit) as error:
        told = " ".join(str(error).split())  # in a line, as it stands in one of a sweep's end
        raise SimulatorError(f"{what}: {type(error).__name__}: {told}") from error


def make_env(task: TaskConfig, seed: int, *, render: Drawing | None = None) -> EnvBase:
    """Makes a task's environment, noisy and seeded.

    Args:
        task (TaskConfig): the Gymnasium id and the noise.
        seed (int): of the simulator and, separately, of the noise.

    Keyword Args:
        render (Drawing, optional): which states are drawn, by a :class:`~.pictures.PictureRecorder`
            around the Gymnasium environment. Default: none.

    Returns:
        EnvBase: a ``GymWrapper`` that observes one vector of float32, with noise transformed by
            :class:`ObservationNoise`.

    Raises:
        ValueError: an id that Gymnasium does not know, a task without a time limit, or one whose
            observations or actions are not vectors of numbers; or one that draws no pictures, with
            ``render``.
        SimulatorError: the environment itself raises an error when it is made or reset.
    """
    simulator = observing_vector(taking_vector(_make(task, render)), flatten=task.flatten)
    if task.action_rate:
        simulator = ActionRatePenalty(simulator, task.action_rate)
    if render is not None:
        simulator = PictureRecorder(simulator, render)
    try:
        with _explained(task), quiet_output():
            env = GymWrapper(simulator)
            env.reset()
    except SimulatorError as error:
        if render is not None and isinstance(
            error.__cause__, NotImplementedError
        ):  # Gymnasium's own render()
            raise _draws_nothing(task) from error.__cause__
        raise
    env.set_seed(seed)
    if not task.noise_scale:
        return env
    generator = torch.Generator().manual_seed(seed + NOISE_SEED)
    return TransformedEnv(env, ObservationNoise(task.noise_scale, generator=generator))


class ActionRatePenalty(gymnasium.Wrapper[Any, Any, Any, Any]):
    r"""Subtracts a penalty on the change of the action from the reward.

    .. math::
        r_t - \frac{w}{A} \sum_i \Big( \frac{a_{t,i} - a_{t-1,i}}{h_i} \Big)^2

    with half the range :math:`h_i` of each action; the first reward of an episode is unchanged.

    Args:
        env (gymnasium.Env): an environment with bounded actions.
        weight (float): :math:`w`. Larger values give smoother actions and lower returns.

    Raises:
        UserError: the actions have no bounds.

    Examples:
        >>> env = ActionRatePenalty(gymnasium.make("Pendulum-v1"), weight=1.0)
        >>> _ = env.reset(seed=0)
        >>> rewards = [env.step(np.array([u], np.float32))[1] for u in (2.0, 2.0, -2.0)]
        >>> _ = env.env.reset(seed=0)
        >>> own = [env.env.step(np.array([u], np.float32))[1] for u in (2.0, 2.0, -2.0)]
        >>> [round(float(a - b), 6) for a, b in zip(own, rewards)]
        [0.0, 0.0, 4.0]
    """

    def __init__(self, env: Env, weight: float) -> None:
        super().__init__(env)
        space = env.action_space
        if not isinstance(space, gymnasium.spaces.Box) or not space.is_bounded():
            raise UserError(
                f"Expected bounded actions with task.action_rate={weight:g}, got {space}. Set "
                "task.action_rate=0."
            )
        self._weight, self._half_range = weight, (space.high - space.low) / 2
        self._previous: Any = None

    def reset(self, **options: Any) -> Any:
        self._previous = None
        return self.env.reset(**options)

    def step(self, action: Any) -> Any:
        observation, reward, *rest = self.env.step(action)
        if self._previous is not None:
            change = (action - self._previous) / self._half_range
            reward = float(reward) - self._weight * float(np.mean(np.square(change)))
        self._previous = np.array(action)
        return observation, reward, *rest


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
        raise UserError(
            f"task.env_id={task.env_id!r} is registered without a limit of its episodes: set "
            "task.max_steps, for example to 1000."
        )
    return registered


def untransformed(env: EnvBase) -> Any:
    """The environment below TorchRL's transforms; itself where it has none."""
    return getattr(env, "base_env", env)


def _make(task: TaskConfig, render: Drawing | None) -> Env:
    limit = time_limit(task)
    with _explained(task), quiet_output():
        if render is None:
            return gymnasium.make(task.env_id, max_episode_steps=limit)
        try:
            env = gymnasium.make(
                task.env_id,
                max_episode_steps=limit,
                render_mode="rgb_array",
                **render.options(task.env_id),
            )
            draws, cause = env.render_mode in env.metadata.get("render_modes", ()), None
        except TypeError as error:  # It knows of no render_mode at all.
            draws, cause = False, error
    if not draws:
        raise _draws_nothing(task) from cause
    return env


def _draws_nothing(task: TaskConfig) -> UserError:
    return UserError(f"{task.env_id} draws no pictures: it has no render_mode 'rgb_array'.")


@contextlib.contextmanager
def _explained(task: TaskConfig) -> Iterator[None]:
    try:
        with simulating(f"{task.env_id} could not begin"):
            yield
    except SimulatorError as error:
        cause = error.__cause__
        if not isinstance(cause, gymnasium.error.Error | ImportError):
            raise
        raise unknown_task(task.env_id, cause) from cause


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
