"""Tests during training, and the best policy that they found."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModule

from torchrl_l2c2.experiment.envs.environments import TEST_SEED
from torchrl_l2c2.experiment.run.evaluation import evaluate_task
from torchrl_l2c2.experiment.run.files import write_json
from torchrl_l2c2.experiment.run.policies import save_policy
from torchrl_l2c2.experiment.settings.config import ExperimentConfig

EPISODES = 10


class BestPolicy:
    """Ten test episodes with the policy's mean, every so many of training; the best one is kept.

    Every test plays the same episodes, in an environment of its own, and does not change the
    training. The test at the end plays other episodes: the best policy was not chosen on them.

    Args:
        config (ExperimentConfig): of the run; its ``evaluate_every`` says how often, 0 never.
        policy (TensorDictModule): acts deterministically under ``ExplorationType.DETERMINISTIC``.
        folder (Path, optional): where ``evaluations.json`` and ``policy_best.pt`` go.

    Attributes:
        tests: summaries, each with its ``episode``.
    """

    def __init__(
        self, config: ExperimentConfig, policy: TensorDictModule, folder: Path | None
    ) -> None:
        self._task, self._seed = config.task, config.seed
        self._policy, self._folder, self._every = policy, folder, config.evaluate_every
        self.tests: list[dict[str, float]] = []

    def after(self, episode: int) -> None:
        """Tests the policy where it is time to."""
        if not self._every or episode % self._every:
            return
        seed, threads = self._seed + 2 * TEST_SEED, torch.get_num_threads()
        result = evaluate_task(self._policy, self._task, seed, EPISODES, threads=threads)
        self.tests.append({"episode": episode, **result.summary()})
        if self._folder is None:
            return
        if self.best() is self.tests[-1]:
            save_policy(self._policy, self._folder / "policy_best.pt")
        write_json(self._folder / "evaluations.json", self.tests)

    def best(self) -> dict[str, float]:
        """The first test with the highest mean return."""
        return max(self.tests, key=lambda test: test["return_mean"])

    def state_dict(self) -> dict[str, Any]:
        """What was tested, as text."""
        return {"tests": json.dumps(self.tests)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave."""
        self.tests = json.loads(state["tests"])
