"""A run has the process's generators and threads for itself, and leaves them as they were."""

import random

import numpy as np
import torch

from torchrl_l2c2.experiment import Experiment, ExperimentConfig, TaskConfig
from torchrl_l2c2.experiment.process import ProcessState


def draw():
    """Python's, NumPy's and PyTorch's next numbers."""
    return random.random(), np.random.rand(), torch.rand(()).item(), random.gauss(0, 1)


def test_the_generators_go_on_where_the_last_entry_left_them():
    """Whatever is drawn outside; they begin with the seed."""
    state = ProcessState(seed=3)
    with state:
        first = draw()
    draw()
    with state:
        second = draw()
    with ProcessState(seed=3):
        assert [draw(), draw()] == [first, second]


def test_a_state_is_restored_inside_and_outside_of_the_context():
    """A checkpoint is taken inside, and loaded outside."""
    state = ProcessState(seed=0)
    with state:
        draw()
        saved = state.state_dict()
        expected = draw()
        state.load_state_dict(saved)
        assert draw() == expected
    state.load_state_dict(saved)
    with state:
        assert draw() == expected


def test_a_run_changes_nothing_of_the_process():
    """Not by being made, trained or tested: random numbers, threads, Dynamo's settings."""
    torch.manual_seed(5)
    threads, traced = torch.get_num_threads(), torch._dynamo.config.trace_autograd_ops
    before = torch.get_rng_state()
    task = TaskConfig("pendulum", "Pendulum-v1", episodes=2, max_steps=40)
    config = ExperimentConfig(task=task, compile=False, threads=threads + 1)
    experiment = Experiment(config)
    experiment.train()
    experiment.test(1)
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.get_num_threads() == threads
    assert torch._dynamo.config.trace_autograd_ops == traced


def test_two_runs_in_turns_are_as_one_after_the_other():
    """Neither draws the other's numbers."""
    task = TaskConfig("pendulum", "Pendulum-v1", episodes=4, max_steps=40)
    config = ExperimentConfig(task=task, compile=False, late_share=0.0)
    alone, first, second = (Experiment(config) for _ in range(3))
    for episodes in (1, 2, 3, 4):
        first.train(episodes)
        second.train(episodes)
    rows = [[row["return"] for row in e.metrics] for e in (first, second)]
    assert rows == [[row["return"] for row in alone.train()]] * 2
