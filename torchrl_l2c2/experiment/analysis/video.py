"""Videos of test episodes.

``python -m torchrl_l2c2 video FOLDER`` records a run's policy.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDictBase

from torchrl_l2c2.experiment.agents._torchrl_internals import simulator_of
from torchrl_l2c2.experiment.collect.episodes import play_episodes
from torchrl_l2c2.experiment.envs.environments import make_env, untransformed
from torchrl_l2c2.experiment.envs.pictures import USUAL_RATE, Drawing, control_rate
from torchrl_l2c2.experiment.errors import MissingPackageError, UserError
from torchrl_l2c2.experiment.run.files import make_folder_of
from torchrl_l2c2.experiment.run.policies import load_policy, seed_of_test
from torchrl_l2c2.experiment.run.process import ProcessState
from torchrl_l2c2.experiment.settings.tasks import TaskConfig

Picture = NDArray[np.uint8]
# Formats that can contain H.264, the encoder's default.
ENDINGS = (".avi", ".m4v", ".mkv", ".mov", ".mp4")


def check_video(path: str | Path | None = None) -> None:
    """Checks that a video can be written, before anything is played.

    Args:
        path (str or Path, optional): The file, if it is known; its folder is made.

    Raises:
        ImportError: the ``video`` extra is missing.
        ValueError: the file's ending is none of a video's.
        OSError: its folder cannot be written to.
    """
    if find_spec("imageio_ffmpeg") is None:
        raise MissingPackageError(
            "Expected the package imageio-ffmpeg, which is not installed. Run pip install "
            '"torchrl-l2c2[video]".'
        )
    if path is None:
        return
    if Path(path).suffix.lower() not in ENDINGS:
        raise UserError(
            f"Expected a file with the ending {', '.join(ENDINGS)}, got {str(path)!r}. Rename it."
        )
    make_folder_of(path)


def check_pictures(task: TaskConfig) -> None:
    """Checks that a task draws pictures, by drawing its first one.

    Raises:
        ValueError: the task has no pictures.
        SimulatorError: the task cannot draw, for example without a graphics library.
    """
    with _without_a_screen(), ProcessState(0):
        make_env(task, 0, render=Drawing()).close()


def record_video(
    run: str | Path,
    path: str | Path | None = None,
    *,
    episodes: int = 1,
    seed: int | None = None,
    noise_scale: float | None = None,
    best: bool = False,
) -> Path:
    """Writes a video of test episodes with a run's mean policy, at the speed of simulated time.

    Args:
        run (str or Path): The run's folder.
        path (str or Path, optional): The file; its ending, ``.mp4``, ``.m4v``, ``.mkv``, ``.mov``
            or ``.avi``, is the format. Default: ``video.mp4`` in the folder.

    Keyword Args:
        episodes (int): Number of episodes, one after the other, at least 1. Default 1.
        seed (int, optional): Random seed of the environment and its noise. Default: the seed of
            the run's test, for the same episodes.
        noise_scale (float, optional): Standard deviation of the environment's noise. Default: the
            task's noise.
        best (bool): Whether to take ``policy_best.pt``. Default ``False``.

    Returns:
        Path: The file.

    Raises:
        ImportError: the ``video`` extra is missing.
        ValueError: the task draws no pictures, fewer than one episode, or a file with another
            ending.
        FileNotFoundError: the folder holds no run, or no policy yet.
        OSError: the file cannot be written.
    """
    check_video(path)
    if episodes < 1:
        raise UserError(f"Expected at least 1 episode, got {episodes}. Give a larger --episodes.")
    path = Path(path or Path(run) / "video.mp4")
    played = play_pictures(run, episodes, seed=seed, noise_scale=noise_scale, best=best)
    seen = [picture for each in played for picture in each.pictures]
    write_video(path, seen, played[0].rate or USUAL_RATE)
    return path


class PlayedPictures(NamedTuple):
    """An episode and its pictures.

    Attributes:
        episode: transitions ``[T]``.
        pictures: pictures ``[H, W, 3]``, from the reset on.
        rate: actions per second of simulated time; ``None`` if the simulator does not tell it.
        every: steps from one picture to the next.
    """

    episode: TensorDictBase
    pictures: list[Picture]
    rate: float | None
    every: int


def play_pictures(
    run: str | Path,
    episodes: int,
    *,
    seed: int | None = None,
    noise_scale: float | None = None,
    best: bool = False,
    drawing: Drawing = Drawing(),  # noqa: B008
) -> list[PlayedPictures]:
    """Plays test episodes with pictures.

    Takes the arguments of :func:`record_video`, and ``drawing``, a choice of the states that are
    drawn. Default: all.
    """
    with _without_a_screen():
        # Some tasks draw from the global generators when they are made.
        with ProcessState(seed_of_test(run, seed)):
            policy, env, max_steps = load_policy(
                run, seed=seed, noise_scale=noise_scale, best=best, render=drawing
            )
            recorder: Any = simulator_of(untransformed(env))
            played = [
                PlayedPictures(episode, recorder.pictures(), control_rate(env), recorder.every)
                for episode in play_episodes(policy, env, episodes, max_steps=max_steps)
            ]
        env.close()
    return played


def write_video(path: Path, pictures: Sequence[Picture], rate: float) -> None:
    """Encodes pictures ``[H, W, 3]`` of bytes in one step.

    Raises:
        OSError: the file cannot be written.
    """
    import imageio_ffmpeg

    height, width, _ = pictures[0].shape
    partial = path.with_name(f".partial_{path.name}")
    writer = imageio_ffmpeg.write_frames(
        str(partial),
        (width, height),
        fps=rate,
        macro_block_size=2,  # an odd side is stretched by a pixel, which the encoder needs
        ffmpeg_log_level="error",
    )
    try:
        writer.send(None)
        for picture in pictures:
            writer.send(np.ascontiguousarray(picture))
        writer.close()
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


@contextlib.contextmanager
def _without_a_screen() -> Iterator[None]:
    """Sets the variables with which MuJoCo and SDL draw without a screen."""
    known = {"MUJOCO_GL": "egl", "SDL_VIDEODRIVER": "dummy"}
    added = {} if "DISPLAY" in os.environ else known
    before = dict(os.environ)
    os.environ.update(added | before)
    try:
        yield
    finally:
        for name in added.keys() - before.keys():
            del os.environ[name]
