"""Rendered pictures of an environment."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from torchrl_l2c2.experiment.envs.spaces import Env
from torchrl_l2c2.experiment.errors import SimulatorError, UserError

QUICK_SIZE = 320  # Width and height in pixels.
USUAL_RATE = 30.0  # Steps per second for simulators whose rate is unknown.


class Drawing(NamedTuple):
    """States of an episode to render, and their quality.

    Attributes:
        rate: Maximum pictures per second of simulated time.
        seconds: Simulated time to render, from the start of the episode.
        quick: Whether MuJoCo renders small pictures without shadows and antialiasing: about ten
            times faster without a graphics card.
    """

    rate: float = math.inf
    seconds: float = math.inf
    quick: bool = False

    def options(self, env_id: str) -> dict[str, Any]:
        """Returns the keyword arguments of ``gymnasium.make``."""
        module, _, name = env_id.rpartition(":")
        entry = "" if module else str(gymnasium.spec(name).entry_point)
        small = self.quick and entry.startswith("gymnasium.envs.mujoco")
        return {"width": QUICK_SIZE, "height": QUICK_SIZE} if small else {}


class PictureRecorder(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Wrapper that records pictures of an episode.

    Args:
        env (gymnasium.Env): Environment with ``render_mode="rgb_array"``.
        drawing (Drawing): States to render.

    Attributes:
        every: Number of steps between pictures.
    """

    def __init__(self, env: Env, drawing: Drawing) -> None:
        super().__init__(env)
        self._drawing = drawing
        self.every = 1
        self._steps, self._last = 0, math.inf
        self._pictures: list[Any] = []
        quality = getattr(getattr(env.unwrapped, "model", None), "vis", None)
        if drawing.quick and quality is not None:
            quality.quality.shadowsize = quality.quality.offsamples = 0

    def reset(self, **options: Any) -> Any:
        result = self.env.reset(**options)
        rate = control_rate(self.env) or USUAL_RATE
        self.every = max(1, round(rate / self._drawing.rate))
        self._last = rate * self._drawing.seconds
        self._steps, self._pictures = 0, []
        self._draw()
        return result

    def step(self, action: Any) -> Any:
        result = self.env.step(action)
        self._steps += 1
        if self._steps <= self._last and self._steps % self.every == 0:
            self._draw()
        return result

    def pictures(self) -> list[Any]:
        """Returns the pictures of the current episode, arrays ``[H, W, 3]`` of uint8."""
        return list(self._pictures)

    def _draw(self) -> None:
        """Adds a copy of the task's picture: some tasks draw all pictures into one array.

        Raises:
            SimulatorError: If the task fails.
            UserError: If there is no graphics library, or no picture of bytes in the size of the
                first one.
        """
        task = getattr(self.env.unwrapped.spec, "id", type(self.env.unwrapped).__name__)
        try:
            picture: Any = self.env.render()
        except Exception as error:
            cause = f"{type(error).__name__}: {' '.join(str(error).split())}"
            what = f"{task} could not draw its pictures: {cause}"
            if "OpenGL" in cause:
                raise UserError(f"{what}. Set MUJOCO_GL=egl, or MUJOCO_GL=osmesa.") from None
            raise SimulatorError(what) from error
        of_bytes = isinstance(picture, np.ndarray) and picture.dtype == np.uint8
        if not of_bytes or picture.ndim != 3 or picture.shape[2] not in (3, 4):
            shape, dtype = getattr(picture, "shape", None), getattr(picture, "dtype", None)
            found = type(picture).__name__ if shape is None else f"{dtype} of shape {shape}"
            raise UserError(
                f"render() of {task} must return an array [H, W, 3] of uint8, got {found}."
            )
        picture = picture[..., :3].copy()  # without a fourth channel, the opacity
        if self._pictures and picture.shape != self._pictures[0].shape:
            raise UserError(
                f"pictures of {task} must have one size, got {self._pictures[0].shape[:2]} and "
                f"then {picture.shape[:2]}."
            )
        self._pictures.append(picture)


def control_rate(env: Any) -> float | None:
    """Returns the actions per second of simulated time, or ``None`` if unknown.

    Args:
        env: Gymnasium environment, or a TorchRL environment around it, after its first reset.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> control_rate(GymEnv("Pendulum-v1"))
        20.0
    """
    simulator = getattr(env, "base_env", env).unwrapped
    # MuJoCo and classic tasks; Bullet; the cart pole.
    for owner, name in (
        (simulator, "dt"),
        (getattr(simulator, "scene", None), "dt"),
        (simulator, "tau"),
    ):
        if seconds := getattr(owner, name, None):
            return round(1.0 / float(seconds), 6)
    frames: float | None = simulator.metadata.get("render_fps")
    return frames
