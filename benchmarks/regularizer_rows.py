"""Rows about what each regularizer costs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial

from benchmarks.setups import Effort
from benchmarks.timing import Row, alternate
from torchrl_l2c2.experiment import Experiment, ExperimentConfig, PPOConfig, TaskConfig
from torchrl_l2c2.experiment.analysis.reports.names import method_name
from torchrl_l2c2.experiment.learn.update import ReplayUpdate
from torchrl_l2c2.experiment.settings.regularizers import REGULARIZERS

# Whole trainings of PPO on Walker2d over those without a regularizer, in CATS (arXiv 2610.07910).
PUBLISHED = {"caps": 1.286, "l2c2": 1.771, "grad_caps": 1.302, "asap": 1.405, "cats": 1.198}


def regularizer_rows(effort: Effort) -> Iterable[Row]:
    """PPO's update with every regularizer over the plain one: batch 64, two layers of 64."""
    names = ["none", *PUBLISHED, "sr2l", "lcp"]
    actions = {name: ppo_update(effort, name, effort.compile) for name in names}
    times = alternate(actions, repeats=effort.rounds, calls=20, warm_up=5)
    us = {name: 1e6 * seconds for name, seconds in times.items()}
    for name in names[1:]:
        published = {"published of whole trainings": PUBLISHED[name]} if name in PUBLISHED else {}
        yield Row(
            "regularizers",
            f"PPO update with {method_name(name)} / plain PPO update, batch 64",
            us[name] / us["none"],
            parts={"regularized us": us[name], "plain us": us["none"], **published},
        )


def ppo_update(effort: Effort, regularizer: str, compile: bool) -> Callable[[], object]:
    """Updates of a new agent with one batch of its first episode."""
    config = ExperimentConfig(
        task=TaskConfig(max_steps=effort.steps, episodes=1),
        algorithm=PPOConfig(),
        regularizer=REGULARIZERS[regularizer],
        compile=False,
    )
    experiment = Experiment(config)
    experiment.learner.remember(experiment.player.collector.rollout())
    update = ReplayUpdate(experiment.agent, experiment.learner.replay, compile=compile)
    return partial(update.update, True, *update.draw())
