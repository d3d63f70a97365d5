"""Gymnasium environments of the tasks, with white noise on every observation."""

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
from torchrl.data import Bounded
from torchrl.envs import EnvBase, GymWrapper, TransformedEnv

from torchrl_l2c2.experiment.envs.pictures import Drawing, PictureRecorder
from torchrl_l2c2.experiment.envs.spaces import (
    Env,
    unknown_task,
    with_vector_action,
    with_vector_observation,
)
from torchrl_l2c2.experiment.errors import CompilerError, SimulatorError, UserError
from torchrl_l2c2.transforms import ObservationNoise

if TYPE_CHECKING:
    from torchrl_l2c2.experiment.settings.tasks import TaskConfig

# Added to the run's seed for test episodes, to differ from the training episodes.
TEST_SEED = 1_000_003
# Added to an environment's seed for its noise, to differ from the simulator's and the policy's
# random numbers.
NOISE_SEED = 7_919


@contextlib.contextmanager
def simulator_errors(what: str) -> Iterator[None]:
    """Converts errors of a task, or of the policy that acts in it, to :class:`SimulatorError`.

    Args:
        what (str): Description of the failure and its place, the first part of the message.

    Raises:
        SimulatorError: If the block raises an error or tries to end the process.
        CompilerError: If the policy could not be compiled; it is not converted.
        UserError: If the task draws no pictures that can be recorded; it is not converted.
    """
    try:
        yield
    except (CompilerError, SimulatorError, UserError):
        raise
    except (Exception, SystemExit) as error:
        message = " ".join(str(error).split())  # One line, as in a sweep's summary.
        raise SimulatorError(f"{what}: {type(error).__name__}: {message}") from error


def make_env(task: TaskConfig, seed: int, *, render: Drawing | None = None) -> EnvBase:
    """Creates a task's environment with its noise, and seeds both.

    Args:
        task (TaskConfig): Settings of the task.
        seed (int): Seed of the simulator. The noise's seed is derived from it.

    Keyword Args:
        render (Drawing, optional): States to render, by a :class:`~.pictures.PictureRecorder`
            around the Gymnasium environment. Default: none.

    Returns:
        EnvBase: A ``GymWrapper`` whose observation is a vector of float32, with
        :class:`ObservationNoise` if the task has noise.

    Raises:
        ValueError: If Gymnasium does not know the id, the task has no time limit or cannot render,
            or its observations or actions are not vectors of numbers.
        SimulatorError: If the environment raises an error when it is created or reset.
    """
    simulator = with_vector_action(BooleanEnds(_make(task, render)))
    simulator = with_vector_observation(simulator, flatten=task.flatten)
    if task.action_rate:
        simulator = ActionRatePenalty(simulator, task.action_rate)
    if render is not None:
        simulator = PictureRecorder(simulator, render)
    try:
        with _task_errors(task), quiet_output():
            env = GymWrapper(simulator)
            env.reset()
            env.set_seed(seed)  # Resets the task, too.
    except SimulatorError as error:
        if render is not None and isinstance(
            error.__cause__, NotImplementedError
        ):  # Gymnasium's own render()
            raise _cannot_render(task) from error.__cause__
        raise
    if not task.noise_scale:
        return env
    generator = torch.Generator().manual_seed(seed + NOISE_SEED)
    return TransformedEnv(env, ObservationNoise(task.noise_scale, generator=generator))


class BooleanEnds(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Converts ``terminated`` and ``truncated`` to booleans, from integers, arrays or ``None``.

    Integers would stay integers in the replay buffer, where ``~0`` is -1.
    """

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, bool(terminated), bool(truncated), info


class ActionRatePenalty(gymnasium.Wrapper[Any, Any, Any, Any]):
    r"""Subtracts a penalty on the change of the action from the reward.

    .. math::
        r_t - \frac{w}{A} \sum_i \Big( \frac{a_{t,i} - a_{t-1,i}}{h_i} \Big)^2

    :math:`A` is the number of actions and :math:`h_i` half the range of each. The first reward of
    an episode is unchanged.

    Args:
        env (gymnasium.Env): Environment with bounded actions.
        weight (float): Weight :math:`w`. Larger values give smoother actions and lower returns.

    Raises:
        UserError: If the actions have no bounds.

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
        space: Any = env.action_space
        if not space.is_bounded():
            raise UserError(
                f"Expected bounded actions with task.action_rate={weight:g}, got {space}. Set "
                "task.action_rate=0."
            )
        half_range = (space.high - space.low) / 2
        # An action whose bounds are equal cannot change.
        self._half_range = np.where(half_range > 0.0, half_range, np.inf)
        self._weight = weight
        self._previous: Any = None

    def reset(self, **options: Any) -> Any:
        self._previous = None
        return self.env.reset(**options)

    def step(self, action: Any) -> Any:
        given = np.array(action)  # A copy: the task may change the action in place.
        observation, reward, *rest = self.env.step(action)
        if self._previous is not None:
            change = (given - self._previous) / self._half_range
            reward = float(reward) - self._weight * float(np.mean(np.square(change)))
        self._previous = given
        return observation, reward, *rest


def time_limit(task: TaskConfig) -> int:
    """Returns a task's maximum frames per episode: ``task.max_steps``, or Gymnasium's own limit.

    Raises:
        ValueError: If there is no limit, or Gymnasium does not know the task.
    """
    if task.max_steps is not None:
        return task.max_steps
    module, _, name = task.env_id.rpartition(":")
    with _task_errors(task):
        if module:
            importlib.import_module(module)
        registered = gymnasium.spec(name).max_episode_steps
    if registered is None:
        raise UserError(
            f"task.env_id={task.env_id!r} is registered without a time limit: set "
            "task.max_steps, for example to 1000."
        )
    return registered


def action_range(env: EnvBase) -> str:
    """The bounds of an environment's actions, in words.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> action_range(GymEnv("Pendulum-v1"))
        'from [-2.0] to [2.0]'
    """
    spec = env.action_spec
    if not isinstance(spec, Bounded):
        return f"{type(spec).__name__} {list(spec.shape)}"
    low, high = (bound.flatten().tolist() for bound in (spec.space.low, spec.space.high))
    return f"from {low} to {high}"


def untransformed(env: EnvBase) -> Any:
    """Returns the environment below TorchRL's transforms, or itself without transforms."""
    return getattr(env, "base_env", env)


def _make(task: TaskConfig, render: Drawing | None) -> Env:
    limit = time_limit(task)
    with _task_errors(task), quiet_output():
        if render is None:
            return gymnasium.make(task.env_id, max_episode_steps=limit)
        try:
            env = gymnasium.make(
                task.env_id,
                max_episode_steps=limit,
                render_mode="rgb_array",
                **render.options(task.env_id),
            )
            renders, cause = env.render_mode in env.metadata.get("render_modes", ()), None
        except TypeError as error:  # It has no render_mode argument.
            renders, cause = False, error
    if not renders:
        raise _cannot_render(task) from cause
    return env


def _cannot_render(task: TaskConfig) -> UserError:
    return UserError(f"{task.env_id} cannot render pictures: it has no render_mode 'rgb_array'.")


@contextlib.contextmanager
def _task_errors(task: TaskConfig) -> Iterator[None]:
    try:
        with simulator_errors(f"{task.env_id} could not start"):
            yield
    except SimulatorError as error:
        cause = error.__cause__
        if not isinstance(cause, gymnasium.error.Error | ImportError):
            raise
        raise unknown_task(task.env_id, cause) from cause


@contextlib.contextmanager
def quiet_output() -> Iterator[None]:
    """Hides the output of C libraries, such as Bullet's banner."""
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    saved = [os.dup(number) for number in (1, 2)]
    silent = os.open(os.devnull, os.O_WRONLY)
    try:
        for number in (1, 2):
            os.dup2(silent, number)
        yield
    finally:
        # If the output is not a terminal, C buffers it: flush before the output is restored.
        ctypes.CDLL(None).fflush(None)
        for number, original in zip((1, 2), saved, strict=True):
            os.dup2(original, number)
            os.close(original)
        os.close(silent)
