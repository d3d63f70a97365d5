"""Test episodes as the simulator draws them, as a video.

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
from torchrl_l2c2.experiment.envs.environments import untransformed
from torchrl_l2c2.experiment.envs.pictures import USUAL_RATE, Drawing, control_rate
from torchrl_l2c2.experiment.errors import MissingPackageError, UserError, how_to_install
from torchrl_l2c2.experiment.run.files import make_parent_folder
from torchrl_l2c2.experiment.run.policies import load_policy, seed_of_test
from torchrl_l2c2.experiment.run.process import ProcessState

Picture = NDArray[np.uint8]
# File endings that H.264, the encoder's default, supports.
ENDINGS = (".avi", ".m4v", ".mkv", ".mov", ".mp4")


def check_video(path: Path) -> None:
    """Checks that a video of this name can be written.

    Raises:
        ImportError: If the ``video`` extra is missing.
        ValueError: If the file has another ending.
    """
    if find_spec("imageio_ffmpeg") is None:
        raise MissingPackageError(
            "Expected the package imageio-ffmpeg, which is not installed. "
            f"{how_to_install('video')}"
        )
    if path.suffix.lower() not in ENDINGS:
        raise UserError(
            f"Expected a file that ends in {', '.join(ENDINGS)}, got {str(path)!r}. Rename it."
        )


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
        path (str or Path, optional): Path of the file, with the ending ``.mp4``, ``.m4v``,
            ``.mkv``, ``.mov`` or ``.avi``. Default: ``video.mp4`` in the run's folder.

    Keyword Args:
        episodes (int): Number of episodes, at least 1. Default 1.
        seed (int, optional): Seed of the environment and its noise. Default: the seed of the run's
            test, for its first episodes.
        noise_scale (float, optional): Scale of the environment's noise. Default: the task's.
        best (bool): Whether ``policy_best.pt`` acts. Default ``False``.

    Returns:
        Path: Path of the file.

    Raises:
        ImportError: If the ``video`` extra is missing.
        ValueError: If the task does not render pictures of bytes in one size, ``episodes`` is below
            1, or the file has another ending.
        SimulatorError: If the task or the policy fails.
        FileNotFoundError: If the folder has no run, or no policy yet.
        OSError: If the file cannot be written.
    """
    wanted, path = path is not None, Path(path or Path(run) / "video.mp4")
    check_video(path)
    if episodes < 1:
        raise UserError(f"Expected at least 1 episode, got {episodes}. Give a larger --episodes.")
    if wanted or path.parent.is_dir():  # Otherwise the missing run is reported below.
        make_parent_folder(path)
    played = play_pictures(run, episodes, seed=seed, noise_scale=noise_scale, best=best)
    seen = [picture for each in played for picture in each.pictures]
    write_video(path, seen, played[0].rate or USUAL_RATE)
    return path


class PlayedPictures(NamedTuple):
    """An episode and its pictures.

    Attributes:
        episode: transitions ``[T]``.
        pictures: pictures ``[H, W, 3]``, from the reset on.
        rate: actions per second of simulated time; ``None`` if the simulator does not have it.
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
        # Within, as some tasks draw from the global generators where they are made.
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
    """Encodes pictures ``[H, W, 3]`` of bytes; the file is there when it is whole.

    Raises:
        OSError: it could not be written.
    """
    import imageio_ffmpeg

    height, width, _ = pictures[0].shape
    odd = (0, height % 2), (0, width % 2), (0, 0)  # The encoder takes even sides only.
    partial = path.with_name(f".partial_{path.name}")
    writer = imageio_ffmpeg.write_frames(
        str(partial),
        (width + width % 2, height + height % 2),
        fps=rate,
        macro_block_size=2,
        ffmpeg_log_level="quiet",
    )
    try:
        writer.send(None)
        for picture in pictures:
            writer.send(np.ascontiguousarray(np.pad(picture, odd, "edge")))
        writer.close()
        os.replace(partial, path)
    except OSError:
        # The encoder's own message is many lines.
        raise OSError(f"the video could not be written: {path}. Is the disk full?") from None
    finally:
        partial.unlink(missing_ok=True)


@contextlib.contextmanager
def _without_a_screen() -> Iterator[None]:
    """Lets MuJoCo and SDL render without a screen if there is none."""
    known = {"MUJOCO_GL": "egl", "SDL_VIDEODRIVER": "dummy"}
    added = (
        {} if "DISPLAY" in os.environ else {k: v for k, v in known.items() if k not in os.environ}
    )
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]
