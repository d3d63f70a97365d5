"""Setups that the rows measure: runs, episodes and updates of the paper's agent."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from torchrl_l2c2.experiment import (
    Experiment,
    ExperimentConfig,
    L2C2Config,
    NoRegularizerConfig,
    PPORPEConfig,
    PrioritizedReplayConfig,
    TaskConfig,
    UniformReplayConfig,
)
from torchrl_l2c2.experiment.agents.optimizers import make_optimizer
from torchrl_l2c2.experiment.learn.update import ReplayUpdate, make_update
from torchrl_l2c2.updaters import TSoftUpdate

REGULARIZERS = {
    "baseline": NoRegularizerConfig(),
    "l2c2": L2C2Config(),
    "quarter": L2C2Config(fraction=0.25),
}


@dataclass(frozen=True)
class Effort:
    """Length of the measurement, compilation, and the interpreter of the peers."""

    rounds: int = 15
    steps: int = 1000
    compile: bool = True
    peer_python: str = sys.executable


# Shows that everything runs; its numbers say nothing.
QUICK = Effort(rounds=1, steps=60, compile=False)


def paper_config(effort: Effort) -> ExperimentConfig:
    """The paper's L2C2 on Swingup with one update a frame, for as long as one asks."""
    return ExperimentConfig(
        task=TaskConfig(max_steps=effort.steps, episodes=1),
        algorithm=PPORPEConfig(updates=effort.steps),
        compile=effort.compile,
        late_share=0.0,  # A test episode is not training.
    )


def pendulum_task(effort: Effort) -> TaskConfig:
    """Gymnasium's Pendulum, for machines without PyBullet."""
    return TaskConfig("pendulum", "Pendulum-v1", max_steps=effort.steps, episodes=1)


def play_episode(experiment: Experiment) -> Callable[[], int]:
    """Training of one more episode, as a function; returns its frames."""

    def play() -> int:
        before = experiment.player.frames
        experiment.train(len(experiment.metrics) + 1)
        return experiment.player.frames - before

    return play


def updates(
    effort: Effort, size: int, regularizer: str, compile: bool, device: str = "cpu"
) -> Callable[[], object]:
    """Updates of a new agent with one batch; on CUDA of one drawn uniformly, on any torch."""
    draws = PrioritizedReplayConfig if device == "cpu" else UniformReplayConfig
    config = dataclasses.replace(
        paper_config(effort),
        regularizer=REGULARIZERS[regularizer],
        replay=draws(capacity=max(10_000, size), batch_size=size),
        compile=False,
    )
    if device != "cpu" and find_spec("pybullet") is None:
        config = dataclasses.replace(config, task=pendulum_task(effort))
    experiment = Experiment(config)
    learner, agent = experiment.learner, experiment.agent
    learner.remember(experiment.player.collector.rollout())
    if device == "cpu":
        update = ReplayUpdate(agent, learner.replay, compile=compile)
        draw = update.draw()
        return lambda: update.update(True, *draw)
    agent.loss.to(device)
    agent.optimizer = make_optimizer(config.optimizer, agent.loss.parameters())
    agent.target_updater = TSoftUpdate(agent.loss)
    step = make_update(agent, compile=False)
    if compile:
        torch._dynamo.config.trace_autograd_ops = True
        step = torch.compile(step, fullgraph=True, mode="reduce-overhead")
    batch = learner.replay.sample().to(device)
    return lambda: step(True, batch)


def matrix_products(update: Callable[[], object]) -> partial[None]:
    """The matrix products that an eager update makes, forward and backward, and nothing else."""
    with _Recorder() as recorder:
        update()
    products = [
        (left, right, torch.empty(*left.shape[:-1], right.shape[-1]))
        for left, right in recorder.factors
    ]
    return partial(_multiply, products)


@torch.no_grad()
def _multiply(products: list[tuple[Tensor, Tensor, Tensor]]) -> None:
    for left, right, out in products:
        torch.matmul(left, right, out=out)


class _Recorder(TorchDispatchMode):
    """Keeps the factors of every matrix product, with the strides that they had."""

    def __init__(self) -> None:
        super().__init__()
        self.factors: list[tuple[Tensor, Tensor]] = []

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        aten = torch.ops.aten
        if func.overloadpacket in (aten.mm, aten.bmm, aten.addmm, aten.baddbmm):
            left, right = args[-2:]
            self.factors.append((left.detach().clone(), right.detach().clone()))
        return func(*args, **(kwargs or {}))
