"""``evaluate``: plays test episodes with a run's policy."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from torchrl_l2c2.experiment.errors import one_line_errors

if TYPE_CHECKING:
    from torchrl_l2c2.experiment.run.evaluation import Evaluation

COLUMNS = ("return_mean", "return_std", "action_variation_mean", "action_variation_std")


def main(arguments: Sequence[str] | None = None) -> None:
    """Plays test episodes and prints their summary, as JSON or as a table of noise levels."""
    chosen = _parser().parse_args(arguments)
    levels = chosen.noise or [None]
    with one_line_errors():
        from torchrl_l2c2.experiment.run.files import check_output, to_json, write_json
        from torchrl_l2c2.experiment.run.policies import seed_of_test

        # Before the episodes, whose results could otherwise be lost.
        if chosen.output:
            check_output(chosen.output, ".json")
        played = {level: _play(chosen, level) for level in levels}
        one = len(played) == 1
        try:
            print(to_json(played[levels[0]].summary()) if one else _table(played), flush=True)
        finally:  # Also if the output is closed, as with head.
            if chosen.output:
                tests = [{"noise": level, **test.to_dict()} for level, test in played.items()]
                written = tests[0] if one else {"tests": tests}
                settings = {**vars(chosen), "seed": seed_of_test(chosen.folder, chosen.seed)}
                write_json(Path(chosen.output), {"arguments": settings, **written})


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m torchrl_l2c2 evaluate",
        description="Plays test episodes with a run's policy.",
    )
    add = parser.add_argument
    add("folder", help="run folder, finished or not")
    add("--episodes", type=int, default=100, help="number of episodes (default: 100)")
    add("--seed", type=int, help="random seed (default: the seed of the run's test)")
    add(
        "--noise",
        type=float,
        nargs="+",
        metavar="LEVEL",
        help="standard deviations of the noise on observations, such as 0 0.05 0.1; several levels "
        "give a table (default: the task's)",
    )
    add(
        "--sampled",
        action="store_true",
        help="sampled actions, as in training (the variation is also of the mean actions)",
    )
    add("--best", action="store_true", help="policy_best.pt instead of policy.pt")
    add("--output", help="JSON file for the summary and all episodes")
    return parser


def _play(chosen: argparse.Namespace, noise: float | None) -> Evaluation:
    from torchrl_l2c2.experiment.run.evaluation import evaluate_policy
    from torchrl_l2c2.experiment.run.policies import load_policy, seed_of_test
    from torchrl_l2c2.experiment.run.process import ProcessState

    with ProcessState(seed_of_test(chosen.folder, chosen.seed)):
        # Inside the context: some tasks use the global random generators when they are created.
        policy, env, max_steps = load_policy(
            chosen.folder, seed=chosen.seed, noise_scale=noise, best=chosen.best
        )
        with closing(env):
            return evaluate_policy(
                policy,
                env,
                chosen.episodes,
                max_steps=max_steps,
                sampled=chosen.sampled,
                progress=True,
            )


def _table(played: dict[float | None, Evaluation]) -> str:
    """Formats the summaries, one line per noise level."""
    lines = [f"{'noise':>8}  {'return':>20}  {'variation of the mean actions':>30}"]
    for level, test in played.items():
        summary = test.summary()
        total, total_std, variation, variation_std = (float(summary[name]) for name in COLUMNS)
        lines.append(
            f"{level:>8g}  {total:>10.1f} ({total_std:>7.1f})  {variation:>20.3f} "
            f"({variation_std:>7.3f})"
        )
    return "\n".join(lines)
