"""Rendered pictures of an environment."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import gymnasium

from torchrl_l2c2.experiment.envs.spaces import Env

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
        self._steps, self._pictures = 0, [self.env.render()]
        return result

    def step(self, action: Any) -> Any:
        result = self.env.step(action)
        self._steps += 1
        if self._steps <= self._last and self._steps % self.every == 0:
            self._pictures.append(self.env.render())
        return result

    def pictures(self) -> list[Any]:
        """Returns the pictures of the current episode, arrays ``[H, W, 3]`` of uint8."""
        return list(self._pictures)


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
