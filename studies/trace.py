"""The action of Walker2d's busiest joint, of a baseline and of a policy trained with L2C2.

``python -m studies.trace BASELINE L2C2 PICTURE`` plays a test episode of each run and writes the
picture of the README. It shows of each policy the joint that changes most.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torchrl_l2c2.experiment.analysis.reports.figures import save, subplots
from torchrl_l2c2.experiment.collect.episodes import play_episodes
from torchrl_l2c2.experiment.run.policies import load_policy, seed_of_test
from torchrl_l2c2.experiment.run.process import ProcessState

JOINTS = ("right hip", "right knee", "right foot", "left hip", "left knee", "left foot")
STEPS = slice(400, 600)
COLORS = ("#c44e52", "#1f6fb4")


def actions_of(run: str | Path) -> np.ndarray:
    """Returns the mean actions ``[T, A]`` of the first test episode of a run."""
    policy, env, max_steps = load_policy(run)
    with ProcessState(seed_of_test(run, None)):
        (episode,) = play_episodes(policy, env, 1, max_steps=max_steps)
    env.close()
    actions: np.ndarray = episode["action"].numpy()
    return actions


def draw(actions: Sequence[np.ndarray], names: Sequence[str], path: str | Path) -> None:
    """Draws the joint that changes most, one row for each policy.

    Args:
        actions (sequence of array): Actions ``[T, A]`` of each policy.
        names (sequence of str): Titles of the rows.
        path (str or Path): SVG file.
    """
    figure, axes = subplots(1, len(actions), (9.0, 1.6 * len(actions)))
    figure.set_facecolor("white")
    for axis, each, name, color in zip(axes, actions, names, COLORS, strict=True):
        joint = int(np.abs(np.diff(each, axis=0)).mean(0).argmax())
        shown = each[STEPS, joint]
        change = np.abs(np.diff(shown)).mean()
        axis.plot(np.arange(STEPS.start, STEPS.start + len(shown)), shown, color=color)
        axis.set(ylim=(-1.1, 1.1), ylabel="action", xlim=(STEPS.start, STEPS.stop - 1))
        axis.set_title(
            f"{name}, {JOINTS[joint]}: mean change per step {change:.2f}", loc="left", fontsize=11
        )
        axis.grid(alpha=0.25)
    axes[-1].set_xlabel("step")
    save(figure, path)


def main(arguments: Sequence[str] | None = None) -> None:
    """Writes the picture of two runs."""
    parser = argparse.ArgumentParser(prog="python -m studies.trace", description=__doc__)
    parser.add_argument("baseline", type=Path, help="folder of the run without a regularizer")
    parser.add_argument("l2c2", type=Path, help="folder of the run with L2C2")
    parser.add_argument("picture", type=Path, help="SVG file")
    chosen = parser.parse_args(arguments)
    played = [actions_of(run) for run in (chosen.baseline, chosen.l2c2)]
    draw(played, ["PPO", "PPO with L2C2"], chosen.picture)


if __name__ == "__main__":
    main()
