"""``video``: records test episodes."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from torchrl_l2c2.experiment.errors import one_line_errors


def main(arguments: Sequence[str] | None = None) -> None:
    """Records test episodes and prints the path of the video."""
    parser = argparse.ArgumentParser(
        prog="python -m torchrl_l2c2 video",
        description="Records test episodes of a run's policy with mean actions.",
    )
    add = parser.add_argument
    add("folder", help="run folder, finished or not")
    add("--output", help="video file (default: video.mp4 in the run folder)")
    add("--episodes", type=int, default=1, help="number of episodes (default: 1)")
    add("--seed", type=int, help="random seed (default: the seed of the run's test)")
    add(
        "--noise",
        type=float,
        help="standard deviation of the noise on observations (default: the task's)",
    )
    add("--best", action="store_true", help="policy_best.pt instead of policy.pt")
    chosen = parser.parse_args(arguments)
    with one_line_errors():
        from torchrl_l2c2.experiment.analysis.video import record_video

        path = record_video(
            chosen.folder,
            chosen.output,
            episodes=chosen.episodes,
            seed=chosen.seed,
            noise_scale=chosen.noise,
            best=chosen.best,
        )
    print(path)
