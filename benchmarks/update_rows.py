"""Rows about one update."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from unittest.mock import patch

import torch

from benchmarks.regularizer_rows import ppo_update
from benchmarks.setups import REGULARIZERS, Effort, matrix_products, updates
from benchmarks.timing import Row, alternate
from torchrl_l2c2.experiment import Experiment, ExperimentConfig, SACConfig, TaskConfig
from torchrl_l2c2.experiment.learn import compilation
from torchrl_l2c2.experiment.learn.products import onednn_is_faster
from torchrl_l2c2.experiment.learn.update import ReplayUpdate
from torchrl_l2c2.experiment.settings.regularizers import REGULARIZERS as REGULARIZER_CONFIGS


def update_rows(effort: Effort) -> Iterable[Row]:
    """The update of the paper's agent at its batch size, against three others."""
    small = partial(updates, effort, 32)
    l2c2 = small("l2c2", effort.compile)
    times = alternate(
        {
            "l2c2": l2c2,
            "baseline": small("baseline", effort.compile),
            "eager": small("l2c2", False),
            "products": matrix_products(small("l2c2", False)),
            "baseline products": matrix_products(small("baseline", False)),
        },
        repeats=effort.rounds,
        calls=20,
        warm_up=5,
    )
    us = {name: 1e6 * seconds for name, seconds in times.items()}
    yield Row(
        "update",
        "eager update / compiled update, batch 32",
        us["eager"] / us["l2c2"],
        at_least=4.0,
        parts={"eager us": us["eager"], "compiled us": us["l2c2"]},
    )
    row = _smoothing_row("update", 32, us, 1.2)
    row.parts["l2c2's products us"] = us["products"]
    row.parts["baseline's products us"] = us["baseline products"]
    yield row
    yield Row(
        "update",
        "compiled update / its matrix products alone, batch 32",
        us["l2c2"] / us["products"],
        at_most=3.0,
        parts={"compiled us": us["l2c2"], "products us": us["products"]},
    )


def ppo_update_rows(effort: Effort) -> Iterable[Row]:
    """PPO's update at batch 64, two layers of 64."""
    compiled = {"eager": False, "compiled": effort.compile}
    actions = {name: ppo_update(effort, "none", how) for name, how in compiled.items()}
    times = alternate(actions, repeats=effort.rounds, calls=20, warm_up=5)
    us = {f"{name} us": 1e6 * seconds for name, seconds in times.items()}
    yield Row(
        "ppo_update",
        "eager PPO update / compiled PPO update, batch 64",
        us["eager us"] / us["compiled us"],
        at_least=3.0,
        parts=us,
    )


def large_update_rows(effort: Effort) -> Iterable[Row]:
    """The price of the regularization where arithmetic, and no call's overhead, is what counts."""
    actions = {name: updates(effort, 4096, name, effort.compile) for name in REGULARIZERS}
    times = alternate(actions, repeats=effort.rounds, calls=2)
    us = {name: 1e6 * seconds for name, seconds in times.items()}
    yield _smoothing_row("update_4096", 4096, us, 1.9)
    quarter = {**us, "l2c2": us["quarter"]}
    yield _smoothing_row("update_4096", 4096, quarter, 1.3, " with fraction .25")


def product_rows(effort: Effort) -> Iterable[Row]:
    """SAC's update with two layers of 256: large products by torch's own library, and by oneDNN."""
    name = "SAC update with torch's products / with oneDNN's, layers of 256, batch 256"
    if not onednn_is_faster():
        yield Row("products", name, note="not measured: no processor of AMD with AVX-512")
        return
    actions = {}
    for library in ("torch", "onednn"):
        with patch.object(compilation, "onednn_is_faster", return_value=library == "onednn"):
            actions[library] = sac_update(effort.compile)
            actions[library]()  # Compiles it.
    times = alternate(actions, repeats=effort.rounds, calls=20, warm_up=5)
    us = {f"{library} us": 1e6 * seconds for library, seconds in times.items()}
    yield Row("products", name, us["torch us"] / us["onednn us"], parts=us)


def sac_update(compiled: bool) -> Callable[[], object]:
    """An update of SAC without a regularizer, with its default networks, on one batch."""
    config = ExperimentConfig(
        TaskConfig("pendulum", "Pendulum-v1", episodes=1), SACConfig(), REGULARIZER_CONFIGS["none"]
    )
    experiment = Experiment(replace(config, compile=False))
    learner = experiment.learner
    while len(learner.replay) < learner.replay.batch_size:
        learner.remember(experiment.player.collector.rollout())
    update = ReplayUpdate(experiment.agent, learner.replay, compile=compiled)
    draw = update.draw()
    return lambda: update.update(True, *draw)


def _smoothing_row(
    group: str, size: int, us: dict[str, float], at_most: float, which: str = ""
) -> Row:
    return Row(
        group,
        f"L2C2 update{which} / baseline update, batch {size}",
        us["l2c2"] / us["baseline"],
        at_most=at_most,
        parts={"l2c2 us": us["l2c2"], "baseline us": us["baseline"]},
    )


def cuda_rows(effort: Effort) -> Iterable[Row]:
    """The update on a CUDA device: eager, and compiled into CUDA graphs."""
    where = "" if find_spec("pybullet") else " of Pendulum"
    for size in (32, 1024, 16384):
        name = f"eager update / compiled update with CUDA graphs, batch {size}{where}"
        if not torch.cuda.is_available():
            yield Row("cuda", name, note="not measured: no CUDA device")
            continue
        actions = {
            "eager": updates(effort, size, "l2c2", False, "cuda"),
            "graphs": updates(effort, size, "l2c2", effort.compile, "cuda"),
        }
        waiting = {what: partial(_synchronized, action) for what, action in actions.items()}
        times = alternate(waiting, repeats=effort.rounds, warm_up=5)
        us = {f"{what} us": 1e6 * seconds / 20 for what, seconds in times.items()}
        yield Row("cuda", name, us["eager us"] / us["graphs us"], parts=us)


def _synchronized(action: Callable[[], object]) -> None:
    for _ in range(20):
        action()
    torch.cuda.synchronize()
